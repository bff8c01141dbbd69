"""The paper's protocol, both sides, without radio and clock: packets and their instants in, packets out.

The master asks, one station answers (:class:`ClassicStation`). What the master does is made of turns
(:class:`Turn`): a poll, a synchronisation, an order. A turn says what to send next, and is told what came back.

The protocol has no numbers by which a late reply could be told from the one that is waited for, and two of its
replies do not even name their station. What guards against a wrong clock sample is written at
:class:`Synchronisation`.
"""

from __future__ import annotations

from tsgt.radio.classic_messages import (
    MEASUREMENT_BYTES,
    Acknowledgement,
    Command,
    MeasurementMessage,
    decode_reply,
)
from tsgt.radio.classic_station import ClassicStation
from tsgt.radio.classic_synchronisation import Synchronisation
from tsgt.radio.classic_turn import TURN_ROUND_NS, Request, Timing, Turn

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
        return Request(Command("t", self.station).to_bytes(), self._timeout_ns)

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


class Ordered:
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

    def __init__(self, station: int, order: Command, timeout_ns: int) -> None:
        self.station = station
        self.ok: bool | None = None
        self._order = order
        self._requests = [Request(order.to_bytes(), timeout_ns), Request(Command("c", station).to_bytes(), 0)]

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
