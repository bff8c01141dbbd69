"""Drives with an IMU, its devices, its recordings and its faults."""
