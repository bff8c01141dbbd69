"""Measurements that reached the master's radio over protocol classic, against those that it published."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

from tsgt.radio.classic import MeasurementMessage, status_of
from tsgt.radio.classic.messages import decode_reply

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.model import PolarMeasurement
    from tsgt.simulation.mission import MasterLog


def unpublished_replies(master_log: MasterLog) -> Iterator[str]:
    """Yield the replies to polls whose measurement was not published.

    A measurement may be held until the next synchronisation, which may show that its time is unknown. So it must have been
    published only if one of the same station was before and one after it, without a synchronisation of the station between.
    """
    published: dict[int, list[tuple[PolarMeasurement, int]]] = defaultdict(list)
    for measurement, arrived_ns in zip(master_log.measurements, master_log.arrived_ns, strict=False):
        published[measurement.station].append((measurement, arrived_ns + master_log.unix_at_zero_ns))
    synchronised: dict[int, list[int]] = defaultdict(list)
    for clock in master_log.clocks:
        synchronised[clock.station].append(clock.stamp_ns)
    known = {(m.station, m.host_time_ns) for m in master_log.measurements}
    for reply in master_log.poll_replies:
        message = decode_reply(reply.payload)
        if (
            not isinstance(message, MeasurementMessage)
            or not message.time_ns
            or not status_of(message).usable
        ):
            continue
        if (reply.station, message.time_ns) in known:
            continue
        received_ns = reply.received_at_ns + master_log.unix_at_zero_ns
        before_ns = max(
            (m.received_ns for m, _ in published[reply.station] if m.received_ns < received_ns), default=None
        )
        after_ns = min(
            (at_ns for m, at_ns in published[reply.station] if m.received_ns > received_ns), default=None
        )
        if before_ns is None or after_ns is None:
            continue
        if any(before_ns <= stamp_ns <= after_ns for stamp_ns in synchronised[reply.station]):
            continue
        yield (
            f"station {reply.station}: its measurement with host time {message.time_ns} ns arrived at "
            f"{reply.received_at_ns / 1e9:.3f} s, but was not published"
        )
