"""The frame loop: beacons on time, replies and empty slots to the observer."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from harness.hardware.radios import MS, Bench, bench
from harness.missions.field import running
from harness.radio.scripted_stations import KEY, TIMING, counted

from tsgt.master.superframe import FrameLoop
from tsgt.radio.superframe import FramePlan, SuperframeMaster
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    Authenticator,
    JoinRequest,
    Reply,
    SlotOrder,
    decode_beacon,
    encode_reply,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.radio import Packet, Transmission
    from tsgt.radio.superframe import ReceivedReply


@dataclass
class CallLog:
    """An observer that logs its calls."""

    calls: list[str] = field(default_factory=list)
    sent_ns: list[int] = field(default_factory=list)
    ready_after_s: float = 0.0

    async def ready(self) -> None:
        """Take some time."""
        await asyncio.sleep(self.ready_after_s)

    def composing(self) -> None:
        """Log it."""
        self.calls.append("composing")

    def beacon_sent(self, sent: Transmission) -> None:
        """Log it."""
        self.calls.append("beacon")
        self.sent_ns.append(sent.done_at_ns)

    def received(self, reply: ReceivedReply, packet: Packet) -> None:
        """Log the station."""
        assert packet.payload
        self.calls.append(f"received {reply.station}")

    def not_received(self, stations: Sequence[int]) -> None:
        """Log the station."""
        self.calls.append(f"not received {list(stations)}")


class LateLock:
    """Lets each frame begin a second after it could."""

    def measured(self, index: int, time_us: int) -> None:
        """Learn nothing."""

    def forecast(self, earliest_ns: int, beacon_bytes: int) -> int:  # noqa: ARG002 (as the real one)
        """Return when the next frame begins."""
        return earliest_ns + 1000 * MS

    def plan(self, earliest_ns: int, grants: Sequence[int], beacon_bytes: int) -> FramePlan:  # noqa: ARG002 (as above)
        """Plan the next frame."""
        return FramePlan(earliest_ns + 1000 * MS, SlotOrder())


def master_on(both: Bench, *, late: bool = False) -> SuperframeMaster:
    """Return a master of two stations."""
    lock = LateLock() if late else None
    return SuperframeMaster(
        {1: 1, 2: 2},
        TIMING,
        Authenticator(KEY),
        counted(),
        both.clock.monotonic_ns(),
        phase_lock=lock,  # type: ignore[arg-type]
    )


async def answer(both: Bench, master: SuperframeMaster, *, early_ns: int = 0) -> None:
    """Introduce station 2 in its slot of each frame; the other side's radio."""
    while True:
        packet = await both.there.radio.receive()
        beacon = decode_beacon(packet.payload[:-CODE_BYTES])
        span = TIMING.slots([entry.grant for entry in beacon.stations], beacon.slot_order)[1]
        assert span is not None
        content = encode_reply(
            Reply(join_request=JoinRequest(nonce=5, stream_id=1, first_sequence=0, oldest=0))
        )
        code = Authenticator(KEY).reply_code(
            session=master.session,
            station=2,
            station_nonce=5,
            counter=master.counter,
            beacon_code=packet.payload[-CODE_BYTES:],
            sequence=0,
            content=content,
        )
        at_ns = packet.received_at_ns - TIMING.reception_ns + span.start_ns - early_ns
        await both.there.radio.transmit(content + code, at_ns=at_ns)


async def test_frames_follow_each_other() -> None:
    """Composed, sent, received, not received; the next one follows the last slot."""
    async with bench() as both:
        master, call_log = master_on(both), CallLog()
        async with (
            running(answer(both, master)),
            running(FrameLoop(both.here.radio, both.clock, master, call_log).run()),
        ):
            await asyncio.sleep(3)
    assert call_log.calls[:8] == ["composing", "beacon", "received 2", "not received [1]"] * 2
    for before_ns, after_ns in pairwise(call_log.sent_ns):
        assert (after_ns - before_ns) / MS < 500


async def test_frame_without_replies_ends_with_its_last_slot() -> None:
    """Frame without replies ends with its last slot."""
    async with bench() as both:
        master, call_log = master_on(both), CallLog()
        async with running(FrameLoop(both.here.radio, both.clock, master, call_log).run()):
            await asyncio.sleep(2)
    assert call_log.calls[:6] == ["composing", "beacon", "not received [1, 2]"] * 2
    slots_ns = 2 * (TIMING.airtime_ns(44) + TIMING.guard_ns) + TIMING.turnaround_ns
    session_bytes = 25  # of a beacon with a session item
    first_ns = call_log.sent_ns[1] - call_log.sent_ns[0] - TIMING.airtime_ns(session_bytes)
    assert first_ns == pytest.approx(slots_ns, abs=8 * MS)


async def test_later_frame_is_composed_later() -> None:
    """It acknowledges what is written until then."""
    async with bench() as both:
        master, call_log = master_on(both, late=True), CallLog()
        async with running(FrameLoop(both.here.radio, both.clock, master, call_log).run()):
            await asyncio.sleep(0.9)
            assert call_log.calls == []
            await asyncio.sleep(0.1)
            assert call_log.calls == ["composing"]


async def test_frame_waits_for_the_observer() -> None:
    """Frame waits for the observer."""
    async with bench() as both:
        master, call_log = master_on(both), CallLog(ready_after_s=1.0)
        async with running(FrameLoop(both.here.radio, both.clock, master, call_log).run()):
            await asyncio.sleep(0.99)
            assert call_log.calls == []
            await asyncio.sleep(0.1)
            assert call_log.calls == ["composing"]
