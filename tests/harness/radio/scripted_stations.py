"""Scripted superframe stations, frame by frame, against the sans-I/O core of a master."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from harness.hardware.radios import MS, PAPER

from tsgt.model import Status
from tsgt.radio.airtime import TX_DONE_NS
from tsgt.radio.superframe import FrameTiming, SuperframeMaster
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    SESSION_TIME_BITS,
    TIME_BITS,
    TIME_UNIT_US,
    WIDE_TIME_BITS,
    Authenticator,
    EncodedMeasurement,
    JoinRequest,
    MeasurementBlock,
    Reply,
    angle_code,
    decode_beacon,
    distance_code,
    encode_reply,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.radio.superframe import PhaseLock, ReceivedReply
    from tsgt.radio.superframe.slots import Slot
    from tsgt.radio.superframe.wire import Beacon

KEY = bytes(range(32))
TIMING = FrameTiming.from_tolerances(
    PAPER, start_jitter_ns=5 * MS, turnaround_ns=8 * MS, clock_error_ppm=100.0
)
EXACT_NS = 3_000
ZERO_NS = 1_000_000 * MS
"""Start of the master on its clock."""


def counted() -> Callable[[int], int]:
    """Return a deterministic source of distinct numbers."""
    numbers = iter(range(0xABCDEF, 0xFFFFFF))
    return lambda bits: next(numbers) % (1 << bits)


def measurement(
    sequence: int, session_us: int, *, origin_us: int = 0, wide: bool = False
) -> EncodedMeasurement:
    """Return an encoded measurement whose angle follows its sequence number."""
    return EncodedMeasurement(
        sequence=sequence % (1 << 32 if wide else 1 << 8),
        time=round((session_us - origin_us) / TIME_UNIT_US) % (1 << (WIDE_TIME_BITS if wide else TIME_BITS)),
        status=Status.OK,
        horizontal=angle_code(sequence / 1000),
        zenith=angle_code(1.5),
        distance=distance_code(75.0, far=False),
    )


def older(newest: EncodedMeasurement, back: int) -> EncodedMeasurement:
    """Return the measurement ``back`` numbers before another one, at 2.5 Hz."""
    return replace(
        newest,
        sequence=newest.sequence - back,
        time=newest.time - 25_000 * back,
        horizontal=(newest.horizontal - angle_code(back / 1000)) % (1 << 24),
    )


@dataclass
class Station:
    """Identity of a station, and its next sequence number."""

    number: int
    nonce: int = 0x5EED
    stream_id: int = 7
    first_sequence: int = 0
    oldest: int = 0
    sequence: int = 0

    @property
    def join_request(self) -> JoinRequest:
        """The join request."""
        return JoinRequest(
            nonce=self.nonce, stream_id=self.stream_id, first_sequence=self.first_sequence, oldest=self.oldest
        )

    def next_number(self) -> int:
        """Return the sequence number of a new measurement."""
        self.sequence += 1
        return self.sequence - 1


@dataclass
class ScriptedFrames:
    """A master and scripted stations; the true delay of all links is 0.1 ms above the nominal one.

    Attributes
    ----------
    now_ns
        The master's clock.
    writes
        Received measurements are recorded at once.
    """

    stations: dict[int, Station]
    master: SuperframeMaster
    authenticator: Authenticator
    now_ns: int = ZERO_NS
    writes: bool = True
    payload: bytes = b""
    beacon: Beacon = field(init=False)
    sent_ns: int = 0
    link_ns: int = TIMING.link_ns + 100_000
    turnarounds_us: dict[int, int] = field(default_factory=dict)
    """Turnaround of the last reply, by station."""

    @property
    def sent_us(self) -> int:
        """TxDone of the beacon in session time."""
        return (self.sent_ns - ZERO_NS + 500) // 1000 % (1 << SESSION_TIME_BITS)

    def begin(self, *, sigma_ns: int = EXACT_NS, fails: bool = False) -> Beacon:
        """Start a frame; a failed beacon is not received, and its TxDone is unknown."""
        start_ns = self.master.prepare(self.now_ns)
        assert start_ns >= self.now_ns
        self.payload = self.master.compose()
        self.beacon = decode_beacon(self.payload[:-CODE_BYTES])
        self.sent_ns = self.now_ns = start_ns + TIMING.airtime_ns(len(self.payload)) + TX_DONE_NS
        if not fails:
            self.master.sent(self.sent_ns, sigma_ns)
        return self.beacon

    def span(self, station: int) -> Slot:
        """Return a station's slot."""
        grants = [entry.grant for entry in self.beacon.stations]
        span = TIMING.slots(grants, self.beacon.slot_order)[station - 1]
        assert span is not None
        return span

    def packet(self, station: int, reply: Reply, *, sequence: int = 0, nonce: int | None = None) -> bytes:
        """Return the packet of a reply; ``sequence`` is the full number of its first measurement."""
        content = encode_reply(reply)
        return content + self.authenticator.reply_code(
            session=self.master.session,
            station=station,
            station_nonce=self.stations[station].nonce if nonce is None else nonce,
            counter=self.master.counter,
            beacon_code=self.payload[-CODE_BYTES:],
            sequence=sequence,
            content=content,
        )

    def arrive(
        self, station: int, packet: bytes, *, late_ns: int = 0, sigma_ns: int = EXACT_NS
    ) -> ReceivedReply | None:
        """Deliver a packet in the slot of the station."""
        begins_ns = self.sent_ns + self.link_ns - TIMING.reception_ns + self.span(station).start_ns + late_ns
        ends_ns = begins_ns + TIMING.airtime_ns(len(packet)) + TX_DONE_NS + self.link_ns
        received = self.master.received(packet, ends_ns, sigma_ns)
        self.turnarounds_us[station] = round((ends_ns - self.sent_ns - 2 * self.link_ns) / 1000)
        self.now_ns = max(self.now_ns, ends_ns)
        if received is not None and self.writes:
            self.master.station(station).window.mark_written(
                [each.sequence for each in received.measurements]
            )
        return received

    def reply(
        self, station: int, reply: Reply, *, sequence: int = 0, late_ns: int = 0, sigma_ns: int = EXACT_NS
    ) -> ReceivedReply:
        """Deliver a reply that the master has to accept."""
        packet = self.packet(station, reply, sequence=sequence)
        received = self.arrive(station, packet, late_ns=late_ns, sigma_ns=sigma_ns)
        assert received is not None
        return received

    def measure(
        self, station: int, *, age_ms: float = 100, join: bool = False, wide: bool | None = None
    ) -> ReceivedReply:
        """Deliver a reply with a new measurement of this age at the start of the slot."""
        sender = self.stations[station]
        number = sender.next_number()
        wide = join if wide is None else wide
        slot_us = self.sent_us + self.span(station).start_ns // 1000
        block = MeasurementBlock(
            measurements=(measurement(number, slot_us - round(1000 * age_ms), wide=wide),), wide=wide
        )
        join_request = sender.join_request if join else None
        return self.reply(station, Reply(blocks=(block,), join_request=join_request), sequence=number)

    def end(self) -> list[int]:
        """End the frame; return the silent stations."""
        self.now_ns = max(self.now_ns, self.master.reply_deadline_ns or 0) + 5 * MS
        return self.master.finish()

    def join(self) -> None:
        """Let all stations join, each with a measurement."""
        self.begin()
        for station in self.stations:
            self.measure(station, join=True)
        self.end()

    def run(self, frames: int, silent: Sequence[int] = ()) -> None:
        """Run frames in which all stations but the silent ones send a new measurement."""
        for _ in range(frames):
            self.begin()
            for station in self.stations:
                if station not in silent and self.beacon.stations[station - 1].grant:
                    self.measure(station)
            self.end()


def scripted_frames(
    stations: Sequence[int] = (1, 2, 3),
    *,
    key: bytes | None = KEY,
    phase_lock: PhaseLock | None = None,
    zero_ns: int = ZERO_NS,
    **options: bool,
) -> ScriptedFrames:
    """Return a master and stations that have not joined."""
    authenticator = Authenticator(key)
    master = SuperframeMaster(
        {number: number for number in stations},
        TIMING,
        authenticator,
        counted(),
        zero_ns,
        phase_lock=phase_lock,
        **options,
    )
    made = {number: Station(number, nonce=0x5EED + number) for number in stations}
    return ScriptedFrames(made, master, authenticator, now_ns=zero_ns)
