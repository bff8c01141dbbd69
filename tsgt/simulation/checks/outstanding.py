"""The number of outstanding measurements in the status, against what clients have read and the master has published."""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.simulation.mission import MissionResult

HEARD_S = 1.0
"""A station that was heard less than this ago has told how many it has."""

MAX_DIFFERENCE = 4
"""The number is that of the last reply: what was measured since, and what that reply brought, differ."""

MAX_WRONG_SHARE, MIN_STATUSES = 0.1, 20


def outstanding_failures(result: MissionResult) -> Iterator[str]:
    """Yield the stations whose outstanding measurements are often miscounted, in missions without faults.

    A client that was started on a failing disk skips numbers, which count as outstanding.
    """
    if result.faults_end_s is not None or not result.superframe or len(result.master_logs) > 1:
        return
    (master_log,) = result.master_logs
    for number, station_log in result.station_logs.items():
        read_ns = sorted(station_log.read_times_ns.values())
        delivered_ns = [
            arrived_ns
            for measurement, arrived_ns in zip(master_log.measurements, master_log.arrived_ns, strict=False)
            if measurement.station == number
        ]
        differences = []
        for status in master_log.statuses:
            at_ns = status.stamp_ns - master_log.unix_at_zero_ns
            station = next((each for each in status.stations if each.id == number), None)
            if station is None or station.outstanding is None or not station.joined:
                continue
            if station.last_heard_s is not None and station.last_heard_s < HEARD_S:
                true = bisect_right(read_ns, at_ns) - bisect_right(delivered_ns, at_ns)
                differences.append(station.outstanding - true)
        wrong = sum(abs(difference) > MAX_DIFFERENCE for difference in differences)
        if len(differences) >= MIN_STATUSES and wrong > MAX_WRONG_SHARE * len(differences):
            worst = max(differences, key=abs)
            yield (
                f"station {number}: {wrong} of {len(differences)} numbers of outstanding measurements are wrong, by up to {worst}"
            )
