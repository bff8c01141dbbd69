"""A station that was without radio contact for hours, in the loop of master and stations."""

from __future__ import annotations

import sys
from dataclasses import replace
from random import Random
from typing import TYPE_CHECKING, Any

import pytest
from harness.radio.scripted_master import SECOND, TRACKING, ScriptedMaster, make_station, queued
from harness.radio.scripted_stations import KEY, TIMING
from harness.radio.superframe_loop import MS, SuperframeLoop

from tsgt.radio.superframe import SendQueue
from tsgt.radio.superframe.wire import RESTART_SKIP, Authenticator

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    from tsgt.radio.superframe import BeaconReception, QueuedMeasurement

HOUR_NS = 3600 * SECOND
HOURS = 1.0
STEP_NS = 600_000 * MS
"""The master runs on without hearing the station; a frame in ten minutes is enough for that."""
MIN_DRAIN_HZ = 5.0
"""Twice the rate at which the station measures on."""


@pytest.mark.slow
def test_backlog_of_hours_arrives_with_right_times() -> None:
    """All of it, while the other stations deliver, and faster than the station measures on."""
    loop = SuperframeLoop(TIMING, Authenticator(KEY), Random(1).getrandbits)  # noqa: S311 (a test has no secrets)
    for _ in range(60):
        loop.run_frame()
    station = loop.members[2]
    back_ns = loop.now_ns + round(HOURS * 3600e3) * MS
    while loop.now_ns < back_ns:
        loop.now_ns += STEP_NS
        for number in (1, 3):
            loop.members[number].next_ns = loop.now_ns
        loop.run_frame(missed_by=(2,))
    back_ns = loop.now_ns
    loop.run_frame()
    backlog = len(station.made_ns) - len(station.received)
    while loop.now_ns < back_ns + backlog / MIN_DRAIN_HZ * 1e9 and len(station.received) < len(
        station.made_ns
    ):
        loop.run_frame()
    assert backlog > 8900
    assert set(range(backlog)) <= station.received.keys()
    errors_ns = station.errors_ns()
    assert all(abs(errors_ns[number]) <= station.received[number].bound_ns for number in errors_ns)


# --- Work per frame -------------------------------------------------------------------------------------------


def operations(call: Callable[[], object]) -> int:
    """Return how many bytecodes a call executes."""
    count = 0

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal count
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        count += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count


def of_unknown_clock(count: int) -> tuple[list[QueuedMeasurement], list[BeaconReception]]:
    """Return measurements of an earlier boot that did not hear this master."""
    return [queued(number, number * SECOND, boot="before") for number in range(count)], []


def out_of_reach(count: int) -> tuple[list[QueuedMeasurement], list[BeaconReception]]:
    """Return measurements of an earlier boot, made hours before and hours after it heard this master."""
    station, master = make_station(SendQueue(0)), ScriptedMaster(now_ns=20 * HOUR_NS)
    received = []
    for _ in range(20):
        payload = master.beacon()
        result = station.received(master.packet(payload))
        assert result is not None
        reply = master.compose(station, result)
        assert reply is not None
        master.take(reply)
        if result.reception is not None:
            received.append(replace(result.reception, boot="before"))
    times_ns = [
        *(number * SECOND for number in range(count // 2)),
        *(master.now_ns + number * SECOND for number in range(10)),
        *(40 * HOUR_NS + number * SECOND for number in range(count // 2)),
    ]
    return [queued(number, at_ns, boot="before") for number, at_ns in enumerate(times_ns)], received


def before_first_beacon(count: int) -> tuple[list[QueuedMeasurement], list[BeaconReception]]:
    """Return measurements of this boot, made hours before the first beacon."""
    return [queued(number, number * SECOND) for number in range(count)], []


def deliverable(count: int) -> tuple[list[QueuedMeasurement], list[BeaconReception]]:
    """Return measurements of this boot, made just before the first beacon."""
    return [queued(number, 50 * HOUR_NS - (count - number) * 50 * MS) for number in range(count)], []


def most_operations(
    backlog_of: Callable[[int], tuple[list[QueuedMeasurement], list[BeaconReception]]], count: int
) -> int:
    """Return the most operations with which a station receives a beacon and composes its reply, in its first frames."""
    backlog, receptions = backlog_of(count)
    send_queue = SendQueue(backlog[-1].sequence + 1 + RESTART_SKIP, backlog)
    station = make_station(send_queue, receptions=receptions)
    master, most = ScriptedMaster(now_ns=50 * HOUR_NS), 0

    def frame() -> None:
        received = station.received(packet)
        assert received is not None
        assert received.slot_ns is not None
        replies.append(station.compose(TRACKING, received.slot_ns - 6 * MS))

    for number in range(10):
        send_queue.add(queued(send_queue.first_sequence + number, master.now_ns))
        packet = master.packet(master.beacon(session=True))
        replies: list[bytes | None] = []
        most = max(most, operations(frame))
        if (
            number and replies[0] is not None
        ):  # the first one is lost, so that one more is composed before the join
            master.take(replies[0])
    assert station.joined
    return most


@pytest.mark.parametrize("backlog_of", [of_unknown_clock, out_of_reach, before_first_beacon, deliverable])
def test_work_per_frame_does_not_grow_with_queue(
    backlog_of: Callable[[int], tuple[list[QueuedMeasurement], list[BeaconReception]]],
) -> None:
    """Otherwise the reply is late, and a station that cannot join keeps its queue."""
    assert most_operations(backlog_of, 4000) < 1.3 * most_operations(backlog_of, 400)
