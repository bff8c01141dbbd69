"""Motions of a robot and their measurements, without daemons."""
