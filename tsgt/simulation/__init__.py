"""A simulated world: the robot that drives, the prisms on it, the stations that see them."""
