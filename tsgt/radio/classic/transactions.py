"""The paper's protocol, both sides, without radio and clock: packets and their instants in, packets out.

The master asks, one station answers (:class:`ClassicStation`). What the master does is made of turns
(:class:`Turn`): a poll, a synchronisation, an order. A turn says what to send next, and is told what came back.

The protocol has no numbers by which a late reply could be told from the one that is waited for, and two of its
replies do not even name their station. What guards against a wrong clock sample is written at
:class:`Synchronisation`.

Comparing clocks with the paper's protocol, which gives its replies no numbers.
"""

from __future__ import annotations

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
from tsgt.radio.classic.station import ClassicStation
from tsgt.radio.classic.turn import TURNAROUND_NS, Request, Timing, Turn

if TYPE_CHECKING:
    from tsgt.radio.classic.messages import Letter


class _Step(Enum):
    ENTER = "p"
    FLUSH = "s, to hear that the station has done with everything before"
    PING = "e"
    STAMP = "s"
    LEAVE = "c"


class Synchronisation:
    """Compare a station's clock with the master's, cycle by cycle.

    A cycle takes two requests: a ping, of which the station stamps the reception, and a request for that stamp.
    Neither reply says which cycle it belongs to. A sample is made only if

    - the ping was answered in this cycle, not earlier than a reply can be there;
    - after a ping without an answer the station has answered something else first: it answers in order, so that no
      reply of the lost cycle can come any more (``p`` and ``s`` are sent for that, and the stamp is passed over);
    - the stamp has not come before in this synchronisation;
    - both instants of the master are edges and no guesses.

    A sample bounds the clock's offset from both sides. If the bounds of two samples exclude each other, one of them
    is wrong or the station's clock was set between them, and all before the second are dropped. They are dropped as well
    when the station, having answered a ping, says that it has heard none: its program was started again. Cycles that
    brought no sample are repeated until there are samples for half of them, but at most as many again. A sample that is
    alone at the end does not count.

    Parameters
    ----------
    station
        Which station.
    cycles
        How many cycles, 1 or more.
    timing
        How long packets and replies take.
    stamp_delay_ns
        How late the station stamps a reception, after its RxDone.

    Attributes
    ----------
    samples
        One for each good cycle, all of which agree with each other.
    answered
        Whether the station has answered anything.
    unanswered
        How many requests it has not answered.
    silence_ns
        Since the last sample: the longest time between two answers with a request unanswered in between, in ns. The
        station may have been restarted meanwhile, and pinged afterwards.
    restarted
        Whether its program was started again meanwhile, by its own word; all samples are from after that.
    """

    SILENT = 3
    """So many requests in a row without a reply end the synchronisation."""
    FAREWELLS = 2
    """How often ``c`` is sent: nothing answers it, and a node that misses it does not answer polls."""
    FEWEST = 2
    """So many samples have to agree, if that many cycles were asked for."""
    SLACK_NS = 5_000_000
    """Clocks, stamps and known times may be off by this much before a reply or a sample is refused."""
    SLACK_PPM = 500
    """Drift that a station's clock may have between two samples."""

    def __init__(self, station: int, cycles: int, timing: Timing, stamp_delay_ns: int = 0) -> None:
        self.station = station
        self.samples: list[ClockSample] = []
        self.answered = False
        self.unanswered = 0
        self.silence_ns = 0
        self.restarted = False
        self._heard_ns: int | None = None
        self._cycles = cycles
        self._timing = timing
        self._back_ns = timing.airtime_ns(PING_REPLY_BYTES) + timing.rx_done_ns
        self._forward_ns = timing.airtime_ns(COMMAND_BYTES) + timing.rx_done_ns + stamp_delay_ns
        self._step = _Step.ENTER
        self._flush = False
        self._begun = 0
        self._silent = 0
        self._farewells = 0
        self._contradicted = False
        self._ping_ns = (0, 0)
        self._stamps_ns = {0}  # a station without a stamp sends 0

    def request(self) -> Request | None:
        """See :meth:`Turn.request`."""
        match self._step:
            case _Step.ENTER:
                self._step = _Step.FLUSH if self._flush else _Step.PING
                return self._ask("p", 0)
            case _Step.PING:
                self._begun += 1
                return self._ask("e", self._timing.timeout_ns(PING_REPLY_BYTES))
            case _Step.STAMP | _Step.FLUSH:
                return self._ask("s", self._timing.timeout_ns(TIME_REPLY_BYTES))
            case _Step.LEAVE if self._farewells < self.FAREWELLS:
                self._farewells += 1
                return self._ask("c", 0)
            case _Step.LEAVE:
                return None

    def replied(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:
        """See :meth:`Turn.replied`."""
        reply = decode_reply(payload)
        if isinstance(reply, PingReply) and self._step is _Step.PING:
            if reply.station != self.station or received_ns < self._earliest_ns(sent_ns):
                return False
            self._heard(received_ns)
            self._ping_ns = (sent_ns, received_ns)
            self._step = _Step.STAMP if exact else self._next_cycle()
        elif isinstance(reply, TimeReply) and self._step is _Step.FLUSH:
            self._heard(received_ns)
            self._look_for_restart(reply)
            self._stamps_ns.add(reply.time_ns)
            self._flush = False
            self._step = _Step.PING
        elif isinstance(reply, TimeReply) and self._step is _Step.STAMP:
            self._heard(received_ns)
            self._look_for_restart(reply)
            self._take(reply.time_ns)
            self._step = self._next_cycle()
        else:
            return False
        return True

    def timed_out(self) -> None:
        """See :meth:`Turn.timed_out`."""
        self._silent += 1
        self.unanswered += 1
        if self._silent >= self.SILENT:
            self._end()
        elif (
            self._step is not _Step.STAMP
        ):  # a stamp that did not arrive is still there, and is asked for again
            self._flush = True
            self._step = _Step.ENTER if self._cycles_left() else self._end()

    def _heard(self, received_ns: int) -> None:
        if self._silent and self._heard_ns is not None:
            self.silence_ns = max(self.silence_ns, received_ns - self._heard_ns)
        self._heard_ns = received_ns
        self.answered = True
        self._silent = 0

    def _ask(self, letter: Letter, reply_timeout_ns: int) -> Request:
        return Request(CommandMessage(letter, self.station).to_bytes(), reply_timeout_ns)

    def _earliest_ns(self, sent_ns: int) -> int:
        tolerance_ns = self.SLACK_NS + self._timing.symbol_ns // 4
        return sent_ns + self._forward_ns + self._back_ns - tolerance_ns

    def _look_for_restart(self, reply: TimeReply) -> None:
        """Drop what there is when a station that has answered a ping knows of none; its clock may be another one."""
        if reply.time_ns == 0 and self._ping_ns != (0, 0):
            self.restarted = True
            self.samples.clear()

    def _take(self, station_ns: int) -> None:
        if station_ns in self._stamps_ns:
            self._flush = True
            return
        self._stamps_ns.add(station_ns)
        self.silence_ns = 0  # a program that was started anew would not have this stamp
        sent_ns, received_ns = self._ping_ns
        sample = ClockSample(
            sent_ns=sent_ns,
            station_ns=station_ns,
            received_ns=received_ns,
            forward_ns=self._forward_ns,
            back_ns=self._back_ns,
        )
        if self.samples and not self._agree(self.samples[-1], sample):
            self._contradicted = True
            self.samples.clear()
        self.samples.append(sample)

    def _agree(self, one: ClockSample, other: ClockSample) -> bool:
        slack_ns = self.SLACK_NS + (other.sent_ns - one.sent_ns) * self.SLACK_PPM // 1_000_000
        (one_low, one_high), (other_low, other_high) = _offset_bounds_ns(one), _offset_bounds_ns(other)
        return one_low - slack_ns <= other_high and other_low - slack_ns <= one_high

    def _cycles_left(self) -> bool:
        enough = 2 * len(self.samples) >= self._cycles
        return self._begun < (self._cycles if enough else 2 * self._cycles)

    def _next_cycle(self) -> _Step:
        if not self._cycles_left():
            return self._end()
        return _Step.ENTER if self._flush else _Step.PING

    def _end(self) -> _Step:
        if self._contradicted and 2 * len(self.samples) < self._cycles:
            self.samples.clear()  # too few to say which of those that exclude each other are right
        elif len(self.samples) < min(self.FEWEST, self._cycles):
            self.samples.clear()  # nothing would contradict a stamp that somebody plays back
        self._step = _Step.LEAVE
        return self._step


def _offset_bounds_ns(sample: ClockSample) -> tuple[int, int]:
    """Least and largest offset of the station's clock (positive: ahead of the master's) that a sample allows."""
    most_ns = sample.station_ns - sample.sent_ns - sample.forward_ns
    return most_ns - max(0, sample.excess_ns), most_ns


__all__ = [
    "TURN_ROUND_NS",
    "ClassicStation",
    "Ordered",
    "Poll",
    "Request",
    "Shot",
    "Synchronisation",
    "Timing",
    "Turn",
]

SHOT_TIMEOUT_NS = 20_000_000_000
"""How long a single measurement may take: instruments take 1 to 10 s."""


class Poll:
    """Ask a station for its newest measurement, once.

    Parameters
    ----------
    station, timing
        Which station, and how long its reply may take.

    Attributes
    ----------
    message
        What it answered; None before, or without an answer. It may have come already in an earlier poll.
    """

    def __init__(self, station: int, timing: Timing) -> None:
        self.station = station
        self.message: MeasurementMessage | None = None
        self._timeout_ns = timing.timeout_ns(MEASUREMENT_BYTES)
        self._asked = False

    @property
    def answered(self) -> bool:
        """Whether the station has answered."""
        return self.message is not None

    def request(self) -> Request | None:
        """See :meth:`Turn.request`."""
        if self._asked:
            return None
        self._asked = True
        return Request(CommandMessage("t", self.station).to_bytes(), self._timeout_ns)

    def replied(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:  # noqa: ARG002
        """See :meth:`Turn.replied`."""
        reply = decode_reply(payload)
        if not isinstance(reply, MeasurementMessage) or reply.station != self.station:
            return False
        self.message = reply
        return True

    def timed_out(self) -> None:
        """See :meth:`Turn.timed_out`."""


class Shot(Poll):
    """Ask a station in direct mode for a single measurement, once.

    A station whose answer comes after the time-out cannot be told from one that answers the next shot. The time
    should therefore be longer than the instrument ever takes.

    Parameters
    ----------
    station, timing
        As for :class:`Poll`.
    timeout_ns
        How long the instrument may take.
    """

    def __init__(self, station: int, timing: Timing, timeout_ns: int = SHOT_TIMEOUT_NS) -> None:
        super().__init__(station, timing)
        self._timeout_ns += timeout_ns


class CommandTransaction:
    """Give a station an order, ``d`` or ``n``, once.

    ``c`` goes ahead: a node that a master has left in the middle of a synchronisation is still in that mode.

    Parameters
    ----------
    station, order
        Which station, and what it is to do.
    timeout_ns
        How long it may take: a turn of the instrument, say.

    Attributes
    ----------
    ok
        What it answered; None before, or without an answer.
    """

    def __init__(self, station: int, order: CommandMessage, timeout_ns: int) -> None:
        self.station = station
        self.ok: bool | None = None
        self._order = order
        self._requests = [Request(order.to_bytes(), timeout_ns), Request(CommandMessage("c", station).to_bytes(), 0)]

    def request(self) -> Request | None:
        """See :meth:`Turn.request`."""
        return self._requests.pop() if self._requests else None

    def replied(self, payload: bytes, *, sent_ns: int, received_ns: int, exact: bool) -> bool:  # noqa: ARG002
        """See :meth:`Turn.replied`."""
        reply = decode_reply(payload)
        if not isinstance(reply, Acknowledgement) or reply.letter != self._order.letter:
            return False
        self.ok = reply.ok
        return True

    def timed_out(self) -> None:
        """See :meth:`Turn.timed_out`."""
