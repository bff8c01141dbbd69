"""The supervisor of a total station: connects and reconnects it, reads it, and executes commands between two readings."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.radio import Command, DirectCommand, MeasureCommand, SearchCommand, TrackCommand

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.recording.journal import InstrumentRecord
    from tsgt.station.instrument import Atmosphere, Condition, Instrument, Reading
    from tsgt.station.session import ClientSession

INITIAL_RETRY_DELAY_NS = 100_000_000

MAX_RETRY_DELAY_NS = 1_000_000_000
"""An instrument that was unplugged must measure again within three seconds of its return."""

STABLE_CONNECTION_NS = 5_000_000_000
"""A connection that lasted longer resets the retry delay, and its error is logged again."""

CHECK_INTERVAL_S = 2.0
"""Interval of the checks in direct mode, where no reading would reveal that the instrument is lost."""

CLOSE_TIMEOUT_S = 0.5  # the client must end within a second

NOT_CONNECTED = "no instrument is connected; the setting is applied after the next connection"

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class CommandResult:
    """The result of a command; with a reading after a successful :class:`~tsgt.radio.commands.MeasureCommand`."""

    command: Command
    ok: bool
    reading: Reading | None = None


@dataclass(slots=True)
class RequestedAtmosphere:
    """The atmosphere last requested and the last that was set, or None.

    The requested one is applied after each connection, also by the next supervisor.
    """

    atmosphere: Atmosphere | None = None
    accepted: Atmosphere | None = None


class InstrumentSupervisor:
    """The only owner of an instrument.

    ``description``: name and serial number of the instrument; None while disconnected.

    Parameters
    ----------
    session
        Supplies mode and prism after each connection.
    on_reading
        Called with each reading of the tracked prism, in the same step of the event loop.
    on_record
        Called with identity and settings after each connection and change, before the first reading they apply to.
    on_result
        Called exactly once for each command.
    requested
        Request of an earlier supervisor; None: there was none.
    """

    def __init__(
        self,
        instrument: Instrument,
        session: ClientSession,
        clock: Clock,
        *,
        on_reading: Callable[[Reading], None],
        on_record: Callable[[InstrumentRecord], None],
        on_result: Callable[[CommandResult], None],
        requested: RequestedAtmosphere | None = None,
    ) -> None:
        self._instrument = instrument
        self._session = session
        self._clock = clock
        self._on_reading = on_reading
        self._on_record = on_record
        self._on_result = on_result
        self._command: Command | None = None
        self._requested = requested or RequestedAtmosphere()
        self._atmosphere_pending = False
        self._atmosphere_problem = ""  # of a refusal that nobody was waiting for
        self._atmosphere_response: asyncio.Future[str] | None = None
        self._work_pending = asyncio.Event()
        self._reading: asyncio.Timeout | None = None
        self._record: InstrumentRecord | None = None
        self._connected_ns = 0
        self._error = ""
        self.description: str | None = None

    @property
    def condition(self) -> Condition:
        """The instrument's condition; while disconnected, the problem is the connection error."""
        condition = self._instrument.condition
        if self.description is None:
            return replace(condition, problem=self._error)
        return replace(
            condition, problem="; ".join(filter(None, (condition.problem, self._atmosphere_problem)))
        )

    def submit(self, command: Command) -> None:
        """Execute a command when the instrument is free; fails without one, and for a measurement while tracking."""
        tracking = self._session.mode == "tracking"
        if self.description is None or (tracking and isinstance(command, MeasureCommand)):
            self._on_result(CommandResult(command, ok=False))
            return
        self._command = command
        self._interrupt()

    async def set_atmosphere(self, atmosphere: Atmosphere) -> str:
        """Set it now and after each connection; return why it is not set, or not yet, empty when it is."""
        _respond(self._atmosphere_response, "superseded by a later request")
        self._requested.atmosphere = atmosphere
        if self.description is None:
            return NOT_CONNECTED
        self._atmosphere_pending = True
        response: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._atmosphere_response = response
        self._interrupt()
        return await response

    async def run(self) -> NoReturn:
        """Connect and read; after an error reconnect, for ever, with a delay that grows from 0.1 s to 1 s."""
        delay_ns, logged = INITIAL_RETRY_DELAY_NS, ""
        try:
            while True:
                try:
                    await self._operate()
                except InstrumentError as error:
                    if (task := asyncio.current_task()) is not None and task.cancelling():
                        # The instrument failed while this task was being cancelled; the error replaced the cancellation.
                        raise asyncio.CancelledError from None
                    if (
                        self.description
                        and self._clock.monotonic_ns() - self._connected_ns > STABLE_CONNECTION_NS
                    ):
                        delay_ns, logged = INITIAL_RETRY_DELAY_NS, ""
                    self._error = str(error)
                    if self._error != logged:
                        logged = self._error
                        log.error("instrument_lost", error=logged)  # noqa: TRY400 (the message says it all)
                self.description = None
                self._fail_pending()
                await self._close()
                await self._clock.sleep_until(self._clock.monotonic_ns() + delay_ns)
                delay_ns = min(2 * delay_ns, MAX_RETRY_DELAY_NS)
        finally:
            await self._close()

    async def _operate(self) -> NoReturn:
        self._record, self._atmosphere_pending, self._atmosphere_problem = None, False, ""
        description = await self._instrument.connect()
        if self._session.mode == "tracking":
            await self._instrument.track(self._session.prism)
        else:
            await self._instrument.direct()
        self.description = description
        self._connected_ns = self._clock.monotonic_ns()
        log.info("instrument_connected", instrument=description)
        self._atmosphere_pending = self._requested.atmosphere is not None
        while True:
            self._publish_record()
            if self._atmosphere_pending and self._requested.atmosphere is not None:
                await self._set_atmosphere(self._requested.atmosphere)
            elif self._command is not None:
                await self._execute(self._command)
            elif self._session.mode == "direct":
                await self._idle()
            elif (reading := await self._read()) is not None:
                self._publish_record()
                self._on_reading(reading)

    async def _idle(self) -> None:
        """Wait for work in direct mode; check the instrument now and then."""
        try:
            async with asyncio.timeout(CHECK_INTERVAL_S):
                await self._work_pending.wait()
        except TimeoutError:
            await self._instrument.check()
        else:
            self._work_pending.clear()

    def _publish_record(self) -> None:
        record = self._instrument.record
        if record is not None and record != self._record:
            self._record = record
            self._on_record(record)

    def _interrupt(self) -> None:
        """Interrupt the reading or the wait in progress."""
        self._work_pending.set()
        if self._reading is not None and not self._reading.expired():
            self._reading.reschedule(0)  # cancels the reading

    async def _read(self) -> Reading | None:
        """Return the next reading; None when interrupted."""
        try:
            async with asyncio.timeout(None) as self._reading:
                return await self._instrument.read()
        except TimeoutError:
            if self._command is None and not self._atmosphere_pending:
                raise
            return None
        finally:
            self._reading = None

    async def _execute(self, command: Command) -> None:
        reading, ok = None, True
        try:
            if not self._session.is_satisfied(command):
                reading = await self._dispatch(command)
        except InstrumentRefusedError as error:
            log.warning("command_refused", command=type(command).__name__, error=str(error))
            ok = False
        self._command = None
        self._publish_record()
        self._on_result(CommandResult(command, ok=ok, reading=reading))

    async def _dispatch(self, command: Command) -> Reading | None:
        match command:
            case TrackCommand(prism):
                await self._instrument.track(prism or self._session.prism)
            case SearchCommand(towards):
                await self._instrument.track(self._session.prism, towards)
            case DirectCommand():
                await self._instrument.direct()
            case MeasureCommand():
                return await self._instrument.measure()
        return None

    async def _set_atmosphere(self, atmosphere: Atmosphere) -> None:
        response, self._atmosphere_response = self._atmosphere_response, None
        self._atmosphere_pending = False
        values = {"temperature_c": atmosphere.temperature_c, "pressure_hpa": atmosphere.pressure_hpa}
        problem = NOT_CONNECTED
        try:
            await self._instrument.set_atmosphere(atmosphere)
        except InstrumentRefusedError as error:
            problem = str(error)
            log.warning("atmosphere_refused", **values, error=problem)
            if response is None:
                self._atmosphere_problem = f"the atmosphere is not as required: {problem}"
            elif self._requested.atmosphere is atmosphere:
                self._requested.atmosphere = self._requested.accepted
        else:
            problem = self._atmosphere_problem = ""
            self._requested.accepted = atmosphere
            log.info("atmosphere_set", **values)
            self._publish_record()
        finally:
            _respond(response, problem)

    def _fail_pending(self) -> None:
        """Respond to the request and the command that the lost instrument did not carry out."""
        _respond(self._atmosphere_response, NOT_CONNECTED)
        self._atmosphere_response = None
        if (command := self._command) is not None:
            self._command = None
            self._on_result(CommandResult(command, ok=False))

    async def _close(self) -> None:
        with suppress(InstrumentError, TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await self._instrument.close()


def _respond(response: asyncio.Future[str] | None, problem: str) -> None:
    if response is not None and not response.done():  # done: the requester was cancelled
        response.set_result(problem)
