"""Checks of the robot's own devices, its IMU and its wheels.

In: a :class:`MissionResult`. Out: descriptions of violations. `imu_samples` and `odometry_samples` compare what was recorded with what
the devices gave, and the first also what status and poses say of the IMU; `sample_events` expects silences to be events.
"""

from tsgt.simulation.checks.devices.imu_samples import imu_failures, imu_status_failures
from tsgt.simulation.checks.devices.odometry_samples import odometry_failures

__all__ = ["imu_failures", "imu_status_failures", "odometry_failures"]
