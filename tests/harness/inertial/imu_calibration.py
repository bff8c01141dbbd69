"""A drive with an IMU whose set-up is to be found: as the recording of a robot that nobody has measured up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from harness.files.records import HEADER, SECOND, START
from harness.inertial.inertial_drive import InertialDrive, imu_parameters, inertial_drive
from scipy.spatial.transform import Rotation

from tsgt.geometry import exp_so3, quaternion_from_rotation, rotation_from_quaternion
from tsgt.geometry.inertial import Gravity, Mounting
from tsgt.geometry.inertial_calibration import ImuSetup
from tsgt.geometry.inertial_calibration.setup import axes_about
from tsgt.model import ImuSamples, Parameters, PointMeasurement, PrismPosition, StationParameters
from tsgt.recording import encode_line

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialSamples
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import ImuParameters

SAMPLES_PER_LINE = 100
MATRIX_SIGMAS = {"industrial": 7e-4, "consumer": 7e-3}


@dataclass(frozen=True)
class UncalibratedDrive:
    """Measurements, raw samples, and the truth."""

    observations: Observations
    samples: InertialSamples  # at their stamps
    imu: ImuParameters
    truth: ImuSetup
    centroid_m: FloatArray  # (3,) of the prisms in the robot frame

    @property
    def gravity(self) -> Gravity:
        """Gravity as configured."""
        return Gravity.of(self.imu)


def uncalibrated_drive(
    duration_s: float,
    *,
    grade: str = "industrial",
    latency_s: float = 0.0043,
    seed: int = 0,
    flat: bool = False,
) -> UncalibratedDrive:
    """Drive through the scenario ``dynamic``, shaken, with an IMU that has errors of scale and misalignment.

    ``flat``: without slopes, bumps and shaking.
    """
    imu = imu_parameters(grade)
    drive = inertial_drive(duration_s, seed=seed)
    drive = on_flat_ground(drive) if flat else drive.shaken(imu, seed=seed)
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
    truth = in_calibrated_axes(
        ImuSetup(
            Mounting(mounted, np.array(imu.position_m) - centroid),
            latency_s,
            np.asarray(np.linalg.inv(gyro), np.float64),
            np.asarray(np.linalg.inv(accelerometer), np.float64),
            np.zeros(3),
            mounted[2],
        )
    )
    observations = replace(drive.measure(seed=seed), layout=drive.layout - centroid)
    return UncalibratedDrive(observations, samples, imu, truth, centroid)


def in_calibrated_axes(setup: ImuSetup) -> ImuSetup:
    """Return a set-up that takes samples to the same rates and forces of the robot, in the axes that its calibration defines."""
    first, second, vertical = axes_about(setup.vertical)
    direction = setup.gyro_matrix @ vertical
    direction = direction / np.linalg.norm(direction)
    turn = exp_so3(np.cross(vertical, direction))
    turn = turn @ exp_so3(np.cross(vertical, turn.T @ direction))
    aligned = turn.T @ setup.accelerometer_matrix
    angle = np.arctan2(
        second @ aligned @ first - first @ aligned @ second,
        first @ aligned @ first + second @ aligned @ second,
    )
    turn = turn @ exp_so3(angle * vertical)
    return replace(
        setup,
        mounting=Mounting(setup.mounting.rotation @ turn, setup.mounting.position),
        gyro_matrix=turn.T @ setup.gyro_matrix,
        accelerometer_matrix=turn.T @ setup.accelerometer_matrix,
    )


def on_flat_ground(drive: InertialDrive) -> InertialDrive:
    """Return a drive that only yaws, at one height."""
    yaw = np.unwrap(drive.rotation.as_euler("ZYX")[:, :1], axis=0)
    position = drive.position * [1.0, 1.0, 0.0] + [0.0, 0.0, -1.0]
    return replace(drive, position=position, rotation=Rotation.from_euler("Z", yaw))


def write_imu_recording(path: Path, drive: UncalibratedDrive) -> None:
    """Write a recording of a drive, configured with an IMU at the robot's origin."""
    imu = replace(drive.imu, position_m=(0.0, 0.0, 0.0), orientation_xyzw=(0.0, 0.0, 0.0, 1.0))
    records = [HEADER, parameters_of(drive, imu), *point_measurements(drive), *imu_records(drive)]
    path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records))


def parameters_of(drive: UncalibratedDrive, imu: ImuParameters) -> Parameters:
    """Return the parameters of a drive with an IMU."""
    layout = drive.observations.layout + drive.centroid_m
    return Parameters(
        stations=tuple(StationParameters(station=number, prism=number) for number in (1, 2, 3)),
        prisms=tuple(
            PrismPosition(prism=number, position_m=tuple(position))
            for number, position in enumerate(layout.tolist(), start=1)
        ),
        imu=imu,
    )


def calibrated_imu(drive: UncalibratedDrive) -> ImuParameters:
    """Return the IMU of a drive as it is after a calibration without errors."""
    truth = drive.truth
    first, second, third = ((a, b, c) for a, b, c in truth.gyro_matrix.tolist())
    return replace(
        drive.imu,
        position_m=tuple((truth.mounting.position + drive.centroid_m).tolist()),
        orientation_xyzw=tuple(quaternion_from_rotation(truth.mounting.rotation).tolist()),
        latency_ns=round(1e9 * truth.latency_s),
        gyro_matrix=(first, second, third),
    )


def point_measurements(drive: UncalibratedDrive) -> list[PointMeasurement]:
    """Return the measurements of a drive, received 0.2 s after their stamps."""
    observations = drive.observations
    records = []
    stamps_ns = START + np.round(1e9 * observations.time_s).astype(np.int64)
    for number, (stamp_ns, prism, position) in enumerate(
        zip(stamps_ns.tolist(), observations.prism.tolist(), observations.in_world().tolist(), strict=True)
    ):
        records.append(
            PointMeasurement(
                station=prism + 1,
                prism=prism + 1,
                sequence=number,
                stamp_ns=stamp_ns,
                received_ns=stamp_ns + SECOND // 5,
                position_m=tuple(position),
            )
        )
    return records


def imu_records(drive: UncalibratedDrive) -> list[ImuSamples]:
    """Return the samples of a drive, received at their stamps."""
    samples = drive.samples
    records = []
    end_ns = START + np.round(1e9 * samples.end_s).astype(np.int64)
    for first in range(0, len(samples), SAMPLES_PER_LINE):
        rows = slice(first, first + SAMPLES_PER_LINE)
        records.append(
            ImuSamples(
                sequence=first,
                received_ns=int(end_ns[rows][-1]),
                stamp_ns=tuple(end_ns[rows].tolist()),
                duration_ns=tuple(np.round(1e9 * samples.duration_s[rows]).astype(np.int64).tolist()),
                instrument_time_ns=None,
                angular_rate_radps=tuple(map(tuple, samples.angular_rate_radps[rows].tolist())),
                specific_force_mps2=tuple(map(tuple, samples.specific_force_mps2[rows].tolist())),
            )
        )
    return records
