"""When measurements were made that only a station's journal has. Pure.

Who merges knows more than the master did: what came after. So a time between two synchronisations, or two beacons, is
taken from both of them. All times of a station are on its CLOCK_MONOTONIC here, which nobody sets; two journals of one
start of a computer therefore share a clock. docs/how-to/merge.md says what the bounds come to.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.timesync import BeaconClock
from tsgt.timesync.offset_regression import interpolation_wander_ns
from tsgt.timesync.two_way import RegressionFilter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ClockSample
    from tsgt.timesync.two_way import ClockEstimate

_CONFIRMED = 2
"""So many stamps of a synchronisation confirm each other; one alone may be late."""

_FEWEST_PAIRS = 100
_LEAST_NS = 60_000_000_000
"""A time is taken from the beacons before it, and from so many, over at least so long, after it: no others count."""

_WAY_MOST_NS = 100_000_000
"""No link constant is longer: RxDone comes within a symbol of the packet's end, and none lasts longer than 33 ms."""


class MasterTime(NamedTuple):
    """An instant on the master's Unix clock, in ns.

    Attributes
    ----------
    unix_ns
        The instant.
    sigma_ns
        One sigma of it.
    bound_ns
        The truth is within this.
    """

    unix_ns: int
    sigma_ns: int
    bound_ns: int


class Pair(NamedTuple):
    """A beacon: when the station received it, and when the master had sent it on its Unix clock."""

    received_ns: int
    sigma_ns: int
    sent_ns: int


class Told(NamedTuple):
    """A measurement that the radio has delivered: when the recording says it was made, and when the beacons do."""

    recorded_ns: int
    recorded_bound_ns: int
    found: MasterTime


def times_from_synchronisations(
    synchronisations: Sequence[Sequence[ClockSample]], stamps_ns: Sequence[int]
) -> list[MasterTime | None]:
    """Put times of a station on the master's clock, by two-way exchanges before and after them.

    Parameters
    ----------
    synchronisations
        Exchanges with the station, in the order of time; at least one in each, and at least one.
    stamps_ns
        In rising order.

    Returns
    -------
    list[MasterTime | None]
        One for each; None between two synchronisations that no one clock can have made.
    """
    clock = RegressionFilter()
    times: list[MasterTime | None] = [None] * len(stamps_ns)
    before: _Known | None = None
    place, synchronised, broken = 0, 0, False
    for samples in synchronisations:
        updated = clock.update(samples)
        broken = broken or (updated.restarted and synchronised > 0)
        synchronised += 1
        if len(samples) - updated.rejected < _CONFIRMED:
            continue
        known = _Known(samples[-1].station_ns, clock.at(samples[-1].station_ns))
        until = bisect_right(stamps_ns, known.station_ns)
        if before is not None and not broken:
            for index in range(place, until):
                times[index] = _between(before, known, stamps_ns[index])
        if before is None or (synchronised == 2 and not broken):
            # The second synchronisation says more of the time before the first than that itself: the frequency.
            first = until if before is None else place
            times[:first] = [_on_line(clock, stamp_ns) for stamp_ns in stamps_ns[:first]]
        before, place, broken = known, until, False
    if not broken:
        times[place:] = [_on_line(clock, stamp_ns) for stamp_ns in stamps_ns[place:]]
    return times


class _Known(NamedTuple):
    """What the clock showed against the master's at the end of a synchronisation."""

    station_ns: int
    estimate: ClockEstimate


def _on_line(clock: RegressionFilter, stamp_ns: int) -> MasterTime:
    estimate = clock.at(stamp_ns)
    return MasterTime(stamp_ns - estimate.offset_ns, estimate.sigma_ns, estimate.bound_ns)


def _between(before: _Known, after: _Known, stamp_ns: int) -> MasterTime:
    """Return a time on the straight line between two synchronisations, and what a changing frequency may have done."""
    since_ns, until_ns = stamp_ns - before.station_ns, after.station_ns - stamp_ns
    share = since_ns / (since_ns + until_ns)
    one, other = before.estimate, after.estimate
    offset_ns = one.offset_ns + round(share * (other.offset_ns - one.offset_ns))
    sag = interpolation_wander_ns(since_ns / 1e9, until_ns / 1e9)
    return MasterTime(
        stamp_ns - offset_ns,
        # The sag is a limit; frequencies change by a third of it at most, as a rule.
        round(math.hypot((1 - share) * one.sigma_ns + share * other.sigma_ns, sag / 3)),
        math.ceil((1 - share) * one.bound_ns + share * other.bound_ns + sag),
    )


def times_from_beacons(pairs: Sequence[Pair], stamps_ns: Sequence[int]) -> list[MasterTime | None]:
    """Put times of a station on the master's clock, by beacons before and after them, but for the link constant.

    Parameters
    ----------
    pairs
        Beacons of one session of the master, in the order of reception.
    stamps_ns
        In rising order.

    Returns
    -------
    list[MasterTime | None]
        One for each: when a beacon would have been sent that arrived then. None without pairs.
    """
    clock = BeaconClock()
    times: list[MasterTime | None] = []
    received_ns = [pair.received_ns for pair in pairs]
    taken = 0
    for stamp_ns in stamps_ns:
        enough = bisect_right(received_ns, stamp_ns) + _FEWEST_PAIRS
        while taken < len(pairs) and (taken < enough or received_ns[taken] < stamp_ns + _LEAST_NS):
            pair = pairs[taken]
            clock.add(
                pair.received_ns, (pair.sent_ns - pairs[0].sent_ns) // 1000, pair.sigma_ns, unambiguous=True
            )
            taken += 1
        instant = clock.at(stamp_ns)
        times.append(
            None
            if instant is None
            else MasterTime(
                pairs[0].sent_ns + round(1000 * instant.time_us),
                round(1000 * instant.sigma_us),
                math.ceil(1000 * instant.bound_us) + 1000,  # whole microseconds went in
            )
        )
    return times


def link_constant(told: Sequence[Told]) -> tuple[int, int] | None:
    """Return what the master has added to the times of a station for the way of a beacon, and a bound of it, in ns.

    The recording has this constant in the times of what was delivered. None where nothing tells it.
    """
    ways_ns = [each.recorded_ns - each.found.unix_ns for each in told]
    if not ways_ns:
        return None
    middle_ns = round(median(ways_ns))
    # What both say is right within the sum of their bounds, for each of them; one is enough.
    bound_ns = min(
        each.recorded_bound_ns + each.found.bound_ns + abs(way_ns - middle_ns)
        for each, way_ns in zip(told, ways_ns, strict=True)
    )
    return middle_ns, bound_ns


def times_consistent(recorded_ns: int, recorded_bound_ns: int, found: MasterTime) -> bool:
    """Tell whether a time in the recording can be the one that was found by beacons, without the link constant."""
    return abs(recorded_ns - found.unix_ns) <= recorded_bound_ns + found.bound_ns + _WAY_MOST_NS


def add_link_delay(found: MasterTime, way_ns: int, bound_ns: int) -> MasterTime:
    """Add the link constant to a time that was found by beacons."""
    return MasterTime(
        found.unix_ns + way_ns,
        round(math.hypot(found.sigma_ns, bound_ns / 5)),
        found.bound_ns + bound_ns,
    )
