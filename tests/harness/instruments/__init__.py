"""Total stations: simulated, scripted, behind a line with faults, or measuring targets."""
