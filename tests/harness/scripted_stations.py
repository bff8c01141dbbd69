"""The master's side of the superframe without radios: a test says what its stations answer, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from harness.radios import MS, PAPER

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
"""The master starts when its clock has run for a quarter of an hour."""


def counted() -> Callable[[int], int]:
    """Return a source of numbers that are not random, and never the same."""
    numbers = iter(range(0xABCDEF, 0xFFFFFF))
    return lambda bits: next(numbers) % (1 << bits)


def measurement(
    sequence: int, session_us: int, *, origin_us: int = 0, wide: bool = False
) -> EncodedMeasurement:
    """Make a measurement whose angles tell its number, with its time as it goes over the air."""
    return EncodedMeasurement(
        sequence=sequence % (1 << 32 if wide else 1 << 8),
        time=round((session_us - origin_us) / TIME_UNIT_US) % (1 << (WIDE_TIME_BITS if wide else TIME_BITS)),
        status=Status.OK,
        horizontal=angle_code(sequence / 1000),
        zenith=angle_code(1.5),
        distance=distance_code(75.0, far=False),
    )


def older(newest: EncodedMeasurement, back: int) -> EncodedMeasurement:
    """Make the measurement so many numbers before another one in its run, at 2.5 Hz."""
    return replace(
        newest,
        sequence=newest.sequence - back,
        time=newest.time - 25_000 * back,
        horizontal=(newest.horizontal - angle_code(back / 1000)) % (1 << 24),
    )


@dataclass
class Station:
    """What a station has to remember to be believed, and the numbers of its measurements."""

    number: int
    nonce: int = 0x5EED
    stream_id: int = 7
    first_sequence: int = 0
    oldest: int = 0
    sequence: int = 0

    @property
    def join_request(self) -> JoinRequest:
        """Say who it is."""
        return JoinRequest(
            nonce=self.nonce, stream_id=self.stream_id, first_sequence=self.first_sequence, oldest=self.oldest
        )

    def next_number(self) -> int:
        """Return the number of a new measurement."""
        self.sequence += 1
        return self.sequence - 1


@dataclass
class ScriptedFrames:
    """A master among hand-played stations; the true constant of all links is 0.1 ms above the nominal one.

    Attributes
    ----------
    now_ns
        The master's clock.
    beacon
        Of the present frame.
    writes
        What is heard is written at once.
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
    """By station: from RxDone of the last beacon that it answered to TxDone of its reply."""

    @property
    def sent_us(self) -> int:
        """TxDone of the present beacon in session time."""
        return (self.sent_ns - ZERO_NS + 500) // 1000 % (1 << SESSION_TIME_BITS)

    def begin(self, *, sigma_ns: int = EXACT_NS, fails: bool = False) -> Beacon:
        """Begin a frame; a beacon that fails is heard by nobody, and nobody knows when it went out."""
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
        """Return a reply as the station sends it; ``sequence`` is the full number of its first measurement."""
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
        """Let a packet arrive as one in the station's slot does."""
        begins_ns = self.sent_ns + self.link_ns - TIMING.reception_ns + self.span(station).start_ns + late_ns
        ends_ns = begins_ns + TIMING.airtime_ns(len(packet)) + TX_DONE_NS + self.link_ns
        heard = self.master.received(packet, ends_ns, sigma_ns)
        self.turnarounds_us[station] = round((ends_ns - self.sent_ns - 2 * self.link_ns) / 1000)
        self.now_ns = max(self.now_ns, ends_ns)
        if heard is not None and self.writes:
            self.master.station(station).window.mark_written([each.sequence for each in heard.measurements])
        return heard

    def reply(
        self, station: int, reply: Reply, *, sequence: int = 0, late_ns: int = 0, sigma_ns: int = EXACT_NS
    ) -> ReceivedReply:
        """Let a station answer, which the master has to accept."""
        packet = self.packet(station, reply, sequence=sequence)
        heard = self.arrive(station, packet, late_ns=late_ns, sigma_ns=sigma_ns)
        assert heard is not None
        return heard

    def measure(
        self, station: int, *, age_ms: float = 100, join: bool = False, wide: bool | None = None
    ) -> ReceivedReply:
        """Let a station answer with a new measurement, made so long before its slot."""
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
        """End the frame; return who was silent."""
        self.now_ns = max(self.now_ns, self.master.reply_deadline_ns or 0) + 5 * MS
        return self.master.finish()

    def join(self) -> None:
        """Have all stations introduce themselves, each with a measurement, and be confirmed."""
        self.begin()
        for station in self.stations:
            self.measure(station, join=True)
        self.end()

    def run(self, frames: int, silent: Sequence[int] = ()) -> None:
        """Run frames in which all stations answer with a new measurement, but for the silent ones."""
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
    """Make a master and its stations, none of which has joined."""
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
