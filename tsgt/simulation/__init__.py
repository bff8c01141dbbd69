"""Simulation of whole missions: ground truth, radio channel, total stations, computers, faults, invariant checks."""
