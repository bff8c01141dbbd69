"""Synchronisation exchanges for the tests of the clock filters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.model import ClockSample

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

SECOND = 1_000_000_000
START_NS = 1_700_000_000 * SECOND
WAY_NS = 55_314_560


def exchange(
    sent_ns: int, offset_ns: Callable[[int], float], *, late_ns: int = 0, turnaround_ns: int = 1_000_000
) -> ClockSample:
    """Make an exchange with a clock that is ahead by a function of the true time since the start."""
    stamped_ns = sent_ns + WAY_NS + late_ns
    return ClockSample(
        sent_ns=START_NS + sent_ns,
        station_ns=START_NS + stamped_ns + round(offset_ns(stamped_ns)),
        received_ns=START_NS + stamped_ns + turnaround_ns + WAY_NS,
        forward_ns=WAY_NS,
        back_ns=WAY_NS,
    )


def synchronisation(
    start_s: float,
    offset_ns: Callable[[int], float],
    *,
    cycles: int = 5,
    late_ns: Sequence[int] = (),
    turnaround_ns: int = 1_000_000,
) -> list[ClockSample]:
    """Make a synchronisation; ``late_ns`` are the delays of its first timestamps."""
    late = [*late_ns, *[0] * (cycles - len(late_ns))]
    return [
        exchange(
            round((start_s + 0.24 * n) * SECOND), offset_ns, late_ns=late[n], turnaround_ns=turnaround_ns
        )
        for n in range(cycles)
    ]


def drifting(offset_ns: float, ppm: float) -> Callable[[int], float]:
    """Return the offset of a clock with constant skew."""
    return lambda true_ns: offset_ns + ppm * 1e-6 * true_ns
