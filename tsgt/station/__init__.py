"""The client beside a total station: reads it, journals every measurement, answers the radio."""
