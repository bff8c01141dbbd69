"""The master's side of the paper's protocol: what it does with one station while all others are silent. Sans-I/O.

A transaction is a sequence of requests to a :class:`~tsgt.radio.classic.station.ClassicStation`: it takes each received
packet until it accepts one as the reply, or the reply timeout has passed. Replies have no sequence numbers, and two kinds
do not even name their station: :class:`Synchronisation` lists the guards against a wrong clock sample.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from tsgt.model import ClockSample
from tsgt.radio.classic.messages import (
    COMMAND_BYTES,
    MEASUREMENT_BYTES,
    PING_REPLY_BYTES,
    TIME_REPLY_BYTES,
    Acknowledgement,
    CommandMessage,
    MeasurementMessage,
    PingReply,
    TimeReply,
    decode_reply,
)

if TYPE_CHECKING:
    from tsgt.radio.base import LoRaSettings
    from tsgt.radio.classic.messages import Letter

TURNAROUND_NS = 100_000_000
"""Largest turnaround of a station, from a request to its reply; the authors' nodes take 12 ms."""

SINGLE_MEASUREMENT_TIMEOUT_NS = 20_000_000_000  # timeout of a single measurement: instruments take 1 to 10 s


@dataclass(frozen=True, slots=True)
class LinkTiming:
    """Durations at one modem setting; ``reply_timeout_ns``: from the end of a request to RxDone of its reply."""

    settings: LoRaSettings
    reply_timeout_ns: int

    @property
    def rx_done_ns(self) -> int:
        """Nominal delay from the end of a packet to RxDone of its receiver."""
        return self.settings.rx_done_ns

    def airtime_ns(self, payload_bytes: int) -> int:
        """Return the airtime of a packet."""
        return self.settings.airtime_ns(payload_bytes)

    def timeout_ns(self, reply_bytes: int) -> int:
        """Return the timeout of a reply: as configured, or longer where its airtime demands it (SF 10 and above)."""
        return max(self.reply_timeout_ns, self.airtime_ns(reply_bytes) + self.rx_done_ns + TURNAROUND_NS)


@dataclass(frozen=True, slots=True)
class Request:
    """A packet to send, and its timeout from the end of the transmission to RxDone of the reply; 0: no reply."""

    payload: bytes
    reply_timeout_ns: int


class Transaction(ABC):
    """A sequence of requests to one station.

    Send each :meth:`request`. If it expects a reply, pass received packets to :meth:`accept_reply` until one is
    accepted, or call :meth:`timed_out`. Then continue with the next request.
    """

    def __init__(self, station: int) -> None:
        self.station = station

    @abstractmethod
    def request(self) -> Request | None:
        """Return what to send next; None: the transaction is over."""

    @abstractmethod
    def accept_reply(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:
        """Take any packet that was received after the request; return whether it is the reply.

        Parameters
        ----------
        payload
            Of any packet.
        sent_ns, received_ns
            Start of the request on the air, and RxDone of this packet, on the master's Unix clock.
        exact
            Both timestamps are edges of the radio's interrupt line.
        """

    def timed_out(self) -> None:  # noqa: B027 (optional)
        """Take note that no reply came in time."""


class Poll(Transaction):
    """Requests a station's newest measurement, once; the ``message`` may repeat that of an earlier poll."""

    def __init__(self, station: int, timing: LinkTiming) -> None:
        super().__init__(station)
        self.message: MeasurementMessage | None = None
        self._timeout_ns = timing.timeout_ns(MEASUREMENT_BYTES)
        self._requested = False

    @property
    def has_reply(self) -> bool:
        """Whether the station has replied."""
        return self.message is not None

    def request(self) -> Request | None:
        """See :meth:`Transaction.request`."""
        if self._requested:
            return None
        self._requested = True
        return Request(CommandMessage("t", self.station).to_bytes(), self._timeout_ns)

    def accept_reply(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:  # noqa: ARG002
        """See :meth:`Transaction.accept_reply`."""
        reply = decode_reply(payload)
        if not isinstance(reply, MeasurementMessage) or reply.station != self.station:
            return False
        self.message = reply
        return True


class SingleMeasurementPoll(Poll):
    """Requests a single measurement from a station in direct mode, once.

    A reply after the timeout is indistinguishable from the reply to the next request. So ``timeout_ns``, the time for the
    instrument alone, should be longer than it ever takes.
    """

    def __init__(
        self, station: int, timing: LinkTiming, timeout_ns: int = SINGLE_MEASUREMENT_TIMEOUT_NS
    ) -> None:
        super().__init__(station, timing)
        self._timeout_ns += timeout_ns


class CommandTransaction(Transaction):
    """Sends a station the command ``d`` or ``n``, once.

    ``c`` precedes it: a node that was left in the middle of a synchronisation is still in that mode. ``timeout_ns`` is
    the time for the instrument, say to turn. ``ok``: the acknowledgement; None without one.
    """

    def __init__(self, station: int, command: CommandMessage, timeout_ns: int) -> None:
        super().__init__(station)
        self.ok: bool | None = None
        self._command = command
        self._requests = [
            Request(command.to_bytes(), timeout_ns),
            Request(CommandMessage("c", station).to_bytes(), 0),
        ]

    def request(self) -> Request | None:
        """See :meth:`Transaction.request`."""
        return self._requests.pop() if self._requests else None

    def accept_reply(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:  # noqa: ARG002
        """See :meth:`Transaction.accept_reply`."""
        reply = decode_reply(payload)
        if not isinstance(reply, Acknowledgement) or reply.letter != self._command.letter:
            return False
        self.ok = reply.ok
        return True


class _Step(Enum):
    ENTER = "p"
    FLUSH = "s, whose reply shows that the station has processed everything before"
    PING = "e"
    TIMESTAMP = "s"
    LEAVE = "c"


class Synchronisation(Transaction):
    """Compares a station's clock with the master's, cycle by cycle.

    A cycle has two requests: a ping, whose reception the station timestamps, and a request for that timestamp. Neither
    reply states its cycle. A sample is made only if

    - the ping's reply was received in this cycle, not earlier than possible;
    - after a ping without a reply, the station has first replied to something else: it replies in order, so no reply of
      the lost cycle can follow (``p`` and ``s`` are sent for that, and the timestamp is ignored);
    - the timestamp is new in this synchronisation;
    - both instants of the master are edges.

    A sample bounds the clock offset from both sides. If the bounds of two samples exclude each other, one is wrong or
    the clock was set in between, and all samples before the second are dropped. They are also dropped when the station,
    having replied to a ping, reports none: its program has restarted. Cycles without a sample are repeated until half
    of the cycles have one, but at most as many again. A single sample at the end is dropped. ``cycles``: 1 or more.
    ``timestamp_delay_ns``: how late the station timestamps a reception, after its RxDone.

    Attributes
    ----------
    samples
        One for each good cycle; all agree.
    has_reply
        Whether the station has replied to anything.
    missed_replies
        Number of requests without a reply.
    longest_silence_ns
        Since the last sample: the longest time between two replies with a missed one in between. The station may have
        restarted in it, and been pinged afterwards.
    restarted
        Whether the station's program has restarted meanwhile, by its own report; all samples are from after that.
    """

    MAX_MISSED_REPLIES = 3  # this many requests in a row without a reply end the synchronisation
    LEAVE_REPEATS = 2
    """How often ``c`` is sent: it has no reply, and a node that misses it does not reply to polls."""
    MIN_SAMPLES = 2  # this many samples have to agree, if that many cycles were requested
    TOLERANCE_NS = 5_000_000
    """Tolerance of clocks, timestamps and known delays before a reply or a sample is rejected."""
    TOLERANCE_PPM = 500  # tolerance of a station's skew between two samples

    def __init__(self, station: int, cycles: int, timing: LinkTiming, timestamp_delay_ns: int = 0) -> None:
        super().__init__(station)
        self.samples: list[ClockSample] = []
        self.has_reply = False
        self.missed_replies = 0
        self.longest_silence_ns = 0
        self.restarted = False
        self._last_reply_ns: int | None = None
        self._cycles = cycles
        self._timing = timing
        self._back_ns = timing.airtime_ns(PING_REPLY_BYTES) + timing.rx_done_ns
        self._forward_ns = timing.airtime_ns(COMMAND_BYTES) + timing.rx_done_ns + timestamp_delay_ns
        self._step = _Step.ENTER
        self._needs_flush = False
        self._pings = 0
        self._consecutive_misses = 0
        self._leaves_sent = 0
        self._inconsistent = False
        self._ping_ns = (0, 0)
        self._timestamps_ns = {0}  # a station without a timestamp sends 0

    def request(self) -> Request | None:
        """See :meth:`Transaction.request`."""
        match self._step:
            case _Step.ENTER:
                self._step = _Step.FLUSH if self._needs_flush else _Step.PING
                return self._make("p", 0)
            case _Step.PING:
                self._pings += 1
                return self._make("e", self._timing.timeout_ns(PING_REPLY_BYTES))
            case _Step.TIMESTAMP | _Step.FLUSH:
                return self._make("s", self._timing.timeout_ns(TIME_REPLY_BYTES))
            case _Step.LEAVE if self._leaves_sent < self.LEAVE_REPEATS:
                self._leaves_sent += 1
                return self._make("c", 0)
            case _Step.LEAVE:
                return None

    def accept_reply(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:
        """See :meth:`Transaction.accept_reply`."""
        reply = decode_reply(payload)
        if isinstance(reply, PingReply) and self._step is _Step.PING:
            if reply.station != self.station or received_ns < self._earliest_reply_ns(sent_ns):
                return False
            self._note_reply(received_ns)
            self._ping_ns = (sent_ns, received_ns)
            self._step = _Step.TIMESTAMP if exact else self._next_cycle()
        elif isinstance(reply, TimeReply) and self._step is _Step.FLUSH:
            self._note_reply(received_ns)
            self._detect_restart(reply)
            self._timestamps_ns.add(reply.time_ns)
            self._needs_flush = False
            self._step = _Step.PING
        elif isinstance(reply, TimeReply) and self._step is _Step.TIMESTAMP:
            self._note_reply(received_ns)
            self._detect_restart(reply)
            self._add_sample(reply.time_ns)
            self._step = self._next_cycle()
        else:
            return False
        return True

    def timed_out(self) -> None:
        """See :meth:`Transaction.timed_out`."""
        self._consecutive_misses += 1
        self.missed_replies += 1
        if self._consecutive_misses >= self.MAX_MISSED_REPLIES:
            self._end()
        elif self._step is not _Step.TIMESTAMP:  # the station still has a timestamp whose reply was lost
            self._needs_flush = True
            self._step = _Step.ENTER if self._cycles_left() else self._end()

    def _note_reply(self, received_ns: int) -> None:
        if self._consecutive_misses and self._last_reply_ns is not None:
            self.longest_silence_ns = max(self.longest_silence_ns, received_ns - self._last_reply_ns)
        self._last_reply_ns = received_ns
        self.has_reply = True
        self._consecutive_misses = 0

    def _make(self, letter: Letter, reply_timeout_ns: int) -> Request:
        return Request(CommandMessage(letter, self.station).to_bytes(), reply_timeout_ns)

    def _earliest_reply_ns(self, sent_ns: int) -> int:
        tolerance_ns = self.TOLERANCE_NS + self._timing.settings.symbol_ns // 4
        return sent_ns + self._forward_ns + self._back_ns - tolerance_ns

    def _detect_restart(self, reply: TimeReply) -> None:
        """Drop all samples when a station that has replied to a ping has no timestamp; its clock may be another one."""
        if reply.time_ns == 0 and self._ping_ns != (0, 0):
            self.restarted = True
            self.samples.clear()

    def _add_sample(self, station_ns: int) -> None:
        if station_ns in self._timestamps_ns:
            self._needs_flush = True
            return
        self._timestamps_ns.add(station_ns)
        self.longest_silence_ns = 0  # a restarted program would not have this timestamp
        sent_ns, received_ns = self._ping_ns
        sample = ClockSample(
            sent_ns=sent_ns,
            station_ns=station_ns,
            received_ns=received_ns,
            forward_ns=self._forward_ns,
            back_ns=self._back_ns,
        )
        if self.samples and not self._agree(self.samples[-1], sample):
            self._inconsistent = True
            self.samples.clear()
        self.samples.append(sample)

    def _agree(self, one: ClockSample, other: ClockSample) -> bool:
        """Whether the offset intervals of two samples overlap."""
        tolerance_ns = self.TOLERANCE_NS + (other.sent_ns - one.sent_ns) * self.TOLERANCE_PPM // 1_000_000
        return (
            one.min_offset_ns - tolerance_ns <= other.max_offset_ns
            and other.min_offset_ns - tolerance_ns <= one.max_offset_ns
        )

    def _cycles_left(self) -> bool:
        sufficient = 2 * len(self.samples) >= self._cycles
        return self._pings < (self._cycles if sufficient else 2 * self._cycles)

    def _next_cycle(self) -> _Step:
        if not self._cycles_left():
            return self._end()
        return _Step.ENTER if self._needs_flush else _Step.PING

    def _end(self) -> _Step:
        # Too few samples cannot decide which of two inconsistent ones is right, and a single one may be replayed.
        needed = min(self.MIN_SAMPLES, self._cycles)
        if (self._inconsistent and 2 * len(self.samples) < self._cycles) or len(self.samples) < needed:
            self.samples.clear()
        self._step = _Step.LEAVE
        return self._step
