"""The whole system: missions with faults, a day, endurance, killed processes, planted defects, speed of the simulation."""
