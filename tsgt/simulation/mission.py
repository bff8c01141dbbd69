"""A whole mission on virtual time: the real daemons, with simulated radios, instruments, clocks and robot.

Each daemon runs as a task, with radio and instrument handed to it as on a real computer. It can be killed and
started again at any instant; what it then finds (its journal's folder, the air, the instrument) is as it left it.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from tsgt.config import ClientConfig, MasterConfig, scenario_parameters
from tsgt.config.client import JournalConfig, SimulatedInstrumentConfig
from tsgt.config.master import RecordingConfig, SetupConfig, StationConfig, StreamConfig
from tsgt.config.radio import ClassicConfig, ClassicMasterConfig, SimulatedRadioConfig
from tsgt.master.daemon import run_master
from tsgt.radio.from_config import lora_settings
from tsgt.simulation.air import Air
from tsgt.simulation.authors_node import AUTHORS_STAMP_DELAY_MS, AuthorsNode
from tsgt.simulation.clocks import DriftingClock, VirtualClock
from tsgt.simulation.instrument import SimulatedInstrument
from tsgt.simulation.link import LinkModel, LogDistanceLoss
from tsgt.simulation.radios import HostDelay, opener
from tsgt.simulation.witness import Session, StationWitness, WatchedInstrument
from tsgt.simulation.world import scenario_world
from tsgt.station.daemon import run_client

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from tsgt.config import ScenarioConfig
    from tsgt.config.scenario import ScenarioRadioConfig, SimulatedStation
    from tsgt.simulation.timeline import Timeline
    from tsgt.simulation.world import World
    from tsgt.station.instrument import Reading

Node = Literal["ours", "authors"]

START_UNIX_NS = 1_800_000_000_000_000_000
"""Unix time at which every simulated run starts, on the master's clock: 15 January 2027."""

DRAIN_S = 5.0
"""How long a run goes on after its end, so that what is under way can arrive."""

_YEAR_NS = 365 * 86_400 * 10**9
_RARELY_S = 1e6  # of fsync, which a simulation has no use for


class Mission:
    """The parts of a mission; has to be made and used in a running event loop on virtual time.

    Parameters
    ----------
    scenario
        World, stations, radio conditions.
    protocol
        What the master speaks.
    node
        What the stations run: our client, or the authors' node.
    drift_ppm
        Of the stations' clocks against the master's: plus this for the first, minus this for the second, and so on.
    duration_s
        How long it measures.
    seed
        Of everything that is drawn.
    folder
        For recordings, journals and sockets.
    timeline
        That of the running loop.

    Attributes
    ----------
    world
        The truth; its time is the true time.
    clocks, instruments
        The stations' clocks and total stations, by station number; they outlive the clients.
    sessions
        What the master sent out, one entry for each time that it was started.
    witnesses
        What was read from the instruments, by station number.
    air
        The channel.
    """

    def __init__(
        self,
        scenario: ScenarioConfig,
        protocol: ClassicMasterConfig,
        *,
        node: Node,
        drift_ppm: float,
        duration_s: float,
        seed: int,
        folder: Path,
        timeline: Timeline,
    ) -> None:
        world_rng, air_rng, self._master_rng, clock_rng, *station_rngs = np.random.default_rng(seed).spawn(
            4 + len(scenario.stations)
        )
        self._scenario = scenario
        self._protocol = protocol
        self._node = node
        self._folder = folder
        self._clock = VirtualClock(START_UNIX_NS)
        self._settings = lora_settings(
            _radio_config(scenario, "master", folder), Path(f"scenario {scenario.name}")
        )
        self._rngs = {s.station: rng for s, rng in zip(scenario.stations, station_rngs, strict=True)}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self.parameters = scenario_parameters(scenario)
        self.world: World = scenario_world(scenario, duration_s + 2 * DRAIN_S, world_rng)
        self._places = {_name(s.station): s.position_m for s in scenario.stations}
        self.air = Air(timeline, air_rng, scenario_link(scenario.radio, self._places, air_rng))
        self.clocks = {
            s.station: DriftingClock(
                self._clock,
                # A Pi has no battery clock: it wakes up in the past.
                offset_ns=-int(clock_rng.integers(3 * _YEAR_NS)),
                drift_ppm=drift_ppm if index % 2 == 0 else -drift_ppm,
            )
            for index, s in enumerate(scenario.stations)
        }
        self.instruments = {
            s.station: SimulatedInstrument(
                s, scenario, self.world, self.clocks[s.station], self._rngs[s.station].spawn(1)[0]
            )
            for s in scenario.stations
        }
        self.sessions: list[Session] = []
        self.witnesses = {s.station: StationWitness(s.station) for s in scenario.stations}

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
            self._places["master"] = tuple(self.world.pose_at(np.array([self.now_s]))[0, :3, 3].tolist())
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
        session = Session(folder)
        self.sessions.append(session)
        config = _master_config(self._scenario, self._protocol, self._node, folder)
        folder.mkdir()
        open_radio = opener(self.air, "master", self._clock, self._master_rng, self._settings, HostDelay())
        self._start(
            "master",
            run_master(
                config,
                self.parameters,
                self._settings,
                open_radio=open_radio,
                clock=self._clock,
                observe=session.take,
            ),
        )

    def start_station(self, station: int) -> None:
        """Start a station's client, with a journal of its own, or the authors' node."""
        entry = next(s for s in self._scenario.stations if s.station == station)
        daemon = self._authors_node(entry) if self._node == "authors" else self._client(entry)
        self._start(_name(station), daemon)

    def _client(self, entry: SimulatedStation) -> Coroutine[None, None, None]:
        station = entry.station
        witness, clock, rng = self.witnesses[station], self.clocks[station], self._rngs[station]
        folder = self._folder / f"station{station}-{len(witness.journals)}"
        folder.mkdir()
        witness.journals.append(folder)
        unix_at_zero_ns = clock.realtime_ns() - clock.monotonic_ns()

        def watch(reading: Reading) -> None:
            witness.stamps_ns[unix_at_zero_ns + reading.at_ns] = clock.true_ns(reading.at_ns)

        return run_client(
            _client_config(self._scenario, entry, folder),
            instrument=WatchedInstrument(self.instruments[station], watch),
            open_radio=opener(self.air, _name(station), clock, rng, self._settings, HostDelay()),
            clock=clock,
        )

    async def _authors_node(self, entry: SimulatedStation) -> None:
        station = entry.station
        witness, clock, rng = self.witnesses[station], self.clocks[station], self._rngs[station]

        def watch(_reading: Reading) -> None:
            witness.stamps_ns[clock.realtime_ns()] = self._clock.monotonic_ns()  # stamped on arrival

        instrument = WatchedInstrument(self.instruments[station], watch)
        async with opener(self.air, _name(station), clock, rng, self._settings)() as radio:
            await AuthorsNode(station, radio, clock, instrument, entry.prism, rng).run()

    def _start(self, name: str, daemon: Coroutine[None, None, None]) -> None:
        self._tasks[name] = asyncio.create_task(daemon, name=name)

    async def kill(self, name: str) -> None:
        """End a daemon (``master``, ``station1``, ...) in the middle of whatever it does."""
        task = self._tasks.pop(name)
        task.cancel()
        await asyncio.wait([task])
        if not task.cancelled() and (error := task.exception()) is not None:
            raise error

    async def end(self) -> None:
        """End everything that still runs: the master first, so that no station seems lost to it."""
        for name in ["master", *[name for name in self._tasks if name != "master"]]:
            if name in self._tasks:
                await self.kill(name)


def _name(station: int) -> str:
    return f"station{station}"


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


def _radio_config(scenario: ScenarioConfig, name: str, folder: Path) -> SimulatedRadioConfig:
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


def _master_config(
    scenario: ScenarioConfig, protocol: ClassicMasterConfig, node: Node, folder: Path
) -> MasterConfig:
    return MasterConfig(
        kind="master",
        # Not read: the parameters are handed to the daemon.
        setup=SetupConfig(station_frames=folder / "frames.toml", prism_layout=folder / "layout.toml"),
        stations=tuple(
            StationConfig(
                station=s.station,
                prism=s.prism,
                prism_constant_mm=s.prism_constant_mm,
                stamp_delay_ms=AUTHORS_STAMP_DELAY_MS if node == "authors" else 0.0,
                noise=s.noise,
            )
            for s in scenario.stations
        ),
        radio=_radio_config(scenario, "master", folder),
        protocol=protocol,
        pipeline=scenario.pipeline,
        stream=StreamConfig(socket=folder / "poses.sock"),
        recording=RecordingConfig(directory=folder, fsync_interval_s=_RARELY_S),
    )


def _client_config(scenario: ScenarioConfig, entry: SimulatedStation, folder: Path) -> ClientConfig:
    return ClientConfig(
        kind="client",
        station=entry.station,
        prism=entry.prism,
        # Not reached: the instrument is handed to the daemon.
        instrument=SimulatedInstrumentConfig(kind="simulated", socket=folder / "instrument.sock"),
        radio=_radio_config(scenario, _name(entry.station), folder),
        protocol=ClassicConfig(kind="classic"),
        journal=JournalConfig(directory=folder, fsync_interval_s=_RARELY_S),
        status_socket=folder / "client.sock",
    )
