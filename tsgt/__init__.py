"""Outdoor 6-DOF reference poses for robots from robotic total stations."""

__version__ = "0.1.0"
