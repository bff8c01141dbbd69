"""A whole mission on virtual time: the real daemons, with simulated radios, instruments, clocks and robot.

Each daemon runs as a task, with radio and instrument handed to it as on a real computer. It can be killed and
started again at any instant; what it then finds (its journal's folder, the air, the instrument) is as it left it.

What the configuration files of a mission's daemons would say; radios and instruments are handed to them anyway.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from tsgt.config import (
    ClassicConfig,
    ClassicMasterConfig,
    ClientConfig,
    JournalConfig,
    LeicaInstrumentConfig,
    MasterConfig,
    RecordingConfig,
    SetupConfig,
    SimulatedRadioConfig,
    StationConfig,
    StreamConfig,
    SuperframeConfig,
    SuperframeMasterConfig,
    scenario_parameters,
)
from tsgt.master import run_master
from tsgt.radio.from_config import lora_settings
from tsgt.recording import decode
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import DriftingClock, VirtualClock, ramped
from tsgt.simulation.lora import Air, LinkModel, LogDistanceLoss, StampJitter, opener
from tsgt.simulation.lora.adversary import ForeignRadio
from tsgt.simulation.mission.authors_node import AUTHORS_STAMP_DELAY_MS, AuthorsNode
from tsgt.simulation.mission.computer import MASTER, Computer
from tsgt.simulation.mission.run_log import START_UNIX_NS, Session, StationWitness, WatchedInstrument
from tsgt.simulation.world import scenario_world
from tsgt.station import ClientStatus, run_client
from tsgt.station.leica import LeicaInstrument

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from tsgt.config import Baud, ScenarioConfig, ScenarioRadioConfig, SimulatedStation
    from tsgt.radio import OpenRadio
    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.options import Options, Outage
    from tsgt.simulation.world import World
    from tsgt.station import Reading

STATUS_SOCKET = "client.sock"

_RARELY_S = 1e6  # of fsync, which a simulation has no use for


def station_name(station: int) -> str:
    """Return the name of a station's radio and daemon."""
    return f"station{station}"


def radio_config(scenario: ScenarioConfig, name: str, folder: Path) -> SimulatedRadioConfig:
    """Say of the radio what a file would; the radio itself is handed to the daemon."""
    radio = scenario.radio
    return SimulatedRadioConfig(
        kind="simulated",
        air_socket=folder / "air.sock",
        name=name,
        frequency_mhz=radio.frequency_mhz,
        spreading_factor=radio.spreading_factor,
        bandwidth_khz=radio.bandwidth_khz,
        coding_rate=radio.coding_rate,
        power_dbm=radio.power_dbm,
    )


def master_config(scenario: ScenarioConfig, options: Options, folder: Path) -> MasterConfig:
    """Return the master's, with its recording and its socket in a folder."""
    return MasterConfig(
        kind="master",
        # Not read: the parameters are handed to the daemon.
        setup=SetupConfig(station_frames=folder / "frames.toml", prism_layout=folder / "layout.toml"),
        stations=tuple(
            StationConfig(
                station=s.station,
                prism=s.prism,
                prism_constant_mm=s.prism_constant_mm,
                timestamp_delay_ms=AUTHORS_STAMP_DELAY_MS if options.node == "authors" else 0.0,
                noise=s.noise,
            )
            for s in scenario.stations
        ),
        radio=radio_config(scenario, MASTER, folder),
        protocol=options.protocol,
        pipeline=scenario.pipeline,
        stream=StreamConfig(socket=folder / "poses.sock"),
        recording=RecordingConfig(directory=folder, fsync_interval_s=_RARELY_S),
    )


def client_config(
    scenario: ScenarioConfig, entry: SimulatedStation, options: Options, folder: Path
) -> ClientConfig:
    """Return that of a station's client, with its journal and its socket in a folder."""
    classic = isinstance(options.protocol, ClassicMasterConfig)
    return ClientConfig(
        kind="client",
        station=entry.station,
        prism=entry.prism,
        instrument=instrument_config(entry, folder / "instrument.tty"),
        radio=radio_config(scenario, station_name(entry.station), folder),
        protocol=ClassicConfig(kind="classic") if classic else SuperframeConfig(kind="superframe"),
        journal=JournalConfig(directory=folder, fsync_interval_s=_RARELY_S),
        status_socket=folder / STATUS_SOCKET,
    )


def instrument_config(entry: SimulatedStation, port: Path) -> LeicaInstrumentConfig:
    """Return how a client sets its station's simulated instrument, of which it knows everything.

    The instrument adds no prism constant; the master does.
    """
    model = entry.instrument
    return LeicaInstrumentConfig(
        kind="leica",
        port=port,
        baud=cast("Baud", model.baud),
        prism_type="user",
        prism_constant_mm=0.0,
        latency_ms=model.processing_min_ms,
        angle_delay_ms=model.angle_delay_ms,
    )


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
    clock
        The master's.
    computers
        By the names of their daemons.
    instruments, lines, prisms
        The total stations, their cables, and the prisms that they are to follow, by station number.
    warming
        Numbers of the stations whose crystals get warmer, or colder, at the moment.
    superframe
        Whether that protocol is spoken.
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
        self._true = VirtualClock(START_UNIX_NS)
        self.clock = VirtualClock(START_UNIX_NS)
        self._settings = lora_settings(
            radio_config(scenario, MASTER, folder), Path(f"scenario {scenario.name}")
        )
        numbers = [s.station for s in scenario.stations]
        names = [MASTER, *map(station_name, numbers)]
        rngs = dict(zip(names, [master_rng, *station_rngs], strict=True))
        authenticated = options.authenticated and isinstance(options.protocol, SuperframeMasterConfig)
        self._key = key_rng.bytes(_KEY_BYTES) if authenticated else None
        self.parameters = scenario_parameters(scenario)
        until_s = options.duration_s + 2 * DRAIN_S
        self.world: World = scenario_world(scenario, until_s, world_rng)
        self._places = {station_name(s.station): s.position_m for s in scenario.stations}
        self._places[FOREIGN] = _FOREIGN_PLACE_M
        self.air = Air(timeline, air_rng, scenario_link(scenario.radio, self._places, air_rng))
        self._timeline = timeline
        # A Pi has no battery clock: it wakes up in the past.
        clocks: list[VirtualClock | DriftingClock] = [self.clock]
        clocks += [self._station_clock(n, offset_ns=-int(clock_rng.integers(3 * _YEAR_NS))) for n in numbers]
        self.computers = {
            name: Computer(name, clock, self.air, self._settings, rngs[name], self._jitter(jitter_rng))
            for name, clock, jitter_rng in zip(names, clocks, jitter_rngs, strict=True)
        }
        self.instruments = {s.station: self._instrument(s) for s in scenario.stations}
        self.lines = {number: self._line(number) for number in numbers}
        self._boots = dict.fromkeys(numbers, 1)
        self.sessions: list[Session] = []
        self.prisms = {s.station: s.prism for s in scenario.stations}
        self.warming: set[int] = set()
        self.superframe = isinstance(options.protocol, SuperframeMasterConfig)
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
            self._true,
            offset_ns=offset_ns,
            drift_ppm=drift_ppm,
            drift_steps=steps if ramp_ppm_per_min else (),
            booted_ns=booted_ns,
        )

    def _instrument(self, entry: SimulatedStation) -> SimulatedTotalStation:
        rng = self._computer(entry.station).rng.spawn(1)[0]
        return SimulatedTotalStation(
            self._entry(entry.station), self._scenario, self.world, self._timeline, rng
        )

    def _line(self, station: int) -> SimulatedLine:
        name = f"{station_name(station)}'s cable"
        return SimulatedLine(
            self.instruments[station], self._timeline, self._computer(station).clock, name=name
        )

    def _entry(self, station: int) -> SimulatedStation:
        """Return what the scenario says of a station; the authors' instrument calls their node at once."""
        entry = self._scenario.stations[self._index(station)]
        if self._options.node != "authors":
            return entry
        model = entry.instrument.model_copy(update={"processing_min_ms": 0.0, "processing_max_ms": 1.0})
        return entry.model_copy(update={"instrument": model})

    def _jitter(self, rng: np.random.Generator) -> StampJitter | None:
        sigma_ns = round(self._options.stamp_jitter_us * 1e3)
        return StampJitter(sigma_ns, rng) if sigma_ns else None

    def _computer(self, station: int) -> Computer:
        return self.computers[station_name(station)]

    def _index(self, station: int) -> int:
        return [s.station for s in self._scenario.stations].index(station)

    @property
    def now_s(self) -> float:
        """The true time, from the start."""
        return self._true.monotonic_ns() / 1e9

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
            tasks = [computer.task for computer in self.computers.values() if computer.task is not None]
            if not tasks:  # all of them are away
                await asyncio.sleep(step_s)
                continue
            ended, _ = await asyncio.wait(tasks, timeout=step_s, return_when=asyncio.FIRST_EXCEPTION)
            errors = [
                error
                for task in ended
                if not task.cancelled() and isinstance(error := task.exception(), Exception)
            ]
            if errors:
                raise ExceptionGroup("a daemon has ended", errors)
            await asyncio.sleep(0)  # one that was killed is about to be taken away

    async def sleep_until(self, time_s: float) -> None:
        """Return at a true time, from the start; for whoever acts beside the daemons."""
        await self._true.sleep_until(round(time_s * 1e9))

    def start_master(self) -> None:
        """Start the master, with a recording of its own."""
        folder = self._folder / f"master{len(self.sessions)}"
        zero_ns = self.clock.realtime_ns() - self.clock.monotonic_ns()
        session = Session(folder, self._true.monotonic_ns, zero_ns)
        self.sessions.append(session)
        config = master_config(self._scenario, self._options, folder)
        folder.mkdir()
        computer = self.computers[MASTER]
        computer.start(
            run_master(
                config,
                self.parameters,
                self._settings,
                open_radio=computer.radio(),
                clock=self.clock,
                key=self._key,
                random_bits=self._random_bits,
                observe=session.take,
                write=computer.new_program(),
            ),
        )

    def start_station(self, station: int) -> None:
        """Start a station's client, with a journal of its own beside the earlier ones, or the authors' node."""
        entry = self._entry(station)
        authors = self._options.node == "authors"
        self._computer(station).start(self._authors_node(entry) if authors else self._client(entry))

    async def be_foreign(self) -> None:
        """Use the channel as somebody else, until cancelled."""
        radio = ForeignRadio(self._true, self._foreign_rng, self._options.interference_rate_hz)
        await radio.run(self.stranger(FOREIGN))

    def stranger(self, name: str, gain_db: float = 0.0, sync_word: int | None = None) -> OpenRadio:
        """Return what opens a radio that does not belong to the mission.

        Parameters
        ----------
        name
            Its own.
        gain_db
            By how much everybody hears it better than from its place.
        sync_word
            That of its packets; None: the mission's.
        """
        self._places[name] = _FOREIGN_PLACE_M
        for other in self.computers:
            self.air.link.attenuate(name, other, -gain_db)
        settings = self._settings if sync_word is None else replace(self._settings, sync_word=sync_word)
        return opener(self.air, name, self._true, self._foreign_rng, settings)

    def _random_bits(self, count: int) -> int:
        return int.from_bytes(self._bits_rng.bytes(-(-count // 8))) >> -count % 8

    def _client(self, entry: SimulatedStation) -> Coroutine[None, None, None]:
        station = entry.station
        witness, computer = self.witnesses[station], self._computer(station)
        clock = computer.clock
        folder = self._folder / station_name(station)
        folder.mkdir(exist_ok=True)
        unix_at_zero_ns = clock.realtime_ns() - clock.monotonic_ns()

        def watch(reading: Reading) -> None:
            witness.stamps_ns[unix_at_zero_ns + reading.at_ns] = clock.true_ns(reading.at_ns)
            witness.read_ns[unix_at_zero_ns + reading.at_ns] = self._true.monotonic_ns()

        return run_client(
            client_config(self._scenario, entry, self._options, folder),
            self._settings,
            instrument=WatchedInstrument(self._driver(entry), watch),
            open_radio=computer.radio(),
            clock=clock,
            key=self._key,
            random_bits=self._random_bits,
            boot=f"{station_name(station)}-{self._boots[station]}",
            write=computer.new_program(),
        )

    def _driver(self, entry: SimulatedStation) -> LeicaInstrument:
        config = instrument_config(entry, self._folder / station_name(entry.station))
        return LeicaInstrument(config, self.lines[entry.station].open, self._computer(entry.station).clock)

    async def _authors_node(self, entry: SimulatedStation) -> None:
        station = entry.station
        witness, computer = self.witnesses[station], self._computer(station)
        clock = computer.clock

        def watch(_reading: Reading) -> None:
            witness.stamps_ns[clock.realtime_ns()] = self._true.monotonic_ns()  # stamped on arrival

        instrument = WatchedInstrument(self._driver(entry), watch)
        async with computer.radio(slow=False)() as radio:
            await AuthorsNode(station, radio, clock, instrument, entry.prism, computer.rng).run()

    async def kill(self, name: str) -> None:
        """End a daemon (``master``, ``station1``, ...) in the middle of whatever it does, as systemd does."""
        await self._ask(name)
        await self.computers[name].end()

    async def crash(self, name: str, *, away_s: float) -> None:
        """Kill a daemon as ``kill -9`` does, and start it again; nothing happens to one that is away already."""
        computer = self.computers[name]
        if computer.away:
            return
        computer.away = True
        if name == MASTER:
            self.sessions[-1].crashed = True
        else:
            self._excuse(computer)
        await computer.crash()  # which takes time of its own, in which nothing is written
        await asyncio.sleep(away_s)
        computer.away = False
        self._start_again(name)

    def _excuse(self, computer: Computer) -> None:
        """Note that what a client has read before it was ended need not be on its disk."""
        now_ns = self._true.monotonic_ns()
        witness = self.witnesses[self._station(computer.name)]
        witness.crashed_ns.append((computer.disk.unwritten_since_ns(now_ns), now_ns))

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
        self._start_again(MASTER if station is None else station_name(station))

    def _start_again(self, name: str) -> None:
        if name == MASTER:
            self.start_master()
        else:
            self.start_station(self._station(name))

    def _station(self, name: str) -> int:
        return next(number for number in self.witnesses if station_name(number) == name)

    async def reboot(self, station: int, at_s: float, off_s: float) -> None:
        """Switch a station's computer off, and on again: its clocks begin anew, where its files end."""
        await self.sleep_until(at_s)
        computer = self._computer(station)
        if computer.away:
            return
        computer.away = True
        await self.kill(computer.name)
        self._excuse(computer)
        unix_ns = computer.clock.realtime_ns()
        await self.sleep_until(at_s + off_s)
        computer.away = False
        now_ns = self._true.monotonic_ns()
        computer.clock = self._station_clock(station, offset_ns=unix_ns - START_UNIX_NS, booted_ns=now_ns)
        self.lines[station] = self._line(station)
        self._boots[station] += 1
        self.start_station(station)

    def stream_socket(self) -> Path:
        """Return the socket of the master that runs, or ran last."""
        return master_config(
            self._scenario, self._options, self._folder / f"master{len(self.sessions) - 1}"
        ).stream.socket

    async def interrupt(self, outage: Outage) -> None:
        """Put a hill between the master and some stations, and take it away."""
        for at_s in (outage.start_s, outage.end_s):
            await self.sleep_until(at_s)
            for station in outage.stations:
                hidden = any(station in o.stations and o.covers(at_s) for o in self._options.outages)
                self.air.link.attenuate(MASTER, station_name(station), _OUT_OF_REACH_DB if hidden else 0.0)

    async def end(self) -> None:
        """End everything that still runs: the master first, so that no station seems lost to it."""
        for name in self.computers:
            if self.computers[name].task is not None:
                await self.kill(name)
