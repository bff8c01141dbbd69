"""Total stations: how fast and how well timed they are read, and what faults of the line cost."""
