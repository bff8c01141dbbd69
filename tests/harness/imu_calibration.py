"""A drive with an IMU whose set-up is to be found: as the recording of a robot that nobody has measured up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from harness.inertial_drive import imu_parameters, inertial_drive

from tsgt.geometry import rotation_from_quaternion
from tsgt.geometry.inertial import Gravity, Mounting
from tsgt.geometry.inertial_calibration import ImuSetup, in_main_axes

if TYPE_CHECKING:
    from tsgt.geometry.inertial import InertialSamples
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import ImuParameters

MATRIX_SIGMAS = {"industrial": 7e-4, "consumer": 7e-3}


@dataclass(frozen=True)
class UncalibratedDrive:
    """Measurements, raw samples, and the truth."""

    observations: Observations
    samples: InertialSamples  # at their stamps
    imu: ImuParameters
    truth: ImuSetup

    @property
    def gravity(self) -> Gravity:
        """Gravity as configured."""
        return Gravity.of(self.imu)


def uncalibrated_drive(
    duration_s: float, *, grade: str = "industrial", latency_s: float = 0.0043, seed: int = 0
) -> UncalibratedDrive:
    """Drive through the scenario ``dynamic``, shaken, with an IMU that has errors of scale and misalignment."""
    imu = imu_parameters(grade)
    drive = inertial_drive(duration_s, seed=seed).shaken(imu, seed=seed)
    rng = np.random.default_rng([seed, 4])
    gyro, accelerometer = (np.eye(3) + rng.normal(0.0, MATRIX_SIGMAS[grade], (3, 3)) for _ in range(2))
    exact = drive.samples(imu, seed=seed)
    samples = replace(
        exact,
        end_s=exact.end_s + latency_s,
        angular_rate_radps=exact.angular_rate_radps @ gyro.T,
        specific_force_mps2=exact.specific_force_mps2 @ accelerometer.T,
    )
    centroid = drive.layout.mean(axis=0)
    mounted = rotation_from_quaternion(np.array(imu.orientation_xyzw))
    rotation, gyro_matrix = in_main_axes(mounted, np.asarray(np.linalg.inv(gyro), np.float64), 2)
    truth = ImuSetup(
        Mounting(rotation, np.array(imu.position_m) - centroid),
        latency_s,
        gyro_matrix,
        rotation.T @ mounted @ np.linalg.inv(accelerometer),
        np.zeros(3),
        2,
    )
    observations = replace(drive.measure(seed=seed), layout=drive.layout - centroid)
    return UncalibratedDrive(observations, samples, imu, truth)
