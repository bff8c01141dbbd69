"""What a station and a master have to say to each other besides measurements: orders, answers, how the station does."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.wire import order_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.radio.commands import Order
    from tsgt.radio.superframe.wire import AnswerPart, OrderPart, Reply, ShotPart, StatePart

LONGEST_TURN_ROUND_PAUSE = 48
"""The master makes room for a turn-round in one of 32 replies. After so many without it the backlog waits; it
waits for the first one too, and when a beacon has been doubted, for nothing else shows a delay that is always there."""


class Situation(NamedTuple):
    """What the instrument is doing.

    Attributes
    ----------
    prism
        Number of the prism that it tracks, or did before direct mode.
    direct
        It is in direct mode.
    connected
        There is one.
    """

    prism: int
    direct: bool
    connected: bool


class Conversation:
    """The station's side of it, in one session of a master. Everything is said until it is acknowledged.

    Attributes
    ----------
    answers, shots
        What became of orders, oldest first, not acknowledged yet.
    """

    def __init__(self) -> None:
        self.answers: deque[AnswerPart] = deque()
        self.shots: deque[ShotPart] = deque()
        self._tickets: frozenset[int] = frozenset()
        self._orders: deque[tuple[int, Order]] = deque()
        self._told: Situation | None = None
        self._said: dict[
            int, int
        ] = {}  # prisms that the master may take for the tracked one, by the latest frame
        self._replies_since = LONGEST_TURN_ROUND_PAUSE

    # --- Orders -----------------------------------------------------------------------------------------------

    def take(self, parts: Iterable[OrderPart]) -> None:
        """Take a beacon's orders to this station; those that have come before are passed over.

        An order stands in each beacon until it is answered or another one takes its place, and then never again. So a
        ticket that was not in the last beacon with orders is another order's, however often tickets have come round.
        """
        parts = tuple(parts)
        self._orders.extend(
            (part.ticket, order_of(part)) for part in parts if part.ticket not in self._tickets
        )
        if parts:
            self._tickets = frozenset(part.ticket for part in parts)

    def next_order(self) -> tuple[int, Order] | None:
        """Return the next order and its ticket, once; None without any."""
        return self._orders.popleft() if self._orders else None

    # --- Replies ----------------------------------------------------------------------------------------------

    def must_tell(self, situation: Situation) -> bool:
        """Whether the master does not know, or may not know, what the instrument is doing."""
        return situation != self._told or any(prism != situation.prism for prism in self._said)

    @property
    def turn_round_is_overdue(self) -> bool:
        """Whether a turn-round, and a word of how the station does, are wanted more than the backlog."""
        return self._replies_since >= LONGEST_TURN_ROUND_PAUSE

    def doubt(self) -> None:
        """Want a turn-round, and a word of how the station does, at once."""
        self._replies_since = LONGEST_TURN_ROUND_PAUSE

    def plain_prism(self, state: StatePart | None) -> int | None:
        """Return the prism that the master is certain to take for the tracked one, in a reply with this part."""
        prisms = set(self._said)
        if state is not None:
            prisms.add(state.prism)
        return None if self._told is None or prisms - {self._told.prism} else self._told.prism

    def said(self, reply: Reply, counter: int) -> None:
        """Take it that a reply is on the air in this frame."""
        if reply.state is not None:
            self._said[reply.state.prism] = counter
        self._replies_since = 0 if reply.turn_round_us is not None else self._replies_since + 1

    def acknowledged(self, reply: Reply, counter: int) -> None:
        """Take it that the master has the reply of this frame."""
        state = reply.state
        if state is not None:
            self._told = Situation(state.prism, state.direct, state.connected)
            self._said = {prism: said for prism, said in self._said.items() if said > counter}
        if reply.answer is not None and reply.answer in self.answers:
            self.answers.remove(reply.answer)
        if reply.shot is not None and reply.shot in self.shots:
            self.shots.remove(reply.shot)
