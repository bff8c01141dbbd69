"""A station and a master built from descriptions of the authors' nodes, each against ours and against the other."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.hardware.radios import MS, running_timeline
from harness.instruments.scripted_instrument import READING, ScriptedInstrument
from harness.radio.authors_master import AuthorsMaster

from tsgt.clock import UnixTimeline
from tsgt.errors import InstrumentError
from tsgt.master.classic import Transport
from tsgt.model import Status
from tsgt.radio import LoRaSettings, MeasureCommand
from tsgt.radio.classic import (
    ClassicStation,
    CommandMessage,
    CommandTransaction,
    LinkTiming,
    MeasurementMessage,
    Poll,
    SingleMeasurementPoll,
    Synchronisation,
    raw_status,
    status_of,
)
from tsgt.simulation.kernel import DriftingClock, VirtualClock
from tsgt.simulation.lora import Air, LinkModel, radio_opener
from tsgt.simulation.mission.authors_node import AUTHORS_TIMESTAMP_DELAY_MS, AuthorsNode

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Coroutine

    from tsgt.radio import Radio
    from tsgt.radio.classic import ClassicCommand
    from tsgt.station import Reading

SECOND = 1000 * MS
START_NS = 1_790_000_000 * SECOND
AHEAD_NS = -500_000_000 * SECOND
"""Unix time of a Pi without battery clock: years behind."""
spreading_factors = pytest.mark.parametrize("spreading_factor", [8, 9])


def _settings(spreading_factor: int) -> LoRaSettings:
    return LoRaSettings(
        frequency_hz=905_000_000, spreading_factor=spreading_factor, bandwidth_hz=250_000, coding_rate=6
    )


@dataclass
class Field:
    """A channel with a master's radio and the stations added to it."""

    radio: Radio
    clock: VirtualClock
    settings: LoRaSettings
    air: Air
    stack: AsyncExitStack
    tasks: list[asyncio.Task[None]] = field(default_factory=list)
    clocks: dict[int, DriftingClock] = field(default_factory=dict)
    instruments: dict[int, ScriptedInstrument] = field(default_factory=dict)

    async def add_authors_node(self, station: int) -> None:
        """Start a node of the authors'."""
        radio, clock, instrument = await self._host(station)
        node = AuthorsNode(station, radio, clock, instrument, 1, np.random.default_rng(station))
        await self._start(node.run())

    async def add_our_station(self, station: int) -> None:
        """Start a station that runs our sans-I/O core."""
        radio, clock, instrument = await self._host(station)
        await self._start(_serve(station, radio, clock, instrument))

    async def _host(self, station: int) -> tuple[Radio, DriftingClock, ScriptedInstrument]:
        clock = self.clocks[station] = DriftingClock(self.clock, offset_ns=AHEAD_NS)
        instrument = self.instruments[station] = ScriptedInstrument(clock)
        rng = np.random.default_rng(10 + station)
        open_radio = radio_opener(self.air, f"station{station}", clock, rng, self.settings)
        return await self.stack.enter_async_context(open_radio()), clock, instrument

    async def _start(self, program: Coroutine[None, None, None]) -> None:
        self.tasks.append(asyncio.create_task(program))
        await asyncio.sleep(1.1)  # the instrument takes a second until it tracks

    def our_master(self) -> Transport:
        """Return the transport of our master."""
        return Transport(self.radio, self.clock, UnixTimeline.fixed_now(self.clock), self.timing)

    def their_master(self, *stations: int) -> AuthorsMaster:
        """Return a master of the authors'."""
        return AuthorsMaster(stations, self.radio, self.clock, np.random.default_rng(5))

    @property
    def timing(self) -> LinkTiming:
        """Timing of the transactions."""
        return LinkTiming(self.settings, 250 * MS)


@asynccontextmanager
async def _field(spreading_factor: int = 9) -> AsyncGenerator[Field]:
    air = Air(running_timeline(), np.random.default_rng(0), LinkModel())
    clock, settings = VirtualClock(START_NS), _settings(spreading_factor)
    async with AsyncExitStack() as stack:
        open_radio = radio_opener(air, "master", clock, np.random.default_rng(1), settings)
        site = Field(await stack.enter_async_context(open_radio()), clock, settings, air, stack)
        try:
            yield site
        finally:
            for task in site.tasks:
                task.cancel()
            results = await asyncio.gather(*site.tasks, return_exceptions=True)
            assert all(isinstance(result, asyncio.CancelledError) for result in results), results


async def _serve(station: int, radio: Radio, clock: DriftingClock, instrument: ScriptedInstrument) -> None:
    """Respond as our client does, with one task less."""
    timeline = UnixTimeline.fixed_now(clock)
    core = ClassicStation(station)

    def message(reading: Reading) -> MeasurementMessage:
        return MeasurementMessage(
            station=station,
            status=raw_status(reading.status),
            zenith_angle_rad=reading.zenith_angle_rad,
            horizontal_angle_rad=reading.horizontal_angle_rad,
            slope_distance_m=reading.slope_distance_m or 0.0,
            time_ns=timeline.unix_ns(reading.at_ns),
        )

    async def execute(command: ClassicCommand) -> bytes:
        if isinstance(command, MeasureCommand):
            return core.single_measured(message(await instrument.measure()))
        await instrument.direct()
        return core.executed(command, ok=True)

    async def read() -> None:
        while True:
            core.measured(message(await instrument.read()))

    reading = asyncio.create_task(read())
    try:
        while True:
            packet = await radio.receive()
            answer = core.received(packet.payload, timeline.unix_ns(packet.received_at_ns))
            if answer is not None:
                await radio.transmit(answer if isinstance(answer, bytes) else await execute(answer))
    finally:
        reading.cancel()
        await asyncio.wait([reading])


# --- Our master, their node -----------------------------------------------------------------------------------


async def _polled(site: Field, station: int = 1) -> MeasurementMessage | None:
    poll = Poll(station, site.timing)
    await site.our_master().run(poll)
    return poll.message


@spreading_factors
async def test_our_master_receives_their_measurement(spreading_factor: int) -> None:
    """Raw polar values, and their time of arrival on the node's Unix clock."""
    async with _field(spreading_factor) as site:
        await site.add_authors_node(1)
        site.instruments[1].give()
        given_ns = site.clocks[1].realtime_ns()
        await asyncio.sleep(0.3)
        message = await _polled(site)
    assert message == MeasurementMessage(
        station=1,
        status=0,
        zenith_angle_rad=READING.zenith_angle_rad,
        horizontal_angle_rad=READING.horizontal_angle_rad,
        slope_distance_m=99.5,
        time_ns=given_ns,
    )


async def test_their_node_repeats_the_last_measurement() -> None:
    """Without a new measurement the last one is sent again bit for bit; its timestamp identifies it."""
    async with _field() as site:
        await site.add_authors_node(1)
        site.instruments[1].give()
        one, two = await _polled(site), await _polled(site)
        site.instruments[1].give()
        three = await _polled(site)
    assert one == two
    assert three is not None
    assert one is not None
    assert three.time_ns > one.time_ns


async def test_their_zeros_are_no_measurement() -> None:
    """Before its first measurement their node sends zeros with a good status."""
    async with _field() as site:
        await site.add_authors_node(1)
        message = await _polled(site)
    assert message is not None
    assert (message.status, message.time_ns) == (0, 0)
    assert not status_of(message).usable


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (Status.TILT, Status.TILT),
        (Status.WRONG_DISTANCE, Status.WRONG_DISTANCE),
        (Status.NO_TARGET, Status.NO_TARGET),
        (Status.ERROR, Status.NO_TARGET),
    ],
)
@pytest.mark.parametrize("station", [1, 2, 3])
async def test_their_errors_have_no_time(given: Status, expected: Status, station: int) -> None:
    """Errors carry zeros or ones instead of a time: they are decoded without time and are unusable."""
    async with _field() as site:
        await site.add_authors_node(station)
        site.instruments[station].give()
        site.instruments[station].give(given)
        message = await _polled(site, station)
    assert message is not None
    assert (message.time_ns, message.slope_distance_m) == (0, -1.0)
    assert status_of(message) is expected


async def test_their_measurement_without_distance_has_angles() -> None:
    """Below a metre angles and time are valid and the distance is 0."""
    async with _field() as site:
        await site.add_authors_node(1)
        site.instruments[1].give(Status.ANGLE_ONLY)
        message = await _polled(site)
    assert message is not None
    assert status_of(message) is Status.ANGLE_ONLY
    assert (message.zenith_angle_rad, message.slope_distance_m) == (READING.zenith_angle_rad, 0.0)
    assert message.time_ns > 0


async def test_their_node_without_instrument_keeps_responding() -> None:
    """An unplugged instrument gives an error status and no timeout."""
    async with _field() as site:
        await site.add_authors_node(1)
        site.instruments[1].fail()
        message = await _polled(site)
    assert message is not None
    assert status_of(message) is Status.NO_TARGET


@spreading_factors
async def test_our_master_synchronises_their_node(spreading_factor: int) -> None:
    """Each cycle gives a clock sample; corrected for the polling delay, the mean offset is within 0.1 ms."""
    async with _field(spreading_factor) as site:
        await site.add_authors_node(1)
        turn = Synchronisation(1, 50, site.timing, timestamp_delay_ns=round(AUTHORS_TIMESTAMP_DELAY_MS * MS))
        await site.our_master().run(turn)
        message = await _polled(site)
    offsets_ns = [sample.station_ns - sample.sent_ns - sample.forward_ns for sample in turn.samples]
    assert len(offsets_ns) == 50
    assert fmean(offset - AHEAD_NS for offset in offsets_ns) == pytest.approx(0, abs=0.1 * MS)
    assert max(abs(offset - AHEAD_NS) for offset in offsets_ns) < 0.7 * MS
    assert all(-0.5 * MS < sample.excess_ns < 3 * MS for sample in turn.samples)
    assert message is not None


async def test_clock_step_of_their_node_appears_in_the_next_samples() -> None:
    """Their timestamps follow steps of the Unix clock."""
    async with _field() as site:
        await site.add_authors_node(1)
        site.clocks[1].step(7 * SECOND)
        turn = Synchronisation(1, 5, site.timing)
        await site.our_master().run(turn)
    for sample in turn.samples:
        offset_ns = sample.station_ns - sample.sent_ns - sample.forward_ns
        assert offset_ns - AHEAD_NS == pytest.approx(7 * SECOND, abs=2 * MS)


async def test_our_master_switches_their_node_to_targets_and_back() -> None:
    """Direct mode, a single measurement with instrument time in whole seconds, then tracking of another prism."""
    async with _field() as site:
        await site.add_authors_node(1)
        instrument, master = site.instruments[1], site.our_master()
        instrument.target = replace(READING, instrument_time_ns=123_456_789_012)
        to_targets = CommandTransaction(1, CommandMessage("d", 1), 3 * SECOND)
        await master.run(to_targets)
        shot = SingleMeasurementPoll(1, site.timing)
        await master.run(shot)
        back = CommandTransaction(1, CommandMessage("n", 1, 4), 3 * SECOND)
        await master.run(back)
        again = CommandTransaction(1, CommandMessage("n", 1, 5), 3 * SECOND)
        await master.run(again)
    assert (to_targets.ok, back.ok, again.ok) == (True, True, True)
    assert shot.message is not None
    assert (status_of(shot.message), shot.message.time_ns) == (Status.OK, 123 * SECOND)
    assert instrument.prisms == [1, None, 4]  # the prism does not change while it tracks


async def test_failed_target_of_their_node_is_an_error() -> None:
    """A rejected change of mode is answered by No; a failed single measurement has its error status."""
    async with _field() as site:
        await site.add_authors_node(1)
        instrument, master = site.instruments[1], site.our_master()
        instrument.mode_error = InstrumentError("busy")
        refused = CommandTransaction(1, CommandMessage("d", 1), 3 * SECOND)
        await master.run(refused)
        instrument.mode_error = None
        await master.run(CommandTransaction(1, CommandMessage("d", 1), 3 * SECOND))
        instrument.target = InstrumentError("nothing there")
        shot = SingleMeasurementPoll(1, site.timing)
        await master.run(shot)
    assert refused.ok is False
    assert shot.message is not None
    assert not status_of(shot.message).usable


async def test_node_left_in_synchronisation_recovers() -> None:
    """A killed master leaves a node that responds to no poll; a command of the next master releases it."""
    async with _field() as site:
        await site.add_authors_node(1)
        await site.radio.transmit(b"p1")
        assert await _polled(site) is None
        transaction = CommandTransaction(1, CommandMessage("n", 1, 1), 3 * SECOND)
        await site.our_master().run(transaction)
        assert transaction.ok
        assert await _polled(site) is not None


@pytest.mark.parametrize(("spreading_factor", "rate_hz"), [(9, 1.62), (8, 2.88)])
async def test_three_of_their_nodes_reach_the_papers_rate(spreading_factor: int, rate_hz: float) -> None:
    """Continuous polling with their turnaround and no pause of ours."""
    rounds = 20
    async with _field(spreading_factor) as site:
        for station in (1, 2, 3):
            await site.add_authors_node(station)
        start_ns = site.clock.monotonic_ns()
        answers = [await _polled(site, station) for _ in range(rounds) for station in (1, 2, 3)]
        duration_s = (site.clock.monotonic_ns() - start_ns) / 1e9
    assert None not in answers
    assert rounds / duration_s == pytest.approx(rate_hz, abs=0.02)


# --- Their master, our station --------------------------------------------------------------------------------


@spreading_factors
async def test_their_master_receives_our_measurement(spreading_factor: int) -> None:
    """The bytes decode correctly, and each request gets a response, also without a new measurement."""
    async with _field(spreading_factor) as site:
        await site.add_our_station(1)
        given_ns = site.clocks[1].realtime_ns()
        site.instruments[1].give()
        master = site.their_master(1)
        await master.synchronise(1)
        answers = [await master.poll(1) for _ in range(2)]
    assert answers[0] == answers[1] == (1, 0, 1.25, 2.5, 99.5, given_ns // SECOND, given_ns % SECOND)


async def test_their_master_receives_an_error_before_our_first_measurement() -> None:
    """It ignores measurements with status 3."""
    async with _field() as site:
        await site.add_our_station(1)
        answer = await site.their_master(1).poll(1)
    assert answer == (1, 3, 0.0, 0.0, 0.0, 0, 0)


@spreading_factors
async def test_their_master_synchronises_our_station(spreading_factor: int) -> None:
    """Its midpoint is right within half of its polling interval."""
    async with _field(spreading_factor) as site:
        await site.add_our_station(1)
        master = site.their_master(1)
        await master.synchronise(1)
        await master.synchronise(1)
    assert master.offset_ns[1] == pytest.approx(AHEAD_NS, abs=0.5 * MS)


async def test_their_master_switches_our_station_to_targets_and_back() -> None:
    """``d`` is answered when the instrument is ready, a target when measured, ``n`` at once while tracking."""
    async with _field() as site:
        await site.add_our_station(1)
        master = site.their_master(1)
        assert await master.request(b"n1") == b"nOk"
        assert await master.request(b"d1", 2 * SECOND) == b"dOk"
        assert await master.request(b"d1") == b"dOk"
        shot = await master.poll(1, 10 * SECOND)
        assert shot is not None
        assert shot.slope_distance_m == 99.5
        assert await master.request(b"n1", 2 * SECOND) == b"nOk"
        assert await master.poll(1) == (1, 3, 0.0, 0.0, 0.0, 0, 0)


async def test_their_master_runs_a_mission_with_both_kinds_of_stations() -> None:
    """Their master with one node of theirs and two stations of ours: synchronised, polled, resynchronised."""
    async with _field() as site:
        await site.add_authors_node(1)
        await site.add_our_station(2)
        await site.add_our_station(3)
        for instrument in site.instruments.values():
            instrument.give()
        master = site.their_master(1, 2, 3)
        running = asyncio.create_task(master.run())
        await asyncio.sleep(340)
        running.cancel()
        await asyncio.wait([running])
    counts = [sum(m.station == station for m in master.measurements) for station in (1, 2, 3)]
    assert min(counts) > 400
    assert max(counts) - min(counts) <= 1
    for station in (1, 2, 3):
        assert master.offset_ns[station] == pytest.approx(AHEAD_NS, abs=1 * MS)
