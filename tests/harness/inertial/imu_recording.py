"""Recordings of a robot that is shaken as it drives, with an IMU: polar measurements and samples."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from harness.files.records import HEADER, SECOND, START
from harness.inertial.inertial_drive import imu_parameters, inertial_drive

from tsgt.geometry import cartesian_to_polar
from tsgt.model import (
    ImuSamples,
    InstrumentNoise,
    Parameters,
    PipelineParameters,
    PolarMeasurement,
    PrismPosition,
    StationParameters,
)
from tsgt.recording import Recording, encode_line

if TYPE_CHECKING:
    from pathlib import Path

    from harness.inertial.inertial_drive import InertialDrive

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialSamples
    from tsgt.model import ImuParameters, Matrix4

IMU = imu_parameters()
SAMPLES_PER_LINE = 100
STAMP_SIGMA_NS = 100_000


def shaken_drive(duration_s: float, *, seed: int = 12) -> InertialDrive:
    """Drive through the scenario ``dynamic``."""
    return inertial_drive(duration_s, seed=seed).shaken(IMU, seed=seed)


def imu_recording(
    drive: InertialDrive, *, stations: int = 3, imu: ImuParameters = IMU, period_ns: int = SECOND // 20
) -> Recording:
    """Record a drive with an IMU, as the master would with these stations."""
    observations = drive.measure(stations=stations)
    angles = cartesian_to_polar(observations.points_m)
    parameters = Parameters(
        stations=tuple(
            StationParameters(
                station=number,
                prism=number,
                T_station1_station=cast("Matrix4", tuple(map(tuple, frame.tolist()))),
                noise=InstrumentNoise(
                    range_sigma_m=0.00168, range_sigma_ppm=0.0, angle_sigma_rad=0.0, pointing_sigma_m=0.00109
                ),
            )
            for number, frame in enumerate(drive.frames[:stations], start=1)
        ),
        prisms=tuple(
            PrismPosition(prism=number, position_m=tuple(position))
            for number, position in enumerate(drive.layout[:stations].tolist(), start=1)
        ),
        pipeline=PipelineParameters(estimator="continuous", period_ns=period_ns),
        imu=imu,
    )
    rows = zip(
        observations.time_s.tolist(),
        observations.station.tolist(),
        *(each.tolist() for each in angles),
        strict=True,
    )
    measurements = [
        PolarMeasurement(
            station=station + 1,
            prism=station + 1,
            sequence=number,
            stamp_ns=START + round(1e9 * time_s),
            stamp_sigma_ns=STAMP_SIGMA_NS,
            received_ns=START + round(1e9 * time_s) + SECOND // 5,
            horizontal_angle_rad=horizontal_rad % (2 * np.pi),
            zenith_angle_rad=zenith_rad,
            slope_distance_m=distance_m,
            host_time_ns=None,
        )
        for number, (time_s, station, horizontal_rad, zenith_rad, distance_m) in enumerate(rows)
    ]
    return Recording(
        header=HEADER,
        parameters=parameters,
        measurements=list(measurements),
        end_ns=measurements[-1].received_ns,
        imu_samples=imu_records(drive.samples(IMU)),
    )


def imu_records(samples: InertialSamples) -> list[ImuSamples]:
    """Return samples as a master records them."""
    end_ns = START + np.round(1e9 * samples.end_s).astype(np.int64)
    duration_ns = np.round(1e9 * samples.duration_s).astype(np.int64)
    parts = [slice(first, first + SAMPLES_PER_LINE) for first in range(0, len(samples), SAMPLES_PER_LINE)]
    return [
        ImuSamples(
            sequence=rows.start,
            received_ns=int(end_ns[rows][-1]),
            stamp_ns=tuple(end_ns[rows].tolist()),
            duration_ns=tuple(duration_ns[rows].tolist()),
            instrument_time_ns=None,
            angular_rate_radps=tuple(map(tuple, samples.angular_rate_radps[rows].tolist())),
            specific_force_mps2=tuple(map(tuple, samples.specific_force_mps2[rows].tolist())),
        )
        for rows in parts
    ]


def write(path: Path, recording: Recording) -> None:
    """Write a recording."""
    records = [recording.header, recording.parameters, *recording.measurements, *recording.imu_samples]
    path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records))


def true_positions_m(drive: InertialDrive, stamp_ns: FloatArray) -> FloatArray:
    """(N, 3) of the robot's origin at stamps."""
    return drive.pose_at((stamp_ns - START) / 1e9)[0]
