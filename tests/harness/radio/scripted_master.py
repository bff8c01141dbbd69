"""A scripted superframe master, frame by frame, against the sans-I/O core of a station."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from harness.hardware.radios import MS, PAPER

from tsgt.model import Status
from tsgt.radio import Packet, Transmission
from tsgt.radio.airtime import TX_DONE_NS
from tsgt.radio.superframe import (
    FrameTiming,
    InstrumentState,
    QueuedMeasurement,
    SendQueue,
    SuperframeStation,
)
from tsgt.radio.superframe.slots import GUARD_UNIT_NS
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    GRANT_BYTES,
    RESTART_SKIP,
    TIME_BITS,
    TIME_UNIT_US,
    WIDE_TIME_BITS,
    Authenticator,
    Beacon,
    JoinConfirmation,
    SessionInfo,
    SlotOrder,
    StationEntry,
    decode_reply,
    encode_beacon,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.radio.superframe import BeaconReception, ReceivedBeacon
    from tsgt.radio.superframe.wire import EncodedCommand, MeasurementBlock, Reply

SECOND = 1_000_000_000
KEY = bytes(range(32))
AUTHENTICATOR = Authenticator(KEY)
TIMING = FrameTiming(PAPER, 20 * GUARD_UNIT_NS, 32 * GUARD_UNIT_NS)
TRACKING = InstrumentState(prism=1, direct=False, connected=True)

OFFSET_NS = 777 * SECOND
DRIFT_PPM = 30


def local_ns(true_ns: int) -> int:
    """Return the station's clock reading; true time is that of the master."""
    return OFFSET_NS + true_ns + true_ns * DRIFT_PPM // 1_000_000


def counted() -> Callable[[int], int]:
    """Return a deterministic source of distinct numbers."""
    numbers = iter(range(1_000_000, 2_000_000))
    return lambda bits: next(numbers) % (1 << bits)


def make_station(
    send_queue: SendQueue,
    *,
    boot: str = "boot",
    receptions: Sequence[BeaconReception] = (),
    authenticator: Authenticator = AUTHENTICATOR,
    random_bits: Callable[[int], int] | None = None,
) -> SuperframeStation:
    """Return station 2 of 3."""
    return SuperframeStation(
        2,
        PAPER,
        authenticator,
        send_queue,
        stream_id=9,
        boot=boot,
        receptions=receptions,
        random_bits=random_bits or counted(),
    )


def queued(sequence: int, true_ns: int, *, prism: int = 1, boot: str = "boot") -> QueuedMeasurement:
    """Return a measurement of a moving robot."""
    return QueuedMeasurement(
        sequence=sequence,
        at_ns=local_ns(true_ns),
        boot=boot,
        prism=prism,
        status=Status.OK,
        horizontal=(1000 * sequence) % (1 << 24),
        zenith=4_000_000,
        distance_m=40.0 + 0.001 * sequence,
    )


@dataclass(frozen=True)
class ReceivedMessage:
    """A reply with a valid code.

    Attributes
    ----------
    sequences, times_ns
        Sequence numbers, and true times by sequence number, of its measurements.
    """

    reply: Reply
    sequences: tuple[int, ...]
    times_ns: dict[int, int]
    payload_bytes: int


@dataclass
class ScriptedMaster:
    """Sends beacons to one station and records its replies; losses are scripted."""

    session: int = 0xABCDEF
    authenticator: Authenticator = AUTHENTICATOR
    stations: int = 3
    station: int = 2
    grant: int = len(GRANT_BYTES) - 1
    session_interval: int = 1
    frame_ns: int = 400 * MS
    counter: int = -1
    now_ns: int = 5 * SECOND
    zero_ns: int = 0
    nonce: int | None = None
    highest: int = -1
    received: dict[int, int] = field(default_factory=dict)
    written: set[int] = field(default_factory=set)
    replies: dict[int, tuple[int, ...]] = field(default_factory=dict)
    not_pending: set[int] = field(default_factory=set)
    confirm: bool = True
    sent_us: int = 0
    beacon_done_ns: int = 0
    code: bytes = b""
    _confirmation: int | None = None

    @property
    def cumulative(self) -> int:
        """The cumulative acknowledgement."""
        number = 0
        while number in self.written or number in self.not_pending:
            number += 1
        return number - 1

    def beacon(self, *, commands: Sequence[EncodedCommand] = (), session: bool | None = None) -> bytes:
        """Start the next frame; return its beacon."""
        self.counter += 1
        self.now_ns += self.frame_ns
        with_session = self.counter % self.session_interval == 0 if session is None else session
        confirmations = (
            () if self._confirmation is None else (JoinConfirmation(self.station, self._confirmation),)
        )
        self._confirmation = None
        ack_bitmap = sum(
            1 << j
            for j in range(4)
            if self.counter - 1 - j in self.replies
            and self.written.issuperset(self.replies[self.counter - 1 - j])
        )
        content = encode_beacon(
            Beacon(
                frame=self.counter % 256,
                sent=self.sent_us % (1 << 16),
                cumulative=self.cumulative % 256,
                slot_order=SlotOrder(),
                stations=tuple(
                    StationEntry(ack_bitmap, self.grant) if index == self.station - 1 else StationEntry(0, 2)
                    for index in range(self.stations)
                ),
                session=SessionInfo(
                    nonce=self.session,
                    counter_high=self.counter >> 8,
                    sent_high=self.sent_us >> 16,
                    guard=20,
                    turnaround=32,
                )
                if with_session
                else None,
                confirmations=confirmations,
                commands=tuple(commands),
            )
        )
        self.code = self.authenticator.beacon_code(
            session=self.session, counter=self.counter, content=content
        )
        payload = content + self.code
        self._sent_at(self.now_ns + TIMING.airtime_ns(len(payload)) + TX_DONE_NS)
        return payload

    def sent_by_radio(self, transmitted: Transmission) -> None:
        """Take the transmission of the beacon by a radio."""
        self.now_ns = transmitted.started_at_ns
        self._sent_at(transmitted.done_at_ns)

    def _sent_at(self, done_ns: int) -> None:
        self.beacon_done_ns = done_ns
        self.sent_us = (done_ns - self.zero_ns) // 1000
        self.sent_us += not self.sent_us % (1 << 16)

    def packet(self, payload: bytes, *, late_ns: int = 0, sigma_ns: int = 20_000) -> Packet:
        """Return a beacon as the station receives it."""
        return Packet(
            payload=payload,
            rssi_dbm=-80.4,
            snr_db=9.0,
            received_at_ns=local_ns(self.beacon_done_ns + TIMING.link_ns + late_ns),
            stamp_sigma_ns=sigma_ns,
        )

    def frame(
        self,
        station: SuperframeStation,
        instrument_state: InstrumentState = TRACKING,
        *,
        commands: Sequence[EncodedCommand] = (),
        beacon_lost: bool = False,
        reply_lost: bool = False,
        not_written: bool = False,
        late_ns: int = 0,
        session: bool | None = None,
    ) -> ReceivedMessage | None:
        """Run a frame; return the reply, None without one or if it is lost."""
        payload = self.beacon(commands=commands, session=session)
        if beacon_lost:
            return None
        received = station.received(self.packet(payload, late_ns=late_ns))
        if received is None or received.slot_ns is None:
            return None
        reply = self.compose(station, received, instrument_state)
        return None if reply is None or reply_lost else self.take(reply, not_written=not_written)

    def compose(
        self,
        station: SuperframeStation,
        received: ReceivedBeacon,
        instrument_state: InstrumentState = TRACKING,
    ) -> bytes | None:
        """Let the station compose its reply in time."""
        assert received.slot_ns is not None
        reply = station.compose(instrument_state, received.slot_ns - 6 * MS)
        if reply is not None:
            done_ns = received.slot_ns + TIMING.airtime_ns(len(reply)) + TX_DONE_NS
            station.sent(
                Transmission(started_at_ns=received.slot_ns, done_at_ns=done_ns, stamp_sigma_ns=20_000)
            )
        return reply

    def take(self, payload: bytes, *, not_written: bool = False) -> ReceivedMessage:
        """Verify and record a reply."""
        assert len(payload) <= GRANT_BYTES[self.grant]
        content, code = payload[:-CODE_BYTES], payload[-CODE_BYTES:]
        reply = decode_reply(content)
        join_request = reply.join_request
        if join_request is not None:
            start = join_request.first_sequence
            self.not_pending |= {*range(join_request.oldest), *range(max(0, start - RESTART_SKIP), start)}
            self.nonce = join_request.nonce
            self._confirmation = join_request.nonce if self.confirm else None
        assert self.nonce is not None
        times_ns: dict[int, int] = {}
        for block in reply.blocks:
            times_ns |= self._times_ns(block)
        sequences = tuple(times_ns)
        expected = self.authenticator.reply_code(
            session=self.session,
            station=self.station,
            station_nonce=self.nonce,
            counter=self.counter,
            beacon_code=self.code,
            sequence=sequences[0] if sequences else 0,
            content=content,
        )
        assert code == expected
        self.replies[self.counter] = sequences
        self.received |= times_ns
        self.highest = max(self.highest, *sequences, -1)
        if not not_written:
            self.written |= set(sequences)
        return ReceivedMessage(reply, sequences, times_ns, len(payload))

    def _times_ns(self, block: MeasurementBlock) -> dict[int, int]:
        newest = block.measurements[0]
        number = newest.sequence
        if not block.wide:
            number = self.highest + (number - self.highest + 128) % 256 - 128
        span_us = TIME_UNIT_US << (WIDE_TIME_BITS if block.wide else TIME_BITS)
        sent_us = (self.beacon_done_ns - self.zero_ns) // 1000
        time_us = TIME_UNIT_US * newest.time + (sent_us if block.beacon_relative else 0)
        end_us = sent_us + 700_000  # later than any slot of three stations
        time_us = end_us - (end_us - time_us) % span_us
        result = {number: time_us}
        for older in block.measurements[1:]:
            back = newest.sequence - older.sequence
            result[number - back] = time_us + TIME_UNIT_US * (older.time - newest.time)
        return {
            sequence: self.zero_ns + 1000 * instant_us + TIMING.link_ns
            for sequence, instant_us in result.items()
        }
