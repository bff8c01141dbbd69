"""Acknowledgements of delivered measurements in the stations' journals (superframe)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tsgt.simulation.mission import JournalIndex, MissionResult

ACKNOWLEDGEMENT_TIMEOUT_S = 20.0
"""Maximum time from delivery to the journal's record of the acknowledgement. A beacon acknowledges within a second or two; the
journal records it at most every five.
"""


def missing_acknowledgements(result: MissionResult, indices: Mapping[int, JournalIndex]) -> Iterator[str]:
    """Yield delivered measurements that are still in their stations' queues by the journals.

    A restarted client would deliver them again. A journal without any record of an acknowledgement counts from its first
    measurement.
    """
    if not result.superframe:
        return
    master_log = result.master_logs[-1]
    oldest = {number: index.oldest_queued() for number, index in indices.items()}
    for measurement, arrived_ns in zip(master_log.measurements, master_log.arrived_ns, strict=False):
        waited_s = result.duration_s - arrived_ns / 1e9
        if measurement.sequence == oldest[measurement.station] and waited_s > ACKNOWLEDGEMENT_TIMEOUT_S:
            yield (
                f"station {measurement.station}: sequence number {measurement.sequence} unacknowledged {waited_s:.0f} s "
                f"after its delivery, limit {ACKNOWLEDGEMENT_TIMEOUT_S:g} s"
            )
