"""One station as the master knows it: session, commands, status; composes receive window, demand and timing. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.commands import SearchCommand
from tsgt.radio.superframe.condition import (
    NO_INSTRUMENT,
    UNKNOWN_CONDITION,
    InstrumentCondition,
    updated_condition,
)
from tsgt.radio.superframe.demand import DEFAULT_GRANT, grant
from tsgt.radio.superframe.receive_window import ReceiveWindow
from tsgt.radio.superframe.reception import ReceivedReply, TimedMeasurement
from tsgt.radio.superframe.wire import ACK_FRAMES, JoinConfirmation, encode_command

if TYPE_CHECKING:
    from tsgt.radio.commands import Command
    from tsgt.radio.superframe.demand import DemandEstimator
    from tsgt.radio.superframe.reception import ReplyTiming
    from tsgt.radio.superframe.timing import StationTiming
    from tsgt.radio.superframe.wire import (
        CommandResponse,
        EncodedCommand,
        Reply,
        SingleMeasurement,
        StatusReport,
    )

FULL_TIME_FRAMES = 3  # beacons with the full time after a join request: the station needs two that agree


class _PendingCommand(NamedTuple):
    command_id: int
    command: Command


class StationState:
    """What the master knows of one station; ``prism`` is tracked unless it reports another."""

    def __init__(self, number: int, prism: int, timing: StationTiming, demand: DemandEstimator) -> None:
        self.number = number
        self.window = ReceiveWindow()
        self.demand = demand
        self.timing = timing
        self.nonce: int | None = None  # of its join request in this session
        self.join_pending = False  # the last reply still contained a join request
        self.lacks_time = False  # its times are relative to the beacon, not session time
        self.silent_frames = 0  # frames with a slot since its last reply
        self.missed_slots = 0  # reported by the station, counted since its first report
        self.rejected_beacons = 0
        self._default_prism = prism
        self._confirmation_nonce: int | None = None
        self._join_counter = 0
        self._status: StatusReport | None = None
        self._condition = UNKNOWN_CONDITION
        self._command_id = 0
        self._pending: _PendingCommand | None = None

    def reset_session(self) -> None:
        """Start a new session; what was received and recorded stays so."""
        self.nonce, self._confirmation_nonce, self._status = None, None, None
        self._condition = UNKNOWN_CONDITION
        self.timing.reset()
        self.window.forget_replies()

    @property
    def condition(self) -> InstrumentCondition:
        """Condition of its instrument, as far as reported in this session."""
        if self._status is not None and not self._status.connected:
            return InstrumentCondition(problem=NO_INSTRUMENT)
        return self._condition

    def submit(self, command: Command) -> int:
        """Send a command, replacing a pending one; return its id."""
        self._command_id = (self._command_id + 1) % 16
        self._pending = _PendingCommand(self._command_id, command)
        return self._command_id

    def withdraw(self, kind: type[Command]) -> None:
        """Cancel a pending command of this kind; a response to it is ignored."""
        if self._pending is not None and isinstance(self._pending.command, kind):
            self._pending = None

    def is_tracking(self, prism: int) -> bool:
        """Whether the station is present, reports to track this prism, and has no other command pending."""
        status, pending = self._status, self._pending
        return (
            status is not None
            and (status.prism, status.direct, status.connected) == (prism, False, True)
            and self.silent_frames < ACK_FRAMES
            and not self.join_pending
            and (pending is None or isinstance(pending.command, SearchCommand))
        )

    @property
    def encoded_command(self) -> EncodedCommand | None:
        """The pending command; None while the station would not execute it."""
        if self._pending is None or self.nonce is None or self.join_pending:
            return None
        tracked = self._default_prism if self._status is None else self._status.prism
        return encode_command(self.number, self._pending.command_id, self._pending.command, tracked)

    @property
    def confirmation(self) -> JoinConfirmation | None:
        """Confirmation of a join request for the next beacon."""
        nonce = self._confirmation_nonce
        return None if nonce is None else JoinConfirmation(self.number, nonce)

    def confirmation_sent(self) -> None:
        """Take that the beacon with the confirmation has been sent."""
        self._confirmation_nonce = None

    def needs_full_time(self, counter: int) -> bool:
        """Whether this beacon has to carry the full time: the station has just joined, or its beacons were delayed."""
        joins = self.nonce is not None and counter - self._join_counter <= FULL_TIME_FRAMES
        return joins or self.timing.beacon_delay.delay_ns > 0

    def grant(self, counter: int, slot_ns: int, *, cap: int) -> int:
        """Return the grant, at most ``cap``, for a frame in which the station's slot starts about then."""
        if self.join_pending or self.nonce is None:
            return DEFAULT_GRANT
        demand = self.demand.predict(
            counter,
            self.timing.session_us(slot_ns),
            self.window,
            silent_frames=self.silent_frames,
            exchanges=self.timing.link_delay.exchanges,
            pending=None if self._pending is None else self._pending.command,
        )
        return DEFAULT_GRANT if demand is None else grant(demand, cap=cap, silent_frames=self.silent_frames)

    def first_sequence(self, reply: Reply) -> int:
        """Return the full number of the first measurement of a reply; 0 without one."""
        return self.window.newest_sequence(reply.blocks[0], reply) if reply.blocks else 0

    def take(self, reply: Reply, at: ReplyTiming) -> ReceivedReply:
        """Take an authentic reply of this station."""
        joined = self._join(reply, at.counter)
        if reply.blocks:
            self.lacks_time = reply.blocks[0].beacon_relative
        self.timing.update_beacon_delay(at)
        outstanding = self.window.outstanding
        sequences: list[int] = []
        measurements: list[TimedMeasurement] = []
        prism = self._tracked_prism(reply)
        for block in reply.blocks:
            newest_sequence = self.window.newest_sequence(block, reply)
            found = self.timing.timestamps(block, newest_sequence, block.prism or prism, at)
            sequences += [measurement.sequence for measurement in found]
            measurements += [measurement for measurement in found if self.window.accept(measurement.sequence)]
        measurements.sort(key=lambda measurement: measurement.sequence)
        self.window.add_reply(at.counter, sequences)
        self.demand.update(
            reply,
            at,
            [measurement.measured_ns for measurement in measurements],
            self.timing,
            outstanding,
            self.window.outstanding,
        )
        self.silent_frames = 0
        command, response, single_measurement = self._complete(reply)
        return ReceivedReply(
            station=self.number,
            measurements=tuple(measurements),
            repeated=len(sequences) - len(measurements),
            joined=joined,
            status_report=reply.status_report,
            rejected_beacons=self._update_status(reply.status_report),
            link_delay_anomaly=not self.timing.update_link_delay(reply.turnaround_us, at),
            lateness_ns=at.lateness_ns,
            command=command,
            response=response,
            single_measurement=single_measurement,
        )

    def _join(self, reply: Reply, counter: int) -> bool:
        """Take a join request; return whether the station joins the session with it."""
        request = reply.join_request
        self.join_pending = request is not None
        if request is None:
            return False
        joined = request.nonce != self.nonce
        if joined:
            self.reset_session()
        self.nonce = self._confirmation_nonce = request.nonce
        self._join_counter = counter
        # The station does not know what it had delivered before its restart, and sends its backlog again.
        self.demand.join(repeats_backlog=request.oldest < request.first_sequence)
        self.window.join(request)
        return joined

    def _tracked_prism(self, reply: Reply) -> int:
        """Return the prism of blocks that name none: of the last status report, or of the first one in this reply."""
        status = self._status or reply.status_report
        return self._default_prism if status is None else status.prism

    def _update_status(self, status: StatusReport | None) -> int:
        """Take a status report; return how many more beacons the station has rejected."""
        rejected = 0
        if status is not None:
            if self._status is not None:
                self.missed_slots += (status.missed_slots - self._status.missed_slots) % 256
                rejected = (status.rejected_beacons - self._status.rejected_beacons) % 16
                self.rejected_beacons += rejected
            self._status = status
            self._condition = updated_condition(self._condition, status.condition)
        return rejected

    def _complete(
        self, reply: Reply
    ) -> tuple[Command | None, CommandResponse | None, SingleMeasurement | None]:
        """Return the pending command if this reply completes it, with its response or measurement."""
        pending = self._pending
        if pending is None:
            return None, None, None
        response, single = reply.response, reply.single_measurement
        response = response if response is not None and response.command_id == pending.command_id else None
        single = single if single is not None and single.command_id == pending.command_id else None
        if response is None and single is None:
            return None, None, None
        self._pending = None
        return pending.command, response, single
