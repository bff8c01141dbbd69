"""Arbitrary output of a bridge program: only plausible measurements become readings."""

from __future__ import annotations

import json
import math
from collections import deque
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from harness.files.damage import Damage, damages, examples
from harness.instruments.bridge import HELLO, measured
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from tsgt.service import LineSplitter, RejectedLines
from tsgt.simulation.kernel import VirtualClock, run_virtual
from tsgt.station.bridge.session import BridgeSession
from tsgt.station.bridge.timing import MAX_AGE_NS, LineTimestamper

if TYPE_CHECKING:
    from tsgt.station import Reading

STAMPS = ("host", "instrument", "arrival")


@given(st.binary(max_size=300), st.lists(st.integers(0, 300)), st.integers(1, 50))
def test_splitting_is_independent_of_pieces(data: bytes, cuts: list[int], limit_bytes: int) -> None:
    """The lines are the same, and none exceeds its limit."""
    cutter = LineSplitter(limit_bytes)
    lines = []
    for begin, end in pairwise(sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})):
        lines += cutter.push(data[begin:end])
    whole = [line[:limit_bytes] for line in data.split(b"\n")[:-1]]
    assert lines == [line for line in whole if line.strip()]


odd: st.SearchStrategy[Any] = st.sampled_from(
    [None, True, -1, 0, 2, 7, 1e-9, 1e300, math.nan, -math.inf, 10**30, "", "ok", "tilt", "no_target", [], {}]
)
kinds = st.sampled_from(["measurement"] * 4 + ["shot", "done", "status", "settings", "hello", "weather"])
ages_ns = st.none() | st.integers(-(10**6), 10**9) | st.integers(-(2**63), 2**64)

lines = st.tuples(
    kinds,
    st.dictionaries(st.sampled_from([*measured(), "raw_status", "prism", "id", "problem"]), odd, max_size=2),
    st.integers(0, 10**9),
    ages_ns,
)
"""Type, possibly invalid fields, delay after the previous line, and age on arrival."""


@given(st.sampled_from(STAMPS), st.lists(lines, max_size=20), st.binary(max_size=20))
def test_readings_are_plausible(
    stamps: str, printed: list[tuple[str, dict[str, Any], int, int | None]], garbage: bytes
) -> None:
    """No line raises; every usable reading has valid angles, distance and time, each time once."""
    readings: deque[Reading] = deque()

    async def main() -> None:
        clock = VirtualClock(0)
        run = BridgeSession(
            "bridge", clock, LineTimestamper(0), readings, RejectedLines(clock, lambda *_: None)
        )
        now_ns = 20 * 10**9
        run.output_received(json.dumps(HELLO | {"stamps": stamps}).encode() + b"\n", now_ns)
        run.set_tracking(1)
        for kind, wrong, after_ns, age_ns in printed:
            record = measured() | {"type": kind, "id": 1} | wrong
            now_ns += after_ns
            if age_ns is not None:
                record |= {"host_time_ns": now_ns - age_ns, "instrument_time_ns": now_ns - age_ns + 77}
            run.output_received(garbage + b"\n" + json.dumps(record).encode() + b"\n", now_ns)

    with capture_logs():
        run_virtual(main)
    usable = [reading for reading in readings if reading.status.usable]
    assert all(before.at_ns < after.at_ns for before, after in pairwise(usable))
    for reading in usable:
        assert reading.prism == 1
        assert 0 <= reading.horizontal_angle_rad <= 2 * math.pi
        assert 0 <= reading.zenith_angle_rad <= 2 * math.pi
        assert reading.slope_distance_m is not None
        assert reading.slope_distance_m > 0
        assert reading.received_ns is not None
        assert 0 <= reading.received_ns - reading.at_ns <= MAX_AGE_NS


TRANSCRIPT = [
    b"".join(
        json.dumps(record).encode() + b"\n"
        for record in (
            HELLO | {"stamps": "arrival"},
            measured(),
            measured() | {"type": "status", "status": "tracking"},
            measured() | {"type": "shot", "id": 1},
            {"type": "done", "id": 1},
            {"type": "settings", "prism_constant_m": 0.03, "atmospheric_ppm": 8.0},
            measured(),
        )
    )
]


@examples(60)
@given(damage=damages, cuts=st.lists(st.integers(0, 2000), max_size=5))
def test_damaged_output_gives_plausible_readings(damage: Damage, cuts: list[int]) -> None:
    """Nothing is raised."""
    readings: deque[Reading] = deque()
    output = damage.to(TRANSCRIPT)

    async def main() -> None:
        clock = VirtualClock(0)
        run = BridgeSession(
            "bridge", clock, LineTimestamper(0), readings, RejectedLines(clock, lambda *_: None)
        )
        now_ns = 20 * 10**9
        run.set_tracking(1)
        for begin, end in pairwise(sorted({0, len(output), *(cut for cut in cuts if cut < len(output))})):
            now_ns += 10**6
            run.output_received(output[begin:end], now_ns)
        run.output_received(b"\n", now_ns)

    with capture_logs():
        run_virtual(main)
    for reading in readings:
        if reading.status.usable:
            assert 0 <= reading.horizontal_angle_rad <= 2 * math.pi
            assert reading.slope_distance_m is not None
            assert 0 < reading.slope_distance_m < math.inf
