"""Liveness of poses without faults: where every prism is measured often enough, poses are valid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import usable
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.simulation.mission import MasterLog, MissionResult

START_S = 5.0
"""Poses are expected from this long after the first measurement of the last station."""

MIN_EXPECTED = 100
"""Minimum number of expected poses that are checked: 5 s at 20 Hz."""

MIN_VALID_SHARE = 0.7
"""Minimum share of the expected poses that are valid."""


def missing_poses(result: MissionResult) -> Iterator[str]:
    """Yield the masters' processes in a mission without faults that have fewer valid poses than their measurements allow.

    Fewer than three stations need an IMU, whose set-up a drive has to confirm first: nothing is expected of them, nor of stations
    that have moved and contradict each other.
    """
    if result.faults_end_s is not None or result.moves or len(result.parameters.prisms) < MIN_PRISMS:
        return
    for master_log in result.master_logs:
        expected = len(measured_epochs(master_log, result.in_force(master_log)))
        if expected < MIN_EXPECTED:
            continue
        poses = master_log.valid_poses()
        for series in _series(master_log):
            valid = np.count_nonzero(poses.series == series)
            if valid < MIN_VALID_SHARE * expected:
                yield (
                    f"{valid} valid {series} poses; by the measurements {expected} were possible, "
                    f"minimum share {MIN_VALID_SHARE:g}"
                )


def _series(master_log: MasterLog) -> list[str]:
    """Return the series that end with the measurements on both sides, published with or without valid poses."""
    return [name for name in master_log.pose_counts if name in ("interpolated", "smoothed")]


def measured_epochs(master_log: MasterLog, result: MissionResult) -> NDArray[np.int64]:
    """Return the epochs in ns at which all prisms have a measurement before and after, not too far from each other.

    One that took longer than the transport limit came too late.
    """
    pipeline = result.parameters.pipeline
    times_ns: dict[int, list[int]] = {prism.prism: [] for prism in result.parameters.prisms}
    for measurement in master_log.measurements:
        delay_ns = measurement.received_ns - measurement.stamp_ns
        if usable(measurement) and measurement.prism in times_ns and delay_ns <= pipeline.transport_limit_ns:
            times_ns[measurement.prism].append(measurement.stamp_ns)
    if not all(times_ns.values()):
        return np.zeros(0, dtype=np.int64)
    tracks = [np.sort(np.array(each, dtype=np.int64)) for each in times_ns.values()]
    begin_ns = max(int(track[0]) for track in tracks) + round(START_S * 1e9)
    epochs_ns = np.arange(
        begin_ns, min(int(track[-1]) for track in tracks), pipeline.period_ns, dtype=np.int64
    )
    found = np.ones(len(epochs_ns), dtype=np.bool_)
    for track in tracks:
        after = track.searchsorted(epochs_ns)
        found &= track[after] - track[after - 1] <= pipeline.outage_limit_ns
    return epochs_ns[found]
