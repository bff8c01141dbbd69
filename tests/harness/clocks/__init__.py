"""Scenarios of the stations' clocks, and what the filters make of them."""
