"""Both protocols on the simulated air, and the clocks that they synchronise: rates, ages, losses, forgery."""
