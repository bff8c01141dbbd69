"""A whole mission on virtual time: the real daemons, with simulated radios, instruments, clocks and robot.

Each daemon runs as a task, with radio and instrument handed to it as on a real computer. It can be killed and
started again at any instant; what it then finds (its journal's folder, the air, the instrument) is as it left it.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import scenario_parameters
from tsgt.config.radio import SuperframeMasterConfig
from tsgt.master.daemon import run_master
from tsgt.radio.from_config import lora_settings
from tsgt.recording import decode
from tsgt.simulation.air import Air
from tsgt.simulation.authors_node import AuthorsNode
from tsgt.simulation.clocks import DriftingClock, VirtualClock, ramped
from tsgt.simulation.foreign import ForeignRadio
from tsgt.simulation.link import LinkModel, LogDistanceLoss
from tsgt.simulation.mission_configs import (
    STATUS_SOCKET,
    client_config,
    instrument_config,
    master_config,
    radio_config,
    station_name,
)
from tsgt.simulation.options import MASTER
from tsgt.simulation.radios import HostDelay, StampJitter, opener
from tsgt.simulation.serial_line import SimulatedLine
from tsgt.simulation.total_station import SimulatedTotalStation
from tsgt.simulation.witness import Session, StationWitness, WatchedInstrument
from tsgt.simulation.world import scenario_world
from tsgt.station.daemon import run_client
from tsgt.station.leica import LeicaInstrument
from tsgt.station.status import ClientStatus

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from tsgt.config import ScenarioConfig
    from tsgt.config.scenario import ScenarioRadioConfig, SimulatedStation
    from tsgt.radio.base import OpenRadio
    from tsgt.simulation.clocks import SimulatedClock
    from tsgt.simulation.options import Options, Outage
    from tsgt.simulation.timeline import Timeline
    from tsgt.simulation.world import World
    from tsgt.station.instrument import Reading

START_UNIX_NS = 1_800_000_000_000_000_000
"""Unix time at which every simulated run starts, on the master's clock: 15 January 2027."""

DRAIN_S = 5.0
"""How long a run goes on after its end, so that what is under way can arrive."""

RESTART_S = 2.0
"""How long a daemon is away that is started again, as systemd does it."""

FOREIGN = "foreign"
"""Name of the radio that does not belong to the mission."""

_OUT_OF_REACH_DB = 300.0
_FOREIGN_PLACE_M = (30.0, -20.0, 1.5)
_KEY_BYTES = 32
_YEAR_NS = 365 * 86_400 * 10**9


class Mission:
    """The parts of a mission; has to be made and used in a running event loop on virtual time.

    Parameters
    ----------
    scenario
        World, stations, radio conditions.
    options
        What else may be set.
    folder
        For recordings, journals and sockets.
    timeline
        That of the running loop.

    Attributes
    ----------
    world
        The truth; its time is the true time.
    clocks, instruments, lines
        The stations' clocks, total stations, and the cables between, by station number; they outlive the clients.
    sessions
        What the master sent out, one entry for each time that it was started.
    witnesses
        What was read from the instruments, by station number.
    air
        The channel.
    """

    def __init__(
        self, scenario: ScenarioConfig, options: Options, *, folder: Path, timeline: Timeline
    ) -> None:
        rng = np.random.default_rng(options.seed)
        world_rng, air_rng, master_rng, clock_rng, *station_rngs = rng.spawn(4 + len(scenario.stations))
        # Spawned after the others, so that an option that draws nothing changes nothing for the rest.
        self._foreign_rng, key_rng, self._bits_rng, *jitter_rngs = rng.spawn(4 + len(scenario.stations))
        self._scenario = scenario
        self._options = options
        self._folder = folder
        self._clock = VirtualClock(START_UNIX_NS)
        self._settings = lora_settings(
            radio_config(scenario, MASTER, folder), Path(f"scenario {scenario.name}")
        )
        numbers = [s.station for s in scenario.stations]
        names = [MASTER, *map(station_name, numbers)]
        self._rngs = dict(zip(names, [master_rng, *station_rngs], strict=True))
        self._jitter_rngs = dict(zip(names, jitter_rngs, strict=True))
        authenticated = options.authenticated and isinstance(options.protocol, SuperframeMasterConfig)
        self._key = key_rng.bytes(_KEY_BYTES) if authenticated else None
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self.parameters = scenario_parameters(scenario)
        until_s = options.duration_s + 2 * DRAIN_S
        self.world: World = scenario_world(scenario, until_s, world_rng)
        self._places = {station_name(s.station): s.position_m for s in scenario.stations}
        self._places[FOREIGN] = _FOREIGN_PLACE_M
        self.air = Air(timeline, air_rng, scenario_link(scenario.radio, self._places, air_rng))
        # A Pi has no battery clock: it wakes up in the past.
        self.clocks = {
            number: self._station_clock(number, offset_ns=-int(clock_rng.integers(3 * _YEAR_NS)))
            for number in numbers
        }
        self._timeline = timeline
        self.instruments = {s.station: self._instrument(s) for s in scenario.stations}
        self.lines = {number: self._line(number) for number in numbers}
        self._boots = dict.fromkeys(numbers, 1)
        self.sessions: list[Session] = []
        self.witnesses = {
            number: StationWitness(
                number,
                None if options.node == "authors" else folder / station_name(number),
                self.instruments[number].offered,
            )
            for number in numbers
        }

    def _station_clock(self, station: int, *, offset_ns: int, booted_ns: int = 0) -> DriftingClock:
        options = self._options
        sign = -1 if self._index(station) % 2 else 1
        drift_ppm, ramp_ppm_per_min = sign * options.drift_ppm, sign * options.drift_ramp_ppm_per_min
        steps = ramped(drift_ppm, ramp_ppm_per_min, round((options.duration_s + 2 * DRAIN_S) * 1e9))
        return DriftingClock(
            self._clock,
            offset_ns=offset_ns,
            drift_ppm=drift_ppm,
            drift_steps=steps if ramp_ppm_per_min else (),
            booted_ns=booted_ns,
        )

    def _instrument(self, entry: SimulatedStation) -> SimulatedTotalStation:
        rng = self._rngs[station_name(entry.station)].spawn(1)[0]
        return SimulatedTotalStation(
            self._entry(entry.station), self._scenario, self.world, self._timeline, rng
        )

    def _line(self, station: int) -> SimulatedLine:
        name = f"{station_name(station)}'s cable"
        return SimulatedLine(self.instruments[station], self._timeline, self.clocks[station], name=name)

    def _entry(self, station: int) -> SimulatedStation:
        """Return what the scenario says of a station; the authors' instrument calls their node at once."""
        entry = self._scenario.stations[self._index(station)]
        if self._options.node != "authors":
            return entry
        model = entry.instrument.model_copy(update={"processing_min_ms": 0.0, "processing_max_ms": 1.0})
        return entry.model_copy(update={"instrument": model})

    def _index(self, station: int) -> int:
        return [s.station for s in self._scenario.stations].index(station)

    @property
    def now_s(self) -> float:
        """The true time, from the start."""
        return self._clock.monotonic_ns() / 1e9

    async def until(self, time_s: float) -> None:
        """Let it run until then; the robot's radio moves with the robot.

        Raises
        ------
        ExceptionGroup
            A daemon has ended with an error.
        """
        while self.now_s < time_s:
            self._places[MASTER] = tuple(self.world.pose_at(np.array([self.now_s]))[0, :3, 3].tolist())
            step_s = min(1.0, time_s - self.now_s)
            ended, _ = await asyncio.wait(
                self._tasks.values(), timeout=step_s, return_when=asyncio.FIRST_EXCEPTION
            )
            errors = [
                error
                for task in ended
                if not task.cancelled() and isinstance(error := task.exception(), Exception)
            ]
            if errors:
                raise ExceptionGroup("a daemon has ended", errors)

    async def sleep_until(self, time_s: float) -> None:
        """Return at a true time, from the start; for whoever acts beside the daemons."""
        await self._clock.sleep_until(round(time_s * 1e9))

    def start_master(self) -> None:
        """Start the master, with a recording of its own."""
        folder = self._folder / f"master{len(self.sessions)}"
        session = Session(folder, self._clock.realtime_ns)
        self.sessions.append(session)
        config = master_config(self._scenario, self._options, folder)
        folder.mkdir()
        self._start(
            MASTER,
            run_master(
                config,
                self.parameters,
                self._settings,
                open_radio=self._opener(MASTER, self._clock, HostDelay()),
                clock=self._clock,
                key=self._key,
                random_bits=self._random_bits,
                observe=session.take,
            ),
        )

    def start_station(self, station: int) -> None:
        """Start a station's client, with a journal of its own beside the earlier ones, or the authors' node."""
        entry = self._entry(station)
        authors = self._options.node == "authors"
        self._start(station_name(station), self._authors_node(entry) if authors else self._client(entry))

    def start_foreign(self) -> None:
        """Let somebody else use the channel."""
        radio = ForeignRadio(self._clock, self._foreign_rng, self._options.foreign_per_s)
        self._rngs[FOREIGN] = self._foreign_rng
        self._start(FOREIGN, radio.run(self._opener(FOREIGN, self._clock)))

    def _random_bits(self, count: int) -> int:
        return int.from_bytes(self._bits_rng.bytes(-(-count // 8))) >> -count % 8

    def _opener(self, name: str, clock: SimulatedClock, delay: HostDelay | None = None) -> OpenRadio:
        jitter = None
        if self._options.stamp_jitter_us and name in self._jitter_rngs:
            jitter = StampJitter(round(self._options.stamp_jitter_us * 1e3), self._jitter_rngs[name])
        return opener(self.air, name, clock, self._rngs[name], self._settings, delay, jitter)

    def _client(self, entry: SimulatedStation) -> Coroutine[None, None, None]:
        station = entry.station
        witness, clock = self.witnesses[station], self.clocks[station]
        folder = self._folder / station_name(station)
        folder.mkdir(exist_ok=True)
        unix_at_zero_ns = clock.realtime_ns() - clock.monotonic_ns()

        def watch(reading: Reading) -> None:
            witness.stamps_ns[unix_at_zero_ns + reading.at_ns] = clock.true_ns(reading.at_ns)

        return run_client(
            client_config(self._scenario, entry, self._options, folder),
            self._settings,
            instrument=WatchedInstrument(self._driver(entry), watch),
            open_radio=self._opener(station_name(station), clock, HostDelay()),
            clock=clock,
            key=self._key,
            random_bits=self._random_bits,
            boot=f"{station_name(station)}-{self._boots[station]}",
        )

    def _driver(self, entry: SimulatedStation) -> LeicaInstrument:
        config = instrument_config(entry, self._folder / station_name(entry.station))
        return LeicaInstrument(config, self.lines[entry.station].open, self.clocks[entry.station])

    async def _authors_node(self, entry: SimulatedStation) -> None:
        station = entry.station
        witness, clock, rng = self.witnesses[station], self.clocks[station], self._rngs[station_name(station)]

        def watch(_reading: Reading) -> None:
            witness.stamps_ns[clock.realtime_ns()] = self._clock.monotonic_ns()  # stamped on arrival

        instrument = WatchedInstrument(self._driver(entry), watch)
        async with self._opener(station_name(station), clock)() as radio:
            await AuthorsNode(station, radio, clock, instrument, entry.prism, rng).run()

    def _start(self, name: str, daemon: Coroutine[None, None, None]) -> None:
        self._tasks[name] = asyncio.create_task(daemon, name=name)

    async def kill(self, name: str) -> None:
        """End a daemon (``master``, ``station1``, ...) in the middle of whatever it does."""
        await self._ask(name)
        task = self._tasks.pop(name)
        task.cancel()
        await asyncio.wait([task])
        if not task.cancelled() and (error := task.exception()) is not None:
            raise error

    async def _ask(self, name: str) -> None:
        """Note what a client says of itself, as people ask it; the authors' node says nothing."""
        for witness in self.witnesses.values():
            if name == station_name(witness.station) and witness.folder is not None:
                with suppress(OSError):  # it has only just been started
                    reader, writer = await asyncio.open_unix_connection(witness.folder / STATUS_SOCKET)
                    witness.statuses.append(decode(ClientStatus, await reader.readline()))
                    writer.close()

    async def restart(self, station: int | None, at_s: float) -> None:
        """Kill a station's client, or the master, at a true time from the start, and start it again."""
        await self.sleep_until(at_s)
        await self.kill(MASTER if station is None else station_name(station))
        await self.sleep_until(at_s + RESTART_S)
        if station is None:
            self.start_master()
        else:
            self.start_station(station)

    async def reboot(self, station: int, at_s: float, off_s: float) -> None:
        """Switch a station's computer off, and on again: its clocks begin anew, where its files end."""
        await self.sleep_until(at_s)
        await self.kill(station_name(station))
        unix_ns = self.clocks[station].realtime_ns()
        await self.sleep_until(at_s + off_s)
        now_ns = self._clock.monotonic_ns()
        self.clocks[station] = self._station_clock(
            station, offset_ns=unix_ns - START_UNIX_NS, booted_ns=now_ns
        )
        self.lines[station] = self._line(station)
        self._boots[station] += 1
        self.start_station(station)

    async def interrupt(self, outage: Outage) -> None:
        """Put a hill between the master and some stations, and take it away."""
        for at_s in (outage.start_s, outage.end_s):
            await self.sleep_until(at_s)
            for station in outage.stations:
                hidden = any(station in o.stations and o.covers(at_s) for o in self._options.outages)
                self.air.link.attenuate(MASTER, station_name(station), _OUT_OF_REACH_DB if hidden else 0.0)

    async def end(self) -> None:
        """End everything that still runs: the master first, so that no station seems lost to it."""
        for name in [MASTER, *[name for name in self._tasks if name != MASTER]]:
            if name in self._tasks:
                await self.kill(name)


def scenario_link(
    radio: ScenarioRadioConfig, places: dict[str, tuple[float, float, float]], rng: np.random.Generator
) -> LinkModel:
    """Make what lies between the radios of a scenario; ``places`` by radio, in m, may change meanwhile."""
    return LinkModel(
        path_loss=LogDistanceLoss(
            positions_m=places,
            exponent=radio.path_loss_exponent,
            shadowing_sigma_db=radio.shadowing_sigma_db,
            antenna_gain_db=radio.antenna_gain_db,
            seed=int(rng.integers(2**31)),
        ),
        rayleigh_fading=radio.rayleigh_fading,
        loss_probability=radio.loss_probability,
    )
