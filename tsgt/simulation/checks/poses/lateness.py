"""Lateness of poses: by how much each prism is behind its true position along its path, against the measurements' stamps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import transform_of, usable
from tsgt.geometry import invert, rotation_from_quaternion, transform_from, transform_points
from tsgt.model import MIN_PRISMS
from tsgt.simulation.checks.poses.apparent import apparent_poses

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from tsgt.simulation.mission import JournalIndex, MasterLog, MissionResult

MAX_LATENESS_S = 0.0005
"""Limit beyond the error of the measurements' stamps. A single late station of three makes all prisms late by a third."""

CHORD_S = 0.0025
"""Added to the limit of interpolated poses: chords between the instants of the prisms turn the robot in curves, so that one prism is
ahead of or behind the others. In the last 30 s of a mission one was 5.2 ms late, the others -0.5 and 1.6 ms (30988).
"""

SIGMAS = 4.0
"""Standard errors of the lateness that are added to the limit."""

BLOCK_S = 2.0
"""Errors of poses farther apart than this are taken as independent."""

MIN_BLOCKS = 10
"""Minimum number of blocks in which the robot moves."""

_DECIMALS = 6  # of a distance in m; a response has more
_STRIDE = 4
_STEP_S = 0.01


def lateness_failures(
    master_log: MasterLog, result: MissionResult, indices: Mapping[int, JournalIndex]
) -> Iterator[str]:
    """Yield the prisms that poses place too early or too late on their paths.

    A pose that is late by dt is off by -v dt where the robot moves at v: regressed on all valid poses, by blocks. The stamps have
    errors of their own, which the poses inherit: their mean over the stations is subtracted, their deviation from it allowed,
    because the robot is rigid and each prism gets its share of every station's error.
    """
    parameters = result.parameters
    if len(parameters.prisms) < MIN_PRISMS:
        return
    positions_m = {prism.prism: np.array(prism.position_m) for prism in parameters.prisms}
    valid = master_log.valid_poses()
    for series in np.unique(valid.series[valid.series != "predicted"]).tolist():
        poses = valid.select(np.flatnonzero(valid.series == series)[::_STRIDE])
        found = [
            stamp_errors_s(master_log, indices[station.station], station.latency_ns, poses.stamp_ns)
            for station in parameters.stations
        ]
        if any(each is None for each in found):
            continue
        stamp_errors = np.array(found)
        mean_s = stamp_errors.mean(axis=0)
        deviation_s = float(np.sqrt(np.mean((stamp_errors - mean_s) ** 2, axis=1)).max(initial=0.0))
        at_s = (poses.stamp_ns - master_log.unix_at_zero_ns) / 1e9
        estimated = transform_from(rotation_from_quaternion(poses.orientation_xyzw), poses.position_m)
        estimated = estimated @ invert(transform_of(parameters.reference_point))
        truth, ahead = (
            apparent_poses(result, master_log, times_s).T_station1_robot for times_s in (at_s, at_s + _STEP_S)
        )
        for prism, position_m in positions_m.items():
            true_m = transform_points(truth, position_m)
            velocity_mps = (transform_points(ahead, position_m) - true_m) / _STEP_S
            error_m = transform_points(estimated, position_m) - true_m + mean_s[:, None] * velocity_mps
            late = _lateness(at_s, error_m, velocity_mps)
            limit_s = MAX_LATENESS_S + deviation_s + (CHORD_S if series == "interpolated" else 0.0)
            if late is not None and abs(late[0]) > limit_s + SIGMAS * late[1]:
                yield (
                    f"{len(at_s)} {series} poses: prism {prism} is {1e3 * late[0]:.2f} ms late, sigma {1e3 * late[1]:.2f} ms, "
                    f"limit {1e3 * limit_s:.2f} ms and {SIGMAS:g} sigmas"
                )


def _lateness(
    at_s: NDArray[np.float64], error_m: NDArray[np.float64], velocity_mps: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Return by how much errors are late and the standard error, in s; None without enough motion."""
    blocks = np.unique((at_s / BLOCK_S).astype(np.int64), return_inverse=True)[1]
    products = np.bincount(blocks, np.sum(error_m * velocity_mps, axis=1))
    squares = np.bincount(blocks, np.sum(velocity_mps**2, axis=1))
    if np.count_nonzero(squares > 0.1 * squares.max(initial=0.0)) < MIN_BLOCKS:
        return None
    total = squares.sum()
    late_s = -products.sum() / total
    return float(late_s), float(np.sqrt(np.sum((products + late_s * squares) ** 2)) / total)


def stamp_errors_s(
    master_log: MasterLog, index: JournalIndex, latency_ns: int, at_ns: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    """Return the errors in s of a station's stamps, less its latency, interpolated at instants; None without measurements.

    They are those of the clocks and of the instrument's time on its station.
    """
    station = index.station_log.station
    reported = index.station_log.reported_distances
    true_ns = {(each.instrument_ms, round(each.distance_m, _DECIMALS)): each.true_ns for each in reported}
    found = []
    for measurement in master_log.measurements:
        if measurement.station != station or not usable(measurement):
            continue
        journalled = index.find(measurement)
        if journalled is None or journalled.instrument_time_ns is None:
            continue
        distance_m = round(journalled.slope_distance_m or 0.0, _DECIMALS)
        measured_ns = true_ns.get((journalled.instrument_time_ns // 1_000_000, distance_m))
        if measured_ns is not None:
            time_ns = measurement.stamp_ns - latency_ns
            found.append((time_ns, time_ns - master_log.unix_at_zero_ns - measured_ns))
    if not found:
        return None
    times_ns, errors_ns = np.array(sorted(found), dtype=np.int64).T
    errors_s: NDArray[np.float64] = np.interp(
        (at_ns - times_ns[0]) / 1e9, (times_ns - times_ns[0]) / 1e9, errors_ns / 1e9
    )
    return errors_s
