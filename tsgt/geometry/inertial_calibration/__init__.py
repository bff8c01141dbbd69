"""Calibration of an IMU's mounting, latency and gyro matrix from motion, and the check of a configured one. Sans-I/O.

In: polar measurements of the prisms, raw samples. Out: the set-up with its covariance, what the motion left uncertain, the
causes of a set-up that contradicts the data, and the clock of samples that another computer recorded. docs/explanation/imu.md derives the equations.
"""

from tsgt.geometry.inertial_calibration.calibration import ImuCalibration, calibrate_imu
from tsgt.geometry.inertial_calibration.clock_alignment import ClockAlignment, align_clock
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
    "ClockAlignment",
    "ImuCalibration",
    "ImuSetup",
    "SetupCheck",
    "SetupComponent",
    "SetupFinding",
    "align_clock",
    "calibrate_imu",
    "check_few_prisms",
    "check_imu_setup",
    "robot_covariance",
    "setup_components",
]
