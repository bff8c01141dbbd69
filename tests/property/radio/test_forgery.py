"""Forged packets have no effect with a key; without a key arbitrary packets raise no error."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from harness.radio.forgery import KINDS, forge, state
from harness.radio.scripted_stations import KEY, TIMING
from harness.radio.superframe_loop import SuperframeLoop

from tsgt.errors import MessageError
from tsgt.model import Status
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    Authenticator,
    Beacon,
    CommandResponse,
    EncodedCommand,
    EncodedMeasurement,
    JoinConfirmation,
    JoinRequest,
    MeasurementBlock,
    Reply,
    SessionInfo,
    SingleMeasurement,
    SlotOrder,
    StationEntry,
    StatusReport,
    decode_reply,
    encode_beacon,
    encode_reply,
)


def test_no_forged_packet_has_an_effect() -> None:
    """Of any kind, to both sides, at any time of a frame: all packets stay the same."""
    result = forge(TIMING, KEY, 30_000, np.random.default_rng(1), per_step=50)
    assert min(result.sent[kind, target] for kind in KINDS for target in ("station", "master")) > 500
    assert +result.accepted == {}
    assert (result.diverged, result.same_state) == (0, True)


@pytest.mark.slow
def test_missing_code_comparison_is_detected() -> None:
    """By acceptance, by packets and by the final state."""
    with patch("hmac.compare_digest", return_value=True):
        result = forge(TIMING, KEY, 5000, np.random.default_rng(1), per_step=50)
    assert result.accepted.total() > 100
    assert result.diverged > 0
    assert not result.same_state


def test_state_comparison_detects_one_counter() -> None:
    """Of one station."""
    one, other = (SuperframeLoop(TIMING, Authenticator(KEY), lambda bits: 7 % (1 << bits)) for _ in range(2))
    for loop in (one, other):
        loop.run_frame()
        loop.run_frame()
    assert state(one) == state(other)
    other.members[3].core.missed_slots += 1
    assert state(one) != state(other)


class _Anybody:
    """Sends valid codes with arbitrary values in all fields."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._authenticator = Authenticator(None)

    def bits(self, width: int) -> int:
        """Return any number, or one at the edge of its field."""
        last = (1 << width) - 1
        edges = (0, 1, last, last // 2)
        if self._rng.random() < 0.3:
            return edges[int(self._rng.integers(len(edges)))]
        return int.from_bytes(self._rng.bytes(8), "big") & last

    def chance(self, share: float = 0.5) -> bool:
        """Return True with this probability."""
        return bool(self._rng.random() < share)

    def beacon(self, loop: SuperframeLoop, number: int) -> bytes:
        """Return a beacon of the station's master, or of another session."""
        entries = int(self._rng.integers(1, 17)) if self.chance(0.2) else len(loop.members)
        core = loop.members[number].core
        session = core.session
        assert session is not None
        counter = session.beacon.counter + 1 + (self.bits(3) if self.chance() else 0)
        if self.chance(0.05):
            counter = self.bits(24)
        master = self.bits(48) if self.chance(0.05) else session.master_nonce
        part = SessionInfo(
            nonce=master,
            counter_high=counter >> 8 & 0xFFFF,
            sent_high=self.bits(24),
            guard=self.bits(8),
            turnaround=self.bits(8),
        )
        numbers = [1 + self.bits(4) % entries for _ in range(3)]
        sent = self.bits(16)
        content = encode_beacon(
            Beacon(
                frame=counter % 256,
                sent=sent,
                cumulative=self.bits(8),
                slot_order=SlotOrder(self.bits(4), self.chance()),
                stations=tuple(StationEntry(self.bits(4), self.bits(4)) for _ in range(entries)),
                session=replace(part, sent_high=part.sent_high if sent else 0) if self.chance() else None,
                confirmations=(JoinConfirmation(min(number, entries), session.nonce),)
                if self.chance()
                else (),
                commands=tuple(
                    EncodedCommand(n, self.bits(4), self.bits(2) and 1 + self.bits(1)) for n in numbers
                ),
            )
        )
        return content + self._authenticator.beacon_code(session=master, counter=counter, content=content)

    def reply(self, loop: SuperframeLoop, number: int) -> bytes:
        """Return a reply that the master accepts as the station's."""
        station_state = loop.master.station(number)
        join_request = JoinRequest(
            nonce=self.bits(32), stream_id=self.bits(2), first_sequence=self.bits(32), oldest=self.bits(32)
        )
        state_part = StatusReport(
            prism=1 + self.bits(4),
            direct=self.chance(),
            connected=self.chance(),
            missed_slots=self.bits(8),
            rejected_beacons=self.bits(4),
            rssi_dbm=-self.bits(7),
        )
        values = (self.bits(24), self.bits(24), self.bits(24) or None)
        reply = Reply(
            blocks=tuple(self._run() for _ in range(self.bits(2))),
            join_request=join_request if self.chance(0.2) else None,
            status_report=state_part if self.chance() else None,
            turnaround_us=self.bits(22) if self.chance() else None,
            response=CommandResponse(self.bits(4), self.chance()) if self.chance() else None,
            single_measurement=SingleMeasurement(self.bits(4), Status.OK, *values) if self.chance() else None,
        )
        content = encode_reply(reply)
        nonce = station_state.nonce if reply.join_request is None else reply.join_request.nonce
        return content + self._authenticator.reply_code(
            session=loop.master.session,
            station=number,
            station_nonce=nonce or 0,
            counter=loop.master.counter,
            beacon_code=loop.beacon[-CODE_BYTES:],
            sequence=station_state.first_sequence(decode_reply(content)),
            content=content,
        )

    def _run(self) -> MeasurementBlock:
        wide = self.chance()
        sequence, time = self.bits(32 if wide else 8), self.bits(36 if wide else 17)
        measurements = []
        for _ in range(1 + self.bits(4)):
            values = (self.bits(24), self.bits(24), self.bits(24) or None)
            measurements.append(EncodedMeasurement(sequence, time, Status.OK, *values))
            sequence -= 1 + self.bits(int(self._rng.integers(1, 32)))
            time -= self.bits(int(self._rng.integers(1, 35)))
        return MeasurementBlock(
            measurements=tuple(measurements),
            beacon_relative=self.chance(),
            quality=self.bits(4),
            wide=wide,
            prism=1 + self.bits(4) if self.chance() else None,
            far=self.chance(),
        )


@pytest.mark.slow
def test_arbitrary_messages_raise_no_error() -> None:
    """Commands, sessions, numbers and times of any sender, all of which are accepted."""
    rng = np.random.default_rng(3)
    anybody = _Anybody(rng)
    loop = SuperframeLoop(TIMING, Authenticator(None), anybody.bits)
    loop.run_frame()
    accepted = 0
    for _ in range(250):
        loop.send_beacon()
        for number, member in loop.members.items():
            own = loop.receive_beacon(number) if anybody.chance() else None
            with suppress(MessageError):
                beacon = anybody.beacon(loop, number)
                loop.receive_beacon(
                    number, beacon=beacon, delay_ns=anybody.bits(33) if anybody.chance(0.1) else 0
                )
            if member.core.next_command() is not None:
                member.core.executed(ok=anybody.chance())
            if own is not None and anybody.chance():
                loop.deliver_reply(number, own)
            with suppress(MessageError):
                reply = anybody.reply(loop, number)
                received_ns = loop.done_ns + anybody.bits(29)
                received = loop.master.received(
                    reply, received_ns, 3000 if anybody.chance(0.9) else 1_000_000
                )
                if received is not None:
                    accepted += 1
                    loop.master.station(number).window.mark_written(
                        [got.sequence for got in received.measurements]
                    )
        loop.end_frame()
    assert accepted > 200
