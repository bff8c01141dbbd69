"""Commands, responses and status reports of a station in one session of a master. Sans-I/O.

The station repeats responses, measurements and status reports until the master acknowledges them.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.condition import UNKNOWN_CONDITION, ConditionReporter, InstrumentCondition
from tsgt.radio.superframe.wire import decode_command

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.radio.commands import Command
    from tsgt.radio.superframe.wire import (
        CommandResponse,
        EncodedCommand,
        Reply,
        SingleMeasurement,
        StatusReport,
    )

MAX_REPLIES_WITHOUT_TURNAROUND = 48
"""The master has room for a turnaround in one of 32 replies. After this many without one it takes precedence over the
backlog; so does the first one, and one after a rejected beacon, because only a turnaround reveals a constant delay."""


class InstrumentState(NamedTuple):
    """State of the instrument."""

    prism: int  # the tracked prism, or the last one before direct mode
    direct: bool  # it is in direct mode
    connected: bool
    condition: InstrumentCondition = UNKNOWN_CONDITION  # reported in turn; no report waits for it


class CommandExchange:
    """The station's side."""

    def __init__(self) -> None:
        # Not acknowledged, oldest first.
        self.responses: deque[CommandResponse] = deque()
        self.single_measurements: deque[SingleMeasurement] = deque()
        self._command_ids: frozenset[int] = frozenset()
        self._commands: deque[tuple[int, Command]] = deque()
        self._acknowledged: InstrumentState | None = None
        self.conditions = ConditionReporter()
        # Prisms that the master may assume to be tracked, with the latest frame that reported them.
        self._reported_prisms: dict[int, int] = {}
        self._replies_without_turnaround = MAX_REPLIES_WITHOUT_TURNAROUND

    def receive(self, encoded: Iterable[EncodedCommand]) -> None:
        """Queue the new ones among a beacon's commands to this station.

        Every beacon repeats a command until its response is received or another command replaces it. So an id that was
        not in the last beacon with commands belongs to a new command, even after the ids have wrapped.
        """
        encoded = tuple(encoded)
        self._commands.extend(
            (each.command_id, decode_command(each))
            for each in encoded
            if each.command_id not in self._command_ids
        )
        if encoded:
            self._command_ids = frozenset(each.command_id for each in encoded)

    def next_command(self) -> tuple[int, Command] | None:
        """Remove and return the next command and its id; None without one."""
        return self._commands.popleft() if self._commands else None

    def needs_report(self, state: InstrumentState) -> bool:
        """Whether the master may not know the state of the instrument."""
        known = state._replace(condition=UNKNOWN_CONDITION) == self._acknowledged
        return not known or any(prism != state.prism for prism in self._reported_prisms)

    @property
    def turnaround_overdue(self) -> bool:
        """Whether a turnaround and a status report take precedence over the backlog."""
        return self._replies_without_turnaround >= MAX_REPLIES_WITHOUT_TURNAROUND

    def request_turnaround(self) -> None:
        """Let a turnaround and a status report take precedence at once."""
        self._replies_without_turnaround = MAX_REPLIES_WITHOUT_TURNAROUND

    def known_prism(self, report: StatusReport | None) -> int | None:
        """Return the prism that the master certainly assumes to be tracked, given a reply with this report."""
        prisms = set(self._reported_prisms)
        if report is not None:
            prisms.add(report.prism)
        acknowledged = self._acknowledged
        return None if acknowledged is None or prisms - {acknowledged.prism} else acknowledged.prism

    def sent(self, reply: Reply, counter: int) -> None:
        """Take the reply of this frame as sent."""
        if reply.status_report is not None:
            self._reported_prisms[reply.status_report.prism] = counter
            self.conditions.sent(reply.status_report.condition)
        has_turnaround = reply.turnaround_us is not None
        self._replies_without_turnaround = 0 if has_turnaround else self._replies_without_turnaround + 1

    def acknowledged(self, reply: Reply, counter: int) -> None:
        """Take the reply of this frame as acknowledged."""
        report = reply.status_report
        if report is not None:
            self._acknowledged = InstrumentState(report.prism, report.direct, report.connected)
            self.conditions.acknowledged(report.condition)
            self._reported_prisms = {
                prism: sent for prism, sent in self._reported_prisms.items() if sent > counter
            }
        if reply.response is not None and reply.response in self.responses:
            self.responses.remove(reply.response)
        single = reply.single_measurement
        if single is not None and single in self.single_measurements:
            self.single_measurements.remove(single)
