"""Accuracy and cost of poses without an IMU: both estimators, peers, post-processing of an hour."""
