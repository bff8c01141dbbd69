"""Arbitrary output of a program that reads an IMU: only plausible samples become records."""

from __future__ import annotations

import json
import math
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any

from harness.files.damage import Damage, damages, examples
from harness.inertial.imu import HELLO, samples
from hypothesis import given
from hypothesis import strategies as st

from tsgt.imu.lines import MAX_ANGULAR_RATE_RADPS, MAX_SPECIFIC_FORCE_MPS2
from tsgt.imu.sampler import MAX_AGE_NS, MAX_AHEAD_NS, Sampler
from tsgt.imu.session import ImuSession
from tsgt.service import RejectedLines
from tsgt.simulation.kernel import VirtualClock, run_virtual

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import ImuSamples

START_NS = 20 * 10**9

Piece = tuple[int, bytes]


def records(pieces: Sequence[Piece]) -> list[ImuSamples]:
    """Return the records of pieces of output, each a time after the one before."""
    found: list[ImuSamples] = []

    async def main() -> None:
        clock = VirtualClock(0)
        session = ImuSession(
            "imu",
            clock,
            Sampler(0),
            RejectedLines(clock, lambda *_: None),
            stall_timeout_s=2.0,
            on_hello=lambda _: None,
            on_samples=found.append,
        )
        now_ns = START_NS
        for after_ns, piece in pieces:
            now_ns += after_ns
            session.output_received(piece, now_ns)

    run_virtual(main)
    return found


def check(found: list[ImuSamples]) -> None:
    """Check that times are in order, not ahead of arrival, not old; values are those of an IMU; nothing counts twice."""
    for before, after in pairwise(found):
        assert before.sequence + len(before.stamp_ns) <= after.sequence
    stamps = list(chain.from_iterable(record.stamp_ns for record in found))
    assert all(before < after for before, after in pairwise(stamps))
    for record in found:
        assert all(-MAX_AGE_NS * 2 <= stamp - record.received_ns <= MAX_AHEAD_NS for stamp in record.stamp_ns)
        for values, limit in (
            (record.angular_rate_radps, MAX_ANGULAR_RATE_RADPS),
            (record.specific_force_mps2, MAX_SPECIFIC_FORCE_MPS2),
        ):
            assert all(math.isfinite(value) and abs(value) <= limit for value in chain.from_iterable(values))


odd: st.SearchStrategy[Any] = st.sampled_from(
    [None, True, -1, 0, 7, 1e300, math.nan, 10**30, "", [], {}, [1], [-1, 0], [2**63, 5], [[0, 0, 1e9]] * 5]
)
lines = st.tuples(
    st.integers(0, 3 * 10**8),
    st.sampled_from([5, 5, 5, 0, -3, 400, 10**6]),
    st.dictionaries(
        st.sampled_from([*samples(0, 1, 0), "delta_angle_rad", "delta_velocity_mps"]), odd, max_size=2
    ),
    st.integers(-(10**7), 10**9) | st.just(10**12),
)
"""Time after the line before, samples further on, wrong fields, and age on arrival."""


@examples(60)
@given(st.lists(lines, max_size=12), st.binary(max_size=20))
def test_records_are_plausible(printed: list[tuple[int, int, dict[str, Any], int]], garbage: bytes) -> None:
    """No line raises, before and after the clock is fitted."""
    pieces = [(0, json.dumps(HELLO).encode() + b"\n")]
    number, now_ns = 10**6, START_NS
    for _ in range(12):
        number, now_ns = number + 10, now_ns + 50_000_000
        line = samples(number, 10, now_ns - 50_000_000)
        pieces.append((50_000_000, json.dumps(line).encode() + b"\n"))
    for after_ns, further, wrong, age_ns in printed:
        number, now_ns = number + further, now_ns + after_ns
        line = samples(max(number, 0), 5, max(now_ns - age_ns, 0)) | wrong
        pieces.append((after_ns, garbage + b"\n" + json.dumps(line).encode() + b"\n"))
    check(records(pieces))


TRANSCRIPT = [
    b"".join(
        json.dumps(line).encode() + b"\n"
        for line in (
            HELLO | {"rate_hz": 20.0},
            *(samples(n, 1, instrument_time_ns=[n * 50_000_000]) for n in range(30)),
            {"type": "status", "activity": "measures"},
            samples(30, 2, instrument_time_ns=[1_500_000_000, 1_550_000_000]),
        )
    )
]


@examples(60)
@given(damage=damages)
def test_damaged_output_gives_plausible_records(damage: Damage) -> None:
    """Nothing is raised."""
    output = damage.to(TRANSCRIPT)
    check(records([(50_000_000, line + b"\n") for line in output.split(b"\n")]))


def test_undamaged_output_gives_all_samples() -> None:
    """So that the property above is about something."""
    found = records([(50_000_000, line + b"\n") for line in TRANSCRIPT[0].split(b"\n")])
    assert sum(len(record.stamp_ns) for record in found) >= 31
