"""Acknowledgements of delivered measurements in the stations' journals (superframe)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tsgt.simulation.mission import JournalIndex, MissionResult

ACKNOWLEDGEMENT_TIMEOUT_S = 20.0
"""Maximum time from the delivery of a measurement and of all before it to the journal's record of the acknowledgement. A beacon
acknowledges within a second or two; the journal records it at most every five. If that beacon is lost, the cumulative acknowledgement
follows, which waits for those before it.
"""


def missing_acknowledgements(result: MissionResult, indices: Mapping[int, JournalIndex]) -> Iterator[str]:
    """Yield delivered measurements that are still in their stations' queues by the journals.

    A restarted client would deliver them again. A journal without any record of an acknowledgement counts from its first
    measurement.
    """
    if not result.superframe:
        return
    master_log = result.master_logs[-1]
    measurements = list(zip(master_log.measurements, master_log.arrived_ns, strict=False))
    for number, index in indices.items():
        oldest = index.oldest_queued()
        before_ns = {
            measurement.sequence: arrived_ns
            for measurement, arrived_ns in measurements
            if oldest is not None and measurement.station == number and measurement.sequence <= oldest
        }
        waited_s = result.duration_s - max(before_ns.values(), default=0) / 1e9
        if oldest in before_ns and waited_s > ACKNOWLEDGEMENT_TIMEOUT_S:
            yield (
                f"station {number}: sequence number {oldest} unacknowledged {waited_s:.0f} s after its delivery and that of all "
                f"before it, limit {ACKNOWLEDGEMENT_TIMEOUT_S:g} s"
            )
