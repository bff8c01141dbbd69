"""What stamps of a slow instrument add to the errors of poses."""

from __future__ import annotations

from itertools import combinations, pairwise
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import usable
from tsgt.geometry import log_so3

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from tsgt.model import PolarMeasurement
    from tsgt.simulation.mission import JournalIndex, MissionResult, ValidPoses

LATE_S = 0.03
"""Delay of the stamps of a fit that began while responses took k times as long as usual, over k - 1: 70 ms are seen where k is
four. Nothing tells the client (docs/explanation/instrument-time.md).
"""

MEMORY_S = np.arange(0.0, 2.1, 0.5)
"""Ages of the measurements that poses rest on: the robot may have been faster when it was measured last."""

VELOCITY_S = 0.5
"""Late stamps that come and go displace a velocity by as much as a position, over this time: it is known from measurements of as long."""

_HALF_STEP_S = 0.05  # Of the differences that give the robot's speed


def late_stamp_tolerances(
    result: MissionResult, indices: Iterable[JournalIndex], at_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what late stamps may add to the errors of poses at true times, (N,): in m at the prisms' centroid and in rad, (N, 2)."""
    spans = [span for index in indices for span in _late_stamps(index)]
    ages = [_tolerances(result, spans, np.maximum(at_s - age_s, 0.0)) for age_s in MEMORY_S]
    return np.asarray(np.max(ages, axis=0))


def _tolerances(
    result: MissionResult, spans: list[tuple[float, float, float]], at_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """By how much a robot that is measured late, in spans as of :func:`_late_stamps`, is displaced at true times, (N,)."""
    late_s = np.zeros(len(at_s))
    for from_s, to_s, delay_s in spans:
        late_s[(at_s >= from_s) & (at_s < to_s)] = delay_s
    tolerances = np.zeros((len(at_s), 2))
    if late_s.any():
        before, after = result.true_poses(at_s - _HALF_STEP_S), result.true_poses(at_s + _HALF_STEP_S)
        prisms_m = np.array([each.position_m for each in result.parameters.prisms])
        moved = (after - before)[:, :3, :3] @ prisms_m.T + (after - before)[:, :3, 3:]
        tolerances[:, 0] = late_s * np.linalg.norm(moved, axis=1).max(axis=1) / (2 * _HALF_STEP_S)
        turned = np.linalg.norm(log_so3(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)), axis=1)
        tolerances[:, 1] = late_s * turned / (2 * _HALF_STEP_S)
        if len(prisms_m) > 1:  # of which one is measured late
            arm_m = min(float(np.linalg.norm(a - b)) for a, b in combinations(prisms_m, 2))
            tolerances[:, 1] += tolerances[:, 0] / arm_m
    return tolerances


def extrapolated_s(
    poses: ValidPoses,
    measurements: Sequence[PolarMeasurement],
    at_s: NDArray[np.float64],
    unix_at_zero_ns: int,
) -> NDArray[np.float64]:
    """Return how long before poses at true times, (N,), the prism was measured that had been unmeasured longest when they were published."""
    longest_s = np.zeros(len(at_s))
    for station in {each.station for each in measurements}:
        rows = [n for n, each in enumerate(measurements) if each.station == station and usable(each)]
        if not rows:
            continue
        newest_s = np.maximum.accumulate([(measurements[n].stamp_ns - unix_at_zero_ns) / 1e9 for n in rows])
        known = np.searchsorted(rows, poses.measurements_before)
        since_s = at_s - newest_s[np.maximum(known - 1, 0)]
        longest_s = np.maximum(longest_s, np.where(known > 0, since_s, 0.0))
    return longest_s


def stamps_are_late(indices: Iterable[JournalIndex], at_s: float) -> bool:
    """Whether a station's stamps are late at a true time."""
    return any(from_s <= at_s < to_s for index in indices for from_s, to_s, _ in _late_stamps(index))


def _late_stamps(index: JournalIndex) -> Iterator[tuple[float, float, float]]:
    """Yield begin, end and delay of the stamps of each fit of the instrument's clock that began while it was slower, in s.

    It begins with the client, and when the instrument is switched on again.
    """
    reported = index.station_log.reported_distances
    measured_ns = [each.true_ns for each in reported]
    begins_ns = [
        min(times_ns)
        for measurements in index.journalled_by_start
        if (times_ns := [time for each in measurements if (time := index.true_ns(each)) is not None])
    ]
    begins_ns += [each.true_ns for before, each in pairwise(reported) if each.switched_on_since(before)]
    for from_ns, to_ns in pairwise([*sorted(begins_ns), inf]):
        row = int(np.searchsorted(measured_ns, from_ns, side="right")) - 1
        if row >= 0 and (slowed_by := reported[row].slowed_by) > 1.0:
            yield from_ns / 1e9, to_ns / 1e9, LATE_S * (slowed_by - 1.0)
