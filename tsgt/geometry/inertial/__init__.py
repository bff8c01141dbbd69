"""Inertial measurements in the trajectory: samples, preintegration, states, factors and strapdown integration. Sans-I/O.

In: samples of an IMU as arrays, its calibration, polar measurements of the prisms. Out: states of the IMU with covariances.
"""

from tsgt.geometry.inertial.preintegration import ContiguousSamples, Preintegrated, contiguous, preintegrate
from tsgt.geometry.inertial.samples import InertialSamples, concatenate_samples

__all__ = [
    "ContiguousSamples",
    "InertialSamples",
    "Preintegrated",
    "concatenate_samples",
    "contiguous",
    "preintegrate",
]
