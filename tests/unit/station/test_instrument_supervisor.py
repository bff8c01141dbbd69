"""The instrument supervisor: connections, commands, atmosphere and settings, with any instrument."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import pytest
from harness.instruments.scripted_instrument import RECORD, ScriptedInstrument
from structlog.testing import capture_logs

from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.radio import DirectCommand, Direction, MeasureCommand, SearchCommand, TrackCommand
from tsgt.simulation.kernel import VirtualClock
from tsgt.station import Atmosphere, Condition, Reading
from tsgt.station.instrument_supervisor import (
    CHECK_INTERVAL_S,
    NOT_CONNECTED,
    CommandResult,
    InstrumentSupervisor,
)
from tsgt.station.session import ClientSession

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from tsgt.recording.journal import InstrumentRecord

WARM = Atmosphere(temperature_c=25.0, pressure_hpa=1000.0)
COLD = Atmosphere(temperature_c=-5.0, pressure_hpa=1000.0)
GONE = "the instrument is gone"


@dataclass
class Bench:
    """A supervisor, its instrument, and the arguments of all callbacks, in order."""

    instrument: ScriptedInstrument
    session: ClientSession = field(default_factory=lambda: ClientSession(1, 1))
    out: list[Reading | InstrumentRecord | CommandResult] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.supervisor = InstrumentSupervisor(
            self.instrument,
            self.session,
            VirtualClock(0),
            on_reading=self.out.append,
            on_record=self.out.append,
            on_result=self.record_result,
        )

    def record_result(self, result: CommandResult) -> None:
        """Apply a result as the client does."""
        self.out.append(result)
        if result.ok and not isinstance(result.command, MeasureCommand):
            self.session.apply(result.command)

    async def execute(
        self, command: TrackCommand | SearchCommand | DirectCommand | MeasureCommand
    ) -> CommandResult:
        """Submit a command and wait for its result."""
        self.supervisor.submit(command)
        while not (self.out and isinstance(self.out[-1], CommandResult)):  # noqa: ASYNC110 (virtual time)
            await asyncio.sleep(0.01)
        result = self.out.pop()
        assert isinstance(result, CommandResult)
        return result


@asynccontextmanager
async def bench(
    instrument: ScriptedInstrument | None = None, *, connected: bool = True
) -> AsyncGenerator[Bench]:
    """Run a supervisor; its instrument connects and tracks within 1.5 s."""
    made = Bench(instrument or ScriptedInstrument(VirtualClock(0)))
    running = asyncio.create_task(made.supervisor.run())
    try:
        await asyncio.sleep(1.5)
        if connected:
            assert made.supervisor.description == "scripted"
            assert made.out.pop(0) == RECORD
        yield made
    finally:
        running.cancel()
        await asyncio.wait([running])
    assert running.cancelled()


async def test_refused_command_keeps_connection() -> None:
    """The result is negative, and the next reading follows."""
    async with bench() as day:
        day.instrument.mode_error = InstrumentRefusedError("there is no prism 9")
        with capture_logs() as logs:
            assert await day.execute(TrackCommand(9)) == CommandResult(TrackCommand(9), ok=False)
            day.instrument.mode_error = None
            reading = day.instrument.give()
            await asyncio.sleep(0.1)
        assert day.out == [reading]
    assert [entry["event"] for entry in logs] == ["command_refused"]


async def test_refused_single_measurement_gets_a_result() -> None:
    """The instrument stays ready for the next one."""
    async with bench() as day:
        assert (await day.execute(DirectCommand())).ok
        day.instrument.target = InstrumentRefusedError("no target there")
        assert await day.execute(MeasureCommand()) == CommandResult(MeasureCommand(), ok=False)
        assert day.supervisor.description == "scripted"


async def test_search_command_passes_direction() -> None:
    """Without one the instrument searches at the prism's last direction."""
    towards = Direction(1.0, 1.5, 0.05)
    async with bench() as day:
        assert (await day.execute(SearchCommand(towards))).ok
        assert (await day.execute(SearchCommand())).ok
    assert day.instrument.prisms == [1, 1, 1]
    assert day.instrument.towards == [None, towards, None]


async def test_recovered_instrument_is_connected_within_a_second() -> None:
    """The retry delay does not grow beyond that, however long the outage."""
    async with bench() as day:
        day.instrument.plugged = False
        day.instrument.fail()
        await asyncio.sleep(600.0)
        assert day.supervisor.description is None
        day.instrument.plugged = True
        await asyncio.sleep(1.0 + 1.0 + 0.01)  # the longest pause, and what tracking takes
        assert day.supervisor.description == "scripted"


async def test_condition_has_connection_error_while_disconnected() -> None:
    """While connected, the instrument's own condition counts."""
    instrument = ScriptedInstrument(VirtualClock(0))
    instrument.plugged = False
    async with bench(instrument, connected=False) as day:
        assert day.supervisor.condition.problem == "nobody answers; is the cable in?"
        instrument.plugged = True
        instrument.condition = Condition(problem="battery low", battery_percent=9)
        await asyncio.sleep(3.0)
        assert day.supervisor.condition == instrument.condition


async def test_settings_precede_the_readings_they_apply_to() -> None:
    """Once after each connection and after each change."""
    async with bench() as day:
        first = day.instrument.give()
        await asyncio.sleep(0.1)
        changed = day.instrument.record = replace(RECORD, distance_mode="fast")
        second = day.instrument.give()
        third = day.instrument.give()
        await asyncio.sleep(0.1)
        assert day.out == [first, changed, second, third]
        day.out.clear()
        day.instrument.fail()
        await asyncio.sleep(3.0)
        assert day.out == [RECORD]


async def test_atmosphere_is_set_between_two_readings() -> None:
    """No reading is lost, the settings are published, and the request gets its response."""
    async with bench() as day:
        assert await day.supervisor.set_atmosphere(WARM) == ""
        day.instrument.give()
        await asyncio.sleep(0.1)
        settings, reading = day.out
    assert settings == replace(RECORD, atmospheric_ppm=10.0, temperature_c=25.0, pressure_hpa=1000.0)
    assert isinstance(reading, Reading)


async def test_atmosphere_is_set_in_direct_mode() -> None:
    """No reading is in progress there."""
    async with bench() as day:
        assert (await day.execute(DirectCommand())).ok
        assert await day.supervisor.set_atmosphere(WARM) == ""
        assert (await day.execute(MeasureCommand())).ok


async def test_lost_instrument_is_detected_in_direct_mode() -> None:
    """It is checked periodically, and reconnected when it is back."""
    async with bench() as day:
        assert (await day.execute(DirectCommand())).ok
        day.instrument.plugged = False
        await asyncio.sleep(CHECK_INTERVAL_S + 0.1)
        assert "is the cable in?" in day.supervisor.condition.problem
        day.instrument.plugged = True
        await asyncio.sleep(3.0)
        assert not day.supervisor.condition.problem
        assert day.instrument.prisms[-1] is None
        assert (await day.execute(MeasureCommand())).ok


async def test_atmosphere_is_set_after_each_connection() -> None:
    """Also when it was requested without an instrument."""
    instrument = ScriptedInstrument(VirtualClock(0))
    instrument.plugged = False
    async with bench(instrument, connected=False) as day:
        assert await day.supervisor.set_atmosphere(COLD) == NOT_CONNECTED
        instrument.plugged = True
        for _ in range(2):
            await asyncio.sleep(3.0)
            assert instrument.record is not None
            assert instrument.record.temperature_c == -5.0
            instrument.fail()


async def test_atmosphere_refused_after_a_connection_is_a_problem() -> None:
    """Nobody waits for the response then: it is set at the next connection, and shown until then."""
    async with bench() as day:
        assert await day.supervisor.set_atmosphere(WARM) == ""
        day.instrument.atmosphere_error = InstrumentRefusedError("it is busy")
        for _ in range(2):
            day.instrument.fail()
            await asyncio.sleep(3.0)
            assert day.instrument.record == RECORD
            assert day.supervisor.condition.problem == "the atmosphere is not as required: it is busy"
        day.instrument.atmosphere_error = None
        day.instrument.fail()
        await asyncio.sleep(3.0)
        assert day.instrument.record is not None
        assert day.instrument.record.temperature_c == 25.0
        assert day.supervisor.condition == day.instrument.condition


async def test_refused_atmosphere_keeps_the_last_one() -> None:
    """That one is set at the next connection."""
    async with bench() as day:
        assert await day.supervisor.set_atmosphere(WARM) == ""
        day.instrument.atmosphere_error = InstrumentRefusedError("too cold")
        assert await day.supervisor.set_atmosphere(COLD) == "too cold"
        assert not day.supervisor.condition.problem
        day.instrument.atmosphere_error = None
        day.instrument.fail()
        await asyncio.sleep(3.0)
        assert day.instrument.record is not None
        assert day.instrument.record.temperature_c == 25.0


async def test_refused_atmosphere_is_not_retried() -> None:
    """The request gets the reason."""
    async with bench() as day:
        day.instrument.atmosphere_error = InstrumentRefusedError("it has no such setting")
        assert await day.supervisor.set_atmosphere(WARM) == "it has no such setting"
        day.instrument.atmosphere_error = None
        day.instrument.fail()
        await asyncio.sleep(3.0)
        assert day.instrument.record == RECORD


async def test_atmosphere_is_set_after_reconnection() -> None:
    """A request interrupted by a lost instrument gets a response."""
    async with bench() as day:
        day.instrument.atmosphere_error = InstrumentError(GONE)
        assert await day.supervisor.set_atmosphere(WARM) == NOT_CONNECTED
        day.instrument.atmosphere_error = None
        await asyncio.sleep(3.0)
        assert day.instrument.record is not None
        assert day.instrument.record.temperature_c == 25.0


@pytest.mark.parametrize("after_s", [0.0, 0.05])
async def test_later_atmosphere_request_supersedes_earlier(after_s: float) -> None:
    """Before or during its execution; both get a response."""
    async with bench() as day, asyncio.TaskGroup() as group:
        first = group.create_task(day.supervisor.set_atmosphere(WARM))
        await asyncio.sleep(after_s)
        second = group.create_task(day.supervisor.set_atmosphere(COLD))
        await asyncio.sleep(1.0)
        assert first.done()
        assert second.result() == ""
        assert day.instrument.record is not None
        assert day.instrument.record.temperature_c == -5.0


async def test_simultaneous_command_and_atmosphere_are_executed() -> None:
    """Neither is lost."""
    async with bench() as day, asyncio.TaskGroup() as group:
        setting = group.create_task(day.supervisor.set_atmosphere(WARM))
        assert (await day.execute(TrackCommand(2))).ok
        assert await setting == ""
    assert day.instrument.prisms == [1, 2]


class FailsWhenStopped(ScriptedInstrument):
    """An instrument that fails when a read is cancelled."""

    async def read(self) -> Reading:
        """Fail on cancellation."""
        try:
            return await super().read()
        except asyncio.CancelledError:
            raise InstrumentError(GONE) from None


async def test_cancellation_during_failure_is_not_lost() -> None:
    """The error does not replace the cancellation."""
    async with bench(FailsWhenStopped(VirtualClock(0))):
        pass
