"""Frames of the superframe without radios: a master and stations whose packets are handed over in a loop.

For whoever wants to try what a packet does to them, and for nothing else: there is no channel here, and all that is
heard is written at once. Instants are those of the master's clock.
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
class Member:
    """A station of an exchange.

    Attributes
    ----------
    number, core, outbox
        Its number, what decides for it, and what it has to deliver.
    offset_ns, drift_ppm
        Of its clock against the master's.
    made_ns
        True instants of its measurements, by number.
    received
        What the master has of it, by number.
    next_ns
        When it measures next.
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
        """Return what its clock shows."""
        return true_ns + self.offset_ns + true_ns * self.drift_ppm // 1_000_000

    def true_ns(self, local_ns: int) -> int:
        """Return what the master's clock shows when this one shows that; good to a nanosecond or two."""
        since_ns = local_ns - self.offset_ns
        return since_ns - since_ns * self.drift_ppm // (1_000_000 + self.drift_ppm)

    def measure(self, until_ns: int) -> None:
        """Measure every 400 ms."""
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
        """Return how far the master's times are off, by number."""
        return {number: got.measured_ns - self.made_ns[number] for number, got in self.received.items()}


class Exchange:
    """A master and its stations.

    Parameters
    ----------
    timing
        Of the frames.
    authenticator
        Has the key, or none.
    random_bits
        For nonces.
    stations
        Numbers.
    start_ns
        When the master starts.
    members
        Stations that have been running for some time; None: new ones.

    Attributes
    ----------
    master, members
        The cores, the stations by number.
    now_ns
        The present.
    beacon
        The latest.
    replies
        To it, by station.
    heard
        What they brought, by station.
    """

    def __init__(
        self,
        timing: FrameTiming,
        authenticator: Authenticator,
        random_bits: Callable[[int], int],
        *,
        stations: Sequence[int] = (1, 2, 3),
        start_ns: int = START_NS,
        members: dict[int, Member] | None = None,
    ) -> None:
        self.timing = timing
        self.now_ns = start_ns
        self.master = SuperframeMaster(
            {number: number for number in stations}, timing, authenticator, random_bits, start_ns
        )
        self.members = members or {
            number: _member(number, timing, authenticator, random_bits, start_ns) for number in stations
        }
        self.beacon = b""
        self.done_ns = 0
        self.replies: dict[int, bytes] = {}
        self.heard: dict[int, ReceivedReply] = {}

    def begin(self, *, sigma_ns: int = _STAMP_SIGMA_NS) -> bytes:
        """Send a beacon, of whose TxDone the master knows one sigma; return it."""
        start_ns = self.master.prepare(self.now_ns)
        self.beacon = self.master.compose()
        self.done_ns = start_ns + self.timing.airtime_ns(len(self.beacon)) + TX_DONE_NS
        self.now_ns = self.done_ns
        self.master.sent(self.done_ns, sigma_ns)
        self.replies, self.heard = {}, {}
        return self.beacon

    def packet(self, number: int, payload: bytes, *, late_ns: int = 0) -> Packet:
        """Return what a station receives when a packet ends together with this frame's beacon, or so much later."""
        return Packet(
            payload=payload,
            rssi_dbm=-80.0,
            snr_db=9.0,
            received_at_ns=self.members[number].local_ns(self.done_ns + self.timing.link_ns + late_ns),
            stamp_sigma_ns=_STAMP_SIGMA_NS,
        )

    def hear(self, number: int, *, late_ns: int = 0, beacon: bytes | None = None) -> int | None:
        """Let a station hear a beacon and answer; return when its reply is received, None without one.

        Parameters
        ----------
        number
            Of the station.
        late_ns
            Somebody has held the beacon back for so long.
        beacon
            Another one than that of the present frame.
        """
        member = self.members[number]
        heard = member.core.received(self.packet(number, beacon or self.beacon, late_ns=late_ns))
        if heard is None or heard.slot_ns is None:
            return None
        slot_ns = member.true_ns(heard.slot_ns)
        member.measure(slot_ns - _LEAD_NS)
        reply = member.core.compose(
            InstrumentState(prism=number, direct=False, connected=True), heard.slot_ns - _LEAD_NS
        )
        if reply is None:
            return None
        self.replies[number] = reply
        done_ns = slot_ns + self.timing.airtime_ns(len(reply)) + TX_DONE_NS
        member.core.sent(
            Transmission(
                started_at_ns=heard.slot_ns,
                done_at_ns=member.local_ns(done_ns),
                stamp_sigma_ns=_STAMP_SIGMA_NS,
            )
        )
        return done_ns + self.timing.link_ns

    def deliver(
        self, number: int, received_ns: int, *, sigma_ns: int = _STAMP_SIGMA_NS
    ) -> ReceivedReply | None:
        """Hand a station's reply to the master, if it still waits for one.

        Parameters
        ----------
        number
            Of the station.
        received_ns, sigma_ns
            RxDone as the master knows it, and one sigma.
        """
        until_ns = self.master.reply_deadline_ns
        if until_ns is None or received_ns > until_ns:
            return None
        heard = self.master.received(self.replies[number], received_ns, sigma_ns)
        self.now_ns = max(self.now_ns, received_ns)
        if heard is not None:
            self.heard[number] = heard
            self.members[number].received |= {got.sequence: got for got in heard.measurements}
            self.master.station(number).window.mark_written([got.sequence for got in heard.measurements])
        return heard

    def end(self) -> None:
        """End the frame."""
        self.now_ns = max(self.now_ns, self.master.reply_deadline_ns or 0) + 5 * MS
        self.master.finish()

    def frame(self, *, late_ns: dict[int, int] | None = None, deaf: Sequence[int] = ()) -> None:
        """Run a frame; the beacon is held back from some stations, and kept from others."""
        self.begin()
        held_ns = late_ns or {}
        arrivals = {n: self.hear(n, late_ns=held_ns.get(n, 0)) for n in self.members if n not in deaf}
        for number, received_ns in sorted(arrivals.items(), key=lambda item: item[1] or 0):
            if received_ns is not None:
                self.deliver(number, received_ns)
        self.end()


def _member(
    number: int,
    timing: FrameTiming,
    authenticator: Authenticator,
    random_bits: Callable[[int], int],
    start_ns: int,
) -> Member:
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
    return Member(
        number,
        core,
        send_queue,
        offset_ns=number * 777_000 * MS,
        drift_ppm=10 * number,
        next_ns=start_ns + 100 * number * MS,
    )
