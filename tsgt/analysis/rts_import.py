"""The authors' published field data as a recording.

Their `RTS_project` repository holds what is left after their own processing: per prism a track of Unix time and
position in the frame of station 1, and the prism positions on the robot. With the targets of the same day the
station frames can be solved, and each position be taken back to the angles and the distance that its station
measured; without them the positions stay Cartesian.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.analysis.calibration import solve_stations, target_residuals
from tsgt.analysis.formats.target_file import read_target_file
from tsgt.errors import GeometryError, InputFileError
from tsgt.geometry import cartesian_to_polar, invert, raw_distance, transform_points
from tsgt.model import IDENTITY4, PointMeasurement, PolarMeasurement, StationParameters

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.formats.rts_files import PublishedTrack
    from tsgt.model import Matrix4, Measurement


DEFAULT_TRACKED_PRISMS: Final[Mapping[int, int]] = {1: 1, 2: 2, 3: 3}
"""Which prism each of their stations tracks."""


@dataclass(frozen=True, slots=True)
class SolvedStations:
    """Where the stations stood.

    Attributes
    ----------
    stations
        Their frames, and the prism constant that they were given.
    notes
        What the user should know of the targets, one sentence each: left out, rejected, weak.
    """

    stations: tuple[StationParameters, ...]
    notes: tuple[str, ...]


def stations_from_targets(
    path: Path,
    *,
    target_constant_m: float,
    prism_constant_m: float,
    tracked: Mapping[int, int] = DEFAULT_TRACKED_PRISMS,
) -> SolvedStations:
    """Solve where the stations stood from the targets of the day, weighted by the instrument's noise.

    Parameters
    ----------
    path
        The authors' marker file or our own target file.
    target_constant_m
        Added to the slope distances of the targets, in m.
    prism_constant_m
        The prism constant that the stations get, in m.
    tracked
        By station number: which prism it tracks.

    Raises
    ------
    InputFileError
        The file cannot be used, holds no targets of one of the stations, or its targets contradict each other.
    DegenerateGeometryError
        A station has too few targets in common with station 1, or they lie in a line.
    """
    measured = read_target_file(path)
    solved = solve_stations(measured, target_constant_m=target_constant_m)
    notes = list(measured.skipped)
    for station in tracked:
        if station == 1:
            continue
        if station not in solved:
            raise InputFileError(
                f"holds no targets of station {station}; its frame cannot be solved", path=path
            )
        if not solved[station].consistent:
            raise InputFileError(
                f"the targets of station {station} contradict each other; "
                "tsgt calibrate targets shows by how much, check the target constant too",
                path=path,
            )
        notes += [
            f"{path}: target {bad.name} of station {station} rejected" for bad in solved[station].rejected
        ]
        if solved[station].weak:
            notes.append(
                f"{path}: station {station} is held weakly; tsgt calibrate targets says in which direction"
            )
    frames = {1: IDENTITY4} | {station: _matrix4(frame.T) for station, frame in solved.items()}
    stations = (
        StationParameters(
            station=station,
            prism=prism,
            T_station1_station=frames[station],
            prism_constant_m=prism_constant_m,
            targets=target_residuals(solved[station]) if station in solved else (),
        )
        for station, prism in tracked.items()
    )
    return SolvedStations(tuple(stations), tuple(notes))


def point_measurements(tracks: Sequence[PublishedTrack]) -> list[Measurement]:
    """Cartesian observations from tracks, in the order of time.

    Parameters
    ----------
    tracks
        Track k is that of station k and prism k, counted from 1.

    Returns
    -------
    list of PointMeasurement
        When they arrived is not known: ``received_ns`` is ``stamp_ns``.
    """
    measurements: list[Measurement] = []
    for station, track in enumerate(tracks, start=1):
        for sequence, (stamp_ns, (x, y, z)) in enumerate(
            zip(track.stamps_ns.tolist(), track.points_m.tolist(), strict=True)
        ):
            measurements.append(
                PointMeasurement(
                    station=station,
                    prism=station,
                    sequence=sequence,
                    stamp_ns=stamp_ns,
                    received_ns=stamp_ns,
                    position_m=(x, y, z),
                )
            )
    return _by_time(measurements)


def polar_measurements(
    tracks: Sequence[PublishedTrack], stations: Sequence[StationParameters]
) -> list[Measurement]:
    """Take the positions back to what each station measured: raw angles and slope distances.

    Parameters
    ----------
    tracks
        As for :func:`point_measurements`.
    stations
        Station k of track k: its frame, and the prism constant that is taken off the distances.

    Returns
    -------
    list of PolarMeasurement
        In the order of time. The same stations turn them into the tracks again.

    Raises
    ------
    GeometryError
        A position lies at its station, not even the prism constant away.
    """
    measurements: list[Measurement] = []
    for station, track in zip(stations, tracks, strict=True):
        in_station = transform_points(invert(np.array(station.T_station1_station)), track.points_m)
        horizontal, zenith, distance = cartesian_to_polar(in_station)
        slope = raw_distance(distance, constant_m=station.prism_constant_m, ppm=station.atmospheric_ppm)
        if np.any(slope <= 0.0):
            nearest_mm = float(np.min(distance)) * 1e3
            raise GeometryError(
                f"a position of prism {station.prism} lies {nearest_mm:.1f} mm from station {station.station}, "
                "which no station measures: check that tracks and targets are of the same day"
            )
        polar = np.stack([horizontal, zenith, slope], axis=-1)
        for sequence, (stamp_ns, (h, z, d)) in enumerate(
            zip(track.stamps_ns.tolist(), polar.tolist(), strict=True)
        ):
            measurements.append(
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
            )
    return _by_time(measurements)


def _by_time(measurements: list[Measurement]) -> list[Measurement]:
    return sorted(measurements, key=lambda m: (m.stamp_ns, m.station))


def _matrix4(T: NDArray[np.float64]) -> Matrix4:
    a, b, c, d = ((w, x, y, z) for w, x, y, z in T.tolist())
    return a, b, c, d
