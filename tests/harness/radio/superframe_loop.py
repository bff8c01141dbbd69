"""Superframe master and stations without radios: a loop hands their packets over.

Lets tests alter, delay or inject packets. There is no channel, and every received measurement is written at once.
Instants are those of the master's clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tsgt.model import Status
from tsgt.radio import Packet, Transmission
from tsgt.radio.airtime import TX_DONE_NS
from tsgt.radio.superframe import (
    InstrumentState,
    QueuedMeasurement,
    SendQueue,
    SuperframeMaster,
    SuperframeStation,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.radio.superframe import FrameTiming, ReceivedReply, TimedMeasurement
    from tsgt.radio.superframe.wire import Authenticator

MS = 1_000_000
PERIOD_NS = 400 * MS
START_NS = 1_000_000 * MS
_STAMP_SIGMA_NS = 3_000
_LEAD_NS = 6 * MS
_BOOT = "boot"


@dataclass
class LoopStation:
    """A station of the loop.

    Attributes
    ----------
    offset_ns, drift_ppm
        Of its clock against the master's.
    made_ns
        True times of its measurements, by sequence number.
    received
        Measurements that the master has received, by sequence number.
    next_ns
        Time of the next measurement.
    """

    number: int
    core: SuperframeStation
    send_queue: SendQueue
    offset_ns: int
    drift_ppm: int
    made_ns: dict[int, int] = field(default_factory=dict)
    received: dict[int, TimedMeasurement] = field(default_factory=dict)
    next_ns: int = 0

    def local_ns(self, true_ns: int) -> int:
        """Return the reading of its clock."""
        return true_ns + self.offset_ns + true_ns * self.drift_ppm // 1_000_000

    def true_ns(self, local_ns: int) -> int:
        """Return the master's time at a reading of its clock, to a nanosecond or two."""
        since_ns = local_ns - self.offset_ns
        return since_ns - since_ns * self.drift_ppm // (1_000_000 + self.drift_ppm)

    def measure(self, until_ns: int) -> None:
        """Measure every 400 ms until this time."""
        while self.next_ns <= until_ns:
            number = len(self.made_ns)
            self.made_ns[number] = self.next_ns
            queued = QueuedMeasurement(
                sequence=number,
                at_ns=self.local_ns(self.next_ns),
                boot=_BOOT,
                prism=self.number,
                status=Status.OK,
                horizontal=1000 * number % (1 << 24),
                zenith=4_000_000,
                distance_m=40.0 + 0.001 * number,
            )
            self.send_queue.add(queued)
            self.next_ns += PERIOD_NS

    def errors_ns(self) -> dict[int, int]:
        """Return the timestamp errors at the master, by sequence number."""
        return {number: got.measured_ns - self.made_ns[number] for number, got in self.received.items()}


class SuperframeLoop:
    """A master and its stations.

    Parameters
    ----------
    random_bits
        Draws nonces.
    members
        Stations that are already running; None: new ones.

    Attributes
    ----------
    members
        Stations by number.
    beacon, replies
        Beacon of the current frame, and the replies to it by station.
    received_replies
        Decoded replies, by station.
    """

    def __init__(
        self,
        timing: FrameTiming,
        authenticator: Authenticator,
        random_bits: Callable[[int], int],
        *,
        stations: Sequence[int] = (1, 2, 3),
        start_ns: int = START_NS,
        members: dict[int, LoopStation] | None = None,
    ) -> None:
        self.timing = timing
        self.now_ns = start_ns
        self.master = SuperframeMaster(
            {number: number for number in stations}, timing, authenticator, random_bits, start_ns
        )
        self.members = members or {
            number: _loop_station(number, timing, authenticator, random_bits, start_ns) for number in stations
        }
        self.beacon = b""
        self.done_ns = 0
        self.replies: dict[int, bytes] = {}
        self.received_replies: dict[int, ReceivedReply] = {}

    def send_beacon(self, *, sigma_ns: int = _STAMP_SIGMA_NS) -> bytes:
        """Start a frame: send and return a beacon; ``sigma_ns`` is the master's timestamp error of its TxDone."""
        start_ns = self.master.prepare(self.now_ns)
        self.beacon = self.master.compose()
        self.done_ns = start_ns + self.timing.airtime_ns(len(self.beacon)) + TX_DONE_NS
        self.now_ns = self.done_ns
        self.master.sent(self.done_ns, sigma_ns)
        self.replies, self.received_replies = {}, {}
        return self.beacon

    def beacon_packet(self, number: int, payload: bytes, *, delay_ns: int = 0) -> Packet:
        """Return a packet as a station receives it at the end of this frame's beacon, or delayed."""
        return Packet(
            payload=payload,
            rssi_dbm=-80.0,
            snr_db=9.0,
            received_at_ns=self.members[number].local_ns(self.done_ns + self.timing.link_ns + delay_ns),
            stamp_sigma_ns=_STAMP_SIGMA_NS,
        )

    def receive_beacon(self, number: int, *, delay_ns: int = 0, beacon: bytes | None = None) -> int | None:
        """Let a station receive a beacon (None: the current one) and reply; return the time of its reply's RxDone, if any."""
        member = self.members[number]
        beacon_reception = member.core.received(
            self.beacon_packet(number, beacon or self.beacon, delay_ns=delay_ns)
        )
        if beacon_reception is None or beacon_reception.slot_ns is None:
            return None
        slot_ns = member.true_ns(beacon_reception.slot_ns)
        member.measure(slot_ns - _LEAD_NS)
        reply = member.core.compose(
            InstrumentState(prism=number, direct=False, connected=True), beacon_reception.slot_ns - _LEAD_NS
        )
        if reply is None:
            return None
        self.replies[number] = reply
        done_ns = slot_ns + self.timing.airtime_ns(len(reply)) + TX_DONE_NS
        member.core.sent(
            Transmission(
                started_at_ns=beacon_reception.slot_ns,
                done_at_ns=member.local_ns(done_ns),
                stamp_sigma_ns=_STAMP_SIGMA_NS,
            )
        )
        return done_ns + self.timing.link_ns

    def deliver_reply(
        self, number: int, received_ns: int, *, sigma_ns: int = _STAMP_SIGMA_NS
    ) -> ReceivedReply | None:
        """Deliver a station's reply to the master before its deadline; ``received_ns`` and ``sigma_ns`` are those of RxDone."""
        until_ns = self.master.reply_deadline_ns
        if until_ns is None or received_ns > until_ns:
            return None
        reply = self.master.received(self.replies[number], received_ns, sigma_ns)
        self.now_ns = max(self.now_ns, received_ns)
        if reply is not None:
            self.received_replies[number] = reply
            self.members[number].received |= {got.sequence: got for got in reply.measurements}
            self.master.station(number).window.mark_written([got.sequence for got in reply.measurements])
        return reply

    def end_frame(self) -> None:
        """End the frame."""
        self.now_ns = max(self.now_ns, self.master.reply_deadline_ns or 0) + 5 * MS
        self.master.finish()

    def run_frame(self, *, delays_ns: dict[int, int] | None = None, missed_by: Sequence[int] = ()) -> None:
        """Run a frame; some stations get its beacon late or not at all."""
        self.send_beacon()
        delays_ns = delays_ns or {}
        arrivals = {
            n: self.receive_beacon(n, delay_ns=delays_ns.get(n, 0))
            for n in self.members
            if n not in missed_by
        }
        for number, received_ns in sorted(arrivals.items(), key=lambda item: item[1] or 0):
            if received_ns is not None:
                self.deliver_reply(number, received_ns)
        self.end_frame()


def _loop_station(
    number: int,
    timing: FrameTiming,
    authenticator: Authenticator,
    random_bits: Callable[[int], int],
    start_ns: int,
) -> LoopStation:
    send_queue = SendQueue(0)
    core = SuperframeStation(
        number,
        timing.settings,
        authenticator,
        send_queue,
        stream_id=number,
        boot=_BOOT,
        random_bits=random_bits,
    )
    return LoopStation(
        number,
        core,
        send_queue,
        offset_ns=number * 777_000 * MS,
        drift_ppm=10 * number,
        next_ns=start_ns + 100 * number * MS,
    )
