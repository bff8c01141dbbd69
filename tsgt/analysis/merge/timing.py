"""Times on the master's clock of measurements that only a station's journal has. Sans-I/O.

Merging knows the clock samples after a measurement as well, so that times are interpolated between two synchronisations or
beacons. All station times here are on its CLOCK_MONOTONIC, which is never set; two journals of one boot share that clock.
docs/how-to/merge.md states the bounds.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.timesync import BeaconClock
from tsgt.timesync.two_way import RegressionFilter, interpolate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ClockSample
    from tsgt.timesync.two_way import ClockEstimate

_CONFIRMED = 2  # Minimal number of accepted clock samples in a synchronisation; a single one may be delayed
_MIN_RECEPTIONS_AFTER = 100
_MIN_TIME_AFTER_NS = 60_000_000_000  # Beacons before and after it count up to both limits
_MAX_LINK_DELAY_NS = 100_000_000  # RxDone is within a symbol, at most 33 ms, of the packet's end


class MasterTime(NamedTuple):
    """An instant on the master's Unix clock, with one sigma and a bound of its error, in ns."""

    unix_ns: int
    sigma_ns: int
    bound_ns: int


class BeaconReception(NamedTuple):
    """A beacon: station time of its reception with sigma, and time of transmission on the master's Unix clock."""

    received_ns: int
    sigma_ns: int
    sent_ns: int


class DeliveredTime(NamedTuple):
    """A delivered measurement: its time in the recording, and its time from beacons without link delay."""

    recorded_ns: int
    recorded_bound_ns: int
    computed: MasterTime


def times_from_synchronisations(
    synchronisations: Sequence[Sequence[ClockSample]], stamps_ns: Sequence[int]
) -> list[MasterTime | None]:
    """Convert increasing station times to the master's clock, using the two-way exchanges before and after each.

    There is at least one synchronisation, in the order of time, none empty. None between two that no single clock can
    explain.
    """
    clock = RegressionFilter()
    times: list[MasterTime | None] = [None] * len(stamps_ns)
    before: _ClockFix | None = None
    start, synchronised, broken = 0, 0, False
    for samples in synchronisations:
        updated = clock.update(samples)
        broken = broken or (updated.restarted and synchronised > 0)
        synchronised += 1
        if len(samples) - updated.rejected < _CONFIRMED:
            continue
        fix = _ClockFix(samples[-1].station_ns, clock.at(samples[-1].station_ns))
        until = bisect_right(stamps_ns, fix.station_ns)
        if before is not None and not broken:
            for index in range(start, until):
                times[index] = _between(before, fix, stamps_ns[index])
        if before is None or (synchronised == 2 and not broken):
            # The second synchronisation improves the times before the first: it determines the frequency.
            first = until if before is None else start
            times[:first] = [_master_time(clock.at(stamp_ns), stamp_ns) for stamp_ns in stamps_ns[:first]]
        before, start, broken = fix, until, False
    if not broken:
        times[start:] = [_master_time(clock.at(stamp_ns), stamp_ns) for stamp_ns in stamps_ns[start:]]
    return times


class _ClockFix(NamedTuple):
    """Station clock relative to the master's at the end of a synchronisation."""

    station_ns: int
    estimate: ClockEstimate


def _master_time(estimate: ClockEstimate, stamp_ns: int) -> MasterTime:
    return MasterTime(stamp_ns - estimate.offset_ns, estimate.sigma_ns, estimate.bound_ns)


def _between(before: _ClockFix, after: _ClockFix, stamp_ns: int) -> MasterTime:
    """Interpolate linearly between two synchronisations; the bound includes the effect of a changing frequency."""
    return _master_time(
        interpolate(before.estimate, before.station_ns, after.estimate, after.station_ns, stamp_ns), stamp_ns
    )


def times_from_beacons(
    receptions: Sequence[BeaconReception], stamps_ns: Sequence[int]
) -> list[MasterTime | None]:
    """Convert increasing station times to the master's clock, without the link delay: when a beacon received then was sent.

    Uses the beacons of one session before and after each, in the order of reception. None without receptions.
    """
    clock = BeaconClock()
    times: list[MasterTime | None] = []
    received_ns = [reception.received_ns for reception in receptions]
    taken = 0
    for stamp_ns in stamps_ns:
        enough = bisect_right(received_ns, stamp_ns) + _MIN_RECEPTIONS_AFTER
        while taken < len(receptions) and (
            taken < enough or received_ns[taken] < stamp_ns + _MIN_TIME_AFTER_NS
        ):
            reception = receptions[taken]
            clock.add(
                reception.received_ns,
                (reception.sent_ns - receptions[0].sent_ns) // 1000,
                reception.sigma_ns,
                unambiguous=True,
            )
            taken += 1
        instant = clock.at(stamp_ns)
        times.append(
            None
            if instant is None
            else MasterTime(
                receptions[0].sent_ns + round(1000 * instant.time_us),
                round(1000 * instant.sigma_us),
                math.ceil(1000 * instant.bound_us) + 1000,  # whole microseconds went in
            )
        )
    return times


def link_delay(delivered: Sequence[DeliveredTime]) -> tuple[int, int] | None:
    """Return link delay, which recorded times of delivered measurements include, and its bound, in ns; None if not fixed."""
    delays_ns = [each.recorded_ns - each.computed.unix_ns for each in delivered]
    if not delays_ns:
        return None
    delay_ns = round(median(delays_ns))
    # Each difference is correct within the sum of the two bounds; the tightest counts.
    bound_ns = min(
        each.recorded_bound_ns + each.computed.bound_ns + abs(each_ns - delay_ns)
        for each, each_ns in zip(delivered, delays_ns, strict=True)
    )
    return delay_ns, bound_ns


def times_consistent(recorded_ns: int, recorded_bound_ns: int, computed: MasterTime) -> bool:
    """Return whether a recorded time can be the one computed from beacons, whose link delay is not fixed."""
    return abs(recorded_ns - computed.unix_ns) <= recorded_bound_ns + computed.bound_ns + _MAX_LINK_DELAY_NS


def add_link_delay(computed: MasterTime, delay_ns: int, bound_ns: int) -> MasterTime:
    """Add the link delay to a time computed from beacons."""
    return MasterTime(
        computed.unix_ns + delay_ns,
        round(math.hypot(computed.sigma_ns, bound_ns / 5)),
        computed.bound_ns + bound_ns,
    )
