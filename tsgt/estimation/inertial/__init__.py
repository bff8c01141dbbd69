"""The robot's IMU and wheels in the estimation: their samples as arrays, a check of the set-up, and when they are used. Sans-I/O.

In: recorded samples, measurements and parameters. Out: arrays for the estimator (`samples`, `wheels`), a set-up that is confirmed or
contradicted while the robot drives (`setup_monitor`), and the trajectory with or without the IMU (`selection`).
"""

from tsgt.estimation.inertial.samples import SampleConverter, inertial_samples
from tsgt.estimation.inertial.selection import (
    MAX_SHOCKS,
    ImuState,
    OdometryState,
    unconfirmed_covariance,
)
from tsgt.estimation.inertial.setup_monitor import (
    MOVE_CAUSES,
    SHOCK_INTERVAL_NS,
    UNWATCHED_NS,
    ImuSetupMonitor,
    StartCheck,
    check_recorded_setup,
    start_now,
)
from tsgt.estimation.inertial.wheels import wheel_samples

__all__ = [
    "MAX_SHOCKS",
    "MOVE_CAUSES",
    "SHOCK_INTERVAL_NS",
    "UNWATCHED_NS",
    "ImuSetupMonitor",
    "ImuState",
    "OdometryState",
    "SampleConverter",
    "StartCheck",
    "check_recorded_setup",
    "inertial_samples",
    "start_now",
    "unconfirmed_covariance",
    "wheel_samples",
]
