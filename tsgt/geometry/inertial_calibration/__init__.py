"""Calibration of an IMU's mounting, latency and gyro matrix from motion, and the check of a configured one. Sans-I/O.

In: polar measurements of the prisms, raw samples. Out: the set-up with its covariance, what the motion left uncertain, and the
causes of a set-up that contradicts the data. docs/explanation/imu.md derives the equations.
"""

from tsgt.geometry.inertial_calibration.calibration import ImuCalibration, calibrate_imu
from tsgt.geometry.inertial_calibration.observability import (
    SetupComponent,
    robot_covariance,
    setup_components,
)
from tsgt.geometry.inertial_calibration.setup import ImuSetup
from tsgt.geometry.inertial_calibration.setup_check import (
    MIN_CHECKED_MEASUREMENTS,
    Cause,
    SetupCheck,
    SetupFinding,
    check_few_prisms,
    check_imu_setup,
)

__all__ = [
    "MIN_CHECKED_MEASUREMENTS",
    "Cause",
    "ImuCalibration",
    "ImuSetup",
    "SetupCheck",
    "SetupComponent",
    "SetupFinding",
    "calibrate_imu",
    "check_few_prisms",
    "check_imu_setup",
    "robot_covariance",
    "setup_components",
]
