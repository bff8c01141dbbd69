"""Calibrate the robot's IMU from a recording, and judge the result."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from tsgt.errors import GeometryError
from tsgt.estimation import build_observations, centroid_m, inertial_samples
from tsgt.geometry import quaternion_from_rotation
from tsgt.geometry.inertial import Gravity
from tsgt.geometry.inertial_calibration import ImuCalibration, calibrate_imu, robot_covariance
from tsgt.model import MIN_PRISMS, SetupCovariance

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tsgt.model import ImuParameters, ImuSamples, Row4, Vector3
    from tsgt.recording import Recording

COMPONENTS = (
    *("imu.x", "imu.y", "imu.z", "imu.rotation_x", "imu.rotation_y", "imu.rotation_z", "imu.latency"),
    *(f"imu.gyro_{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)),
)

MAX_NOISE_SCALE = 2.0
MAX_BIRGE_RATIO = 3.0
MAX_HALVES_SIGMAS = 4.5
HALVES_TOLERANCES = np.array([np.radians(0.2)] * 3 + [0.015] * 3 + [0.002])
"""Differences between the halves of a drive below these are harmless."""

_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedImu:
    """An IMU calibrated from a recording."""

    calibration: ImuCalibration
    configured: ImuParameters  # With which the recording was made
    parameters: ImuParameters
    covariance: SetupCovariance

    def failed_checks(self) -> list[str]:
        """Return why the result is not to be used; empty if nothing speaks against it."""
        found = self.calibration
        failed = []
        if found.noise_scale > MAX_NOISE_SCALE:
            failed.append(
                f"residuals of the prisms are {found.noise_scale:.1f} times their noise: "
                "the measurements do not fit the samples of this IMU"
            )
        if found.birge_ratio > MAX_BIRGE_RATIO:
            failed.append(
                f"parts of the drive disagree by {found.birge_ratio:.1f} times what noise explains: "
                "the IMU is loose, or its clock jumps"
            )
        difference = np.abs(found.halves)
        wrong = (difference > MAX_HALVES_SIGMAS * found.halves_sigmas) & (difference > HALVES_TOLERANCES)
        for rows, name, scale, unit in (
            (slice(0, 3), "rotation", 180 / np.pi, "deg"),
            (slice(3, 6), "position", 1e3, "mm"),
            (slice(6, 7), "latency", 1e3, "ms"),
        ):
            if wrong[rows].any():
                size = scale * float(np.linalg.norm(difference[rows]))
                failed.append(f"the halves of the drive disagree in {name} by {size:.2g} {unit}")
        return failed


def calibrate_recorded_imu(
    recording: Recording,
    records: Iterable[ImuSamples],
    *,
    on_progress: Callable[[float], None] | None = None,
) -> CalibratedImu:
    """Calibrate from all measurements and samples.

    Raises GeometryError: no samples or measurements, or as :func:`~tsgt.geometry.inertial_calibration.calibrate_imu`.
    """
    configured = recording.parameters.imu
    if configured is None:
        raise GeometryError("the recording has no IMU: its master ran without the table [imu]")
    if not recording.measurements:
        raise GeometryError("the recording has no measurements")
    origin_ns = min(measurement.stamp_ns for measurement in recording.measurements)
    raw = dataclasses.replace(configured, latency_ns=0, gyro_matrix=_IDENTITY)
    samples = inertial_samples(records, raw, origin_ns)
    if not len(samples):
        raise GeometryError("the recording has no samples of the IMU")
    observations, _ = build_observations(recording.parameters, recording.measurements, origin_ns=origin_ns)
    prisms = len(np.unique(observations.prism))
    if prisms < MIN_PRISMS:
        undetermined = "two prisms leave the rotation of the IMU about their line undetermined"
        if prisms == 1:
            undetermined = "one prism leaves the rotation of the IMU undetermined"
        raise GeometryError(
            f"{undetermined}: calibrate once with {MIN_PRISMS} stations; the mounting stays valid with fewer, while IMU and "
            "prisms stay on the robot"
        )
    found = calibrate_imu(
        observations, samples, configured.noise, Gravity.of(configured), on_progress=on_progress
    )
    setup = found.setup
    position = setup.mounting.position + centroid_m(recording.parameters)
    quaternion = quaternion_from_rotation(setup.mounting.rotation)
    parameters = dataclasses.replace(
        configured,
        position_m=cast("Vector3", tuple(position.tolist())),
        orientation_xyzw=cast("Row4", tuple(quaternion.tolist())),
        latency_ns=round(1e9 * setup.latency_s),
        gyro_matrix=cast("tuple[Vector3, Vector3, Vector3]", tuple(map(tuple, setup.gyro_matrix.tolist()))),
    )
    matrix = tuple(map(tuple, robot_covariance(found).tolist()))
    return CalibratedImu(found, configured, parameters, SetupCovariance(components=COMPONENTS, matrix=matrix))
