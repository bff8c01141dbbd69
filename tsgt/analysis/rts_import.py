"""Published field data of the paper's authors (``RTS_project``) as measurements.

Their data is processed: per prism a track of Unix time and position in the frame of station 1. With the targets of the same
day the station frames are solved and positions converted back to angles and distances; otherwise they remain Cartesian.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.analysis.calibration import solve_stations, target_notes, target_residuals
from tsgt.analysis.formats import read_target_file
from tsgt.errors import GeometryError, InputFileError
from tsgt.geometry import cartesian_to_polar, invert, raw_distance, transform_points
from tsgt.geometry.polar import MIN_SINE
from tsgt.model import IDENTITY4, PointMeasurement, PolarMeasurement, StationParameters

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.formats import PublishedTrack
    from tsgt.model import Matrix4, Measurement, SetupCovariance


DEFAULT_TRACKED_PRISMS: Final[Mapping[int, int]] = {1: 1, 2: 2, 3: 3}
"""Prism number by station number, as published."""


@dataclass(frozen=True, slots=True)
class SolvedStations:
    """Stations solved from targets, with one sentence per target that was skipped or rejected and per weak frame."""

    stations: tuple[StationParameters, ...]
    notes: tuple[str, ...]
    covariance: SetupCovariance


def stations_from_targets(
    path: Path,
    *,
    target_constant_m: float,
    prism_constant_m: float,
    tracked: Mapping[int, int] = DEFAULT_TRACKED_PRISMS,
) -> SolvedStations:
    """Solve the station frames from the targets of the day, the authors' marker file or ours, weighted by instrument noise.

    ``target_constant_m`` is added to the targets' slope distances, ``prism_constant_m`` assigned to the stations;
    ``tracked``: prism by station. Raises InputFileError if the file cannot be used, a station has no targets, or they are
    inconsistent; DegenerateGeometryError if one has too few in common with station 1, or they lie in a line.
    """
    measured = read_target_file(path)
    solved = solve_stations(measured, target_constant_m=target_constant_m)
    notes = list(measured.skipped)
    for station in tracked:
        if station != 1 and station not in solved.frames:
            raise InputFileError(
                f"holds no targets of station {station}; its frame cannot be solved", path=path
            )
    if not solved.consistent:
        raise InputFileError(
            "the targets are inconsistent; tsgt calibrate targets shows their residuals, names the suspects and leaves them "
            "out on request; check the target constant too",
            path=path,
        )
    notes += [f"{path}: {note}" for note in target_notes(solved)]
    notes += [
        f"{path}: the frame of station {station} is weakly determined; tsgt calibrate targets shows the direction"
        for station, frame in solved.frames.items()
        if station in tracked and frame.weak
    ]
    frames = {1: IDENTITY4} | {station: _matrix4(frame.T) for station, frame in solved.frames.items()}
    errors = solved.instrument_errors()
    stations = (
        StationParameters(
            station=station,
            prism=prism,
            T_station1_station=frames[station],
            prism_constant_m=prism_constant_m,
            atmospheric_ppm=errors[station].range_scale_ppm or 0.0,
            vertical_index_rad=errors[station].vertical_index_rad or 0.0,
            collimation_rad=errors[station].collimation_rad or 0.0,
            targets=target_residuals(solved.frames[station]) if station in solved.frames else (),
        )
        for station, prism in tracked.items()
    )
    return SolvedStations(tuple(stations), tuple(notes), solved.covariance)


def point_measurements(tracks: Sequence[PublishedTrack]) -> list[Measurement]:
    """Convert tracks k (station k, prism k) to Cartesian measurements in the order of time, received at ``stamp_ns``."""
    measurements: list[Measurement] = [
        PointMeasurement(
            station=station,
            prism=station,
            sequence=sequence,
            stamp_ns=stamp_ns,
            received_ns=stamp_ns,
            position_m=(x, y, z),
        )
        for station, track in enumerate(tracks, start=1)
        for sequence, (stamp_ns, (x, y, z)) in _numbered(track, track.points_m)
    ]
    return _by_time(measurements)


def polar_measurements(
    tracks: Sequence[PublishedTrack], stations: Sequence[StationParameters]
) -> list[Measurement]:
    """Convert positions of track k back to raw angles and slope distances of station k, in the order of time.

    The inverse of processing with the same ``stations``: frame and prism constant. Raises GeometryError if a position is
    closer to its station than the prism constant.
    """
    measurements: list[Measurement] = []
    for station, track in zip(stations, tracks, strict=True):
        in_station = transform_points(invert(np.array(station.T_station1_station)), track.points_m)
        horizontal, zenith, distance = cartesian_to_polar(in_station)
        slope = raw_distance(distance, constant_m=station.prism_constant_m, ppm=station.atmospheric_ppm)
        if np.any(slope <= 0.0):
            nearest_mm = float(np.min(distance)) * 1e3
            raise GeometryError(
                f"a position of prism {station.prism} is {nearest_mm:.1f} mm from station {station.station}, "
                "closer than a station can measure: check that tracks and targets are of the same day"
            )
        # What the instrument reads in the first face.
        horizontal = horizontal - station.collimation_rad / np.maximum(np.sin(zenith), MIN_SINE)
        polar = np.stack([horizontal, zenith + station.vertical_index_rad, slope], axis=-1)
        measurements += [
            PolarMeasurement(
                station=station.station,
                prism=station.prism,
                sequence=sequence,
                stamp_ns=stamp_ns,
                received_ns=stamp_ns,
                horizontal_angle_rad=h,
                zenith_angle_rad=z,
                slope_distance_m=d,
                host_time_ns=stamp_ns,
            )
            for sequence, (stamp_ns, (h, z, d)) in _numbered(track, polar)
        ]
    return _by_time(measurements)


def _numbered(
    track: PublishedTrack, values: NDArray[np.float64]
) -> Iterator[tuple[int, tuple[int, list[float]]]]:
    return enumerate(zip(track.stamps_ns.tolist(), values.tolist(), strict=True))


def _by_time(measurements: list[Measurement]) -> list[Measurement]:
    return sorted(measurements, key=lambda m: (m.stamp_ns, m.station))


def _matrix4(T: NDArray[np.float64]) -> Matrix4:
    a, b, c, d = ((w, x, y, z) for w, x, y, z in T.tolist())
    return a, b, c, d
