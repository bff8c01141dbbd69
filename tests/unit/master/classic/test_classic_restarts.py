"""Restarts of a station whose responses are lost: the master detects each before it uses the new clock."""

from __future__ import annotations

import asyncio
from itertools import count
from typing import TYPE_CHECKING

import pytest
from harness.hardware.radios import MS
from harness.radio.single_station import SECOND, single_station

if TYPE_CHECKING:
    from harness.radio.single_station import SingleStation

STEP_NS = 30 * MS
"""Less than a measurement's time can show, more than a stamp's bound."""


def outside(field: SingleStation) -> list[tuple[int, int]]:
    """Return the stamps that were off by more than their bound, and that bound; in ns."""
    return [
        (error_ns, bound_ns) for error_ns, bound_ns in field.timestamp_errors_ns if abs(error_ns) > bound_ns
    ]


@pytest.mark.parametrize("lost", range(12))
async def test_restart_is_detected_after_lost_responses(lost: int) -> None:
    """Within five seconds; after a longer silence the master suspends the clock anyway."""
    async with single_station() as field:
        await asyncio.sleep(20.0)
        field.station = None
        await asyncio.sleep(0.5)
        field.restart(STEP_NS)
        answers = count()
        field.is_lost = lambda _: next(answers) < lost
        before = len(field.timestamp_errors_ns)
        await asyncio.sleep(40.0)
    assert len(field.timestamp_errors_ns) > before
    assert outside(field) == []


def restart_at(field: SingleStation, request: bytes, *, cycle: int, step_ns: int) -> list[int]:
    """Kill the station before a request of a cycle, restart it 0.6 s later with its clock stepped; return when it was killed."""
    killed_ns: list[int] = []

    def before(payload: bytes) -> int:
        now_ns = field.clock.monotonic_ns()
        if payload == request and field.count(b"e1") == cycle and not killed_ns:
            killed_ns.append(now_ns)
            field.station = None
        elif field.station is None and now_ns - killed_ns[0] > 600 * MS:
            field.restart(step_ns)
        return 0

    field.before_request = before
    return killed_ns


@pytest.mark.parametrize("step_ns", [STEP_NS, 1_500_000])
async def test_restart_within_a_synchronisation_is_detected(step_ns: int) -> None:
    """The restarted client is pinged, so it does not report its restart, but that reply is lost: all samples precede it.

    The command to track is repeated and a third synchronisation follows at once; no step is taken for a skew.
    """
    async with single_station() as field:
        # 50 cycles at the start, then three of the second synchronisation.
        killed_ns = restart_at(field, b"e1", cycle=53, step_ns=step_ns)
        field.is_lost = lambda payload: payload == b"e1" and field.count(b"e1") == 55
        await asyncio.sleep(60.0)
    assert killed_ns
    assert outside(field) == []
    assert field.count(b"n11") == len(field.clocks) - 1 == 2
    assert abs(field.clocks[-1].frequency_ppm) < 5


async def test_samples_before_a_restart_are_not_used() -> None:
    """Four of five cycles precede it, and an offset of 3 ms looks like a late stamp."""
    async with single_station() as field:
        # 50 cycles at the start, then four of the second synchronisation.
        killed_ns = restart_at(field, b"s1", cycle=54, step_ns=3 * MS)
        await asyncio.sleep(60.0)
    assert killed_ns
    assert outside(field) == []
    assert field.count(b"n11") == 2


async def test_restart_before_a_synchronisation_without_samples_is_detected() -> None:
    """The first ping is answered, then everything is lost for a second."""
    answers = count()
    begun_ns: list[int] = []
    async with single_station() as field:

        def before(payload: bytes) -> int:
            if payload == b"p1" and field.count(b"p1") == 1 and not begun_ns:
                begun_ns.append(field.clock.monotonic_ns())
                field.restart(STEP_NS)
                return 700 * MS
            return 0

        field.before_request = before
        field.is_lost = lambda _: bool(begun_ns) and 1 <= next(answers) <= 3
        await asyncio.sleep(60.0)
    assert begun_ns
    assert begun_ns[0] > 40 * SECOND
    assert outside(field) == []
    assert field.count(b"n11") == len(field.clocks) == 2
