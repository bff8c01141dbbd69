"""A mission on virtual time: the real daemons, with simulated radios, instruments, clocks and robot.

Each daemon runs as a task, with radio and instrument handed over as on a real computer. It can be killed and restarted
at any instant, and then finds its journals, the channel and the instrument as it left them.
"""

from __future__ import annotations

import asyncio
import math
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tsgt import service
from tsgt.config import SuperframeMasterConfig, level_frame, scenario_parameters
from tsgt.estimation import start_now
from tsgt.master.daemon import MasterDependencies, run_master
from tsgt.radio.from_config import lora_settings
from tsgt.radio.superframe.wire import KEY_BYTES
from tsgt.recording import IMU_SHOCKS_FILE, read_imu_shocks
from tsgt.simulation.imu import IMU_MODELS, ImuProgram, simulate_imu
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import DriftingClock, VirtualClock, drift_ramp
from tsgt.simulation.lora import Air, TimestampJitter, radio_opener, scenario_link
from tsgt.simulation.lora.adversary import ReplayAttacker
from tsgt.simulation.mission.authors_node import AuthorsNode
from tsgt.simulation.mission.computer import MASTER, ClientClock, Computer
from tsgt.simulation.mission.config_edits import NO_EDIT, MasterEdit
from tsgt.simulation.mission.daemon_configs import (
    client_config,
    instrument_config,
    master_config,
    radio_config,
    station_name,
)
from tsgt.simulation.mission.disk import UNWRITTEN_WINDOW_NS
from tsgt.simulation.mission.master_log import MasterLog
from tsgt.simulation.mission.observed import ObservedInstrument, observed_radio
from tsgt.simulation.mission.result import START_UNIX_NS, StationMove
from tsgt.simulation.mission.setup_mistakes import NO_MISTAKE, SetupMistake
from tsgt.simulation.mission.station_log import StationLog
from tsgt.simulation.wheel_odometry import OdometryModel, OdometryProgram, simulate_odometry
from tsgt.simulation.world import is_shaken, scenario_world
from tsgt.station import ClientDependencies, run_client

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from tsgt.config import ScenarioConfig, SimulatedStation
    from tsgt.errors import ComputerSuspendedError
    from tsgt.radio import RadioOpener
    from tsgt.simulation.imu import ImuCondition, SimulatedImuRun
    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.options import Outage, SimulationOptions
    from tsgt.simulation.wheel_odometry import OdometryCondition, OdometrySamples
    from tsgt.simulation.world import Rollover, World
    from tsgt.station import Reading

DRAIN_S = 5.0
"""Simulated time after the end of the measurements, in which pending deliveries arrive."""

RESTART_DELAY_S = 2.0
"""Downtime of a restart, as with systemd."""

INTERFERER = "foreign"
"""Radio name of the interferer. Random draws depend on it: another name would change recordings."""

_OUTAGE_DB = 300.0
_INTERFERER_POSITION_M = (30.0, -20.0, 1.5)
_SHAKING_SEED = 0x5A
_YEAR_NS = 365 * 86_400 * 10**9


class Mission:
    """A mission; create and use it in a running event loop on virtual time. Dictionaries are keyed by station number.

    ``imu_conditions``, ``odometry_conditions``: faults of the robot's IMU and wheel odometry; ``rollovers``: of the robot.
    ``master_sleeps``: the master's computer can be suspended, for which it needs a slower clock.
    """

    def __init__(
        self,
        scenario: ScenarioConfig,
        options: SimulationOptions,
        *,
        folder: Path,
        timeline: Timeline,
        imu_conditions: Sequence[ImuCondition] = (),
        odometry_conditions: Sequence[OdometryCondition] = (),
        rollovers: Sequence[Rollover] = (),
        master_sleeps: bool = False,
    ) -> None:
        rng = np.random.default_rng(options.seed)
        world_rng, air_rng, master_rng, clock_rng, *station_rngs = rng.spawn(4 + len(scenario.stations))
        # Spawned last, so that unused options do not change the other draws.
        self._interferer_rng, key_rng, self._bits_rng, *jitter_rngs = rng.spawn(4 + len(scenario.stations))
        self._scenario = scenario
        self._options = options
        self._folder = folder
        self._true = VirtualClock(START_UNIX_NS, timeline)
        self.clock: VirtualClock | DriftingClock = VirtualClock(START_UNIX_NS, timeline)  # the master's clock
        if master_sleeps:
            self.clock = DriftingClock(self._true)
        self._settings = lora_settings(
            radio_config(scenario, MASTER, folder), Path(f"scenario {scenario.name}")
        )
        numbers = [s.station for s in scenario.stations]
        names = [MASTER, *map(station_name, numbers)]
        rngs = dict(zip(names, [master_rng, *station_rngs], strict=True))
        authenticated = options.authenticated and isinstance(options.protocol, SuperframeMasterConfig)
        self._key = key_rng.bytes(KEY_BYTES) if authenticated else None
        self.parameters = scenario_parameters(scenario)
        until_s = options.duration_s + 2 * DRAIN_S
        self.world: World = scenario_world(scenario, until_s, world_rng)  # ground truth on true time
        if rollovers:
            self.world.roll_over(rollovers, numbers)
        # Generators of their own: with shaking and IMU all other draws stay the same.
        if is_shaken(scenario):
            shaking_rng = np.random.default_rng([options.seed, _SHAKING_SEED])
            self.world.shake(scenario.shaking, np.array(scenario.imu.position_m), shaking_rng)
        self.imu: SimulatedImuRun | None = None  # None: the robot has none
        if scenario.imu.model != "none":
            self.imu = simulate_imu(
                scenario.imu,
                self.world.motion_at,
                options.duration_s + DRAIN_S,
                seed=[options.seed],
                conditions=imu_conditions,
            )
            self.parameters = replace(self.parameters, imu=self.imu.parameters)
        self.odometry: OdometrySamples | None = None
        wheels = master_config(scenario, options, folder).odometry
        if wheels is not None:
            self.odometry = simulate_odometry(
                OdometryModel(),
                self.world.motion_at,
                options.duration_s + DRAIN_S,
                seed=[options.seed],
                conditions=odometry_conditions,
            )
            self.parameters = replace(self.parameters, odometry=wheels.parameters())
        self.first_parameters = self.parameters
        self._positions_m = {station_name(s.station): s.position_m for s in scenario.stations}
        self._positions_m[INTERFERER] = _INTERFERER_POSITION_M
        self.air = Air(timeline, air_rng, scenario_link(scenario.radio, self._positions_m, air_rng))
        self._timeline = timeline
        # A Pi has no battery-backed clock and boots with an old time.
        clocks: list[VirtualClock | DriftingClock] = [self.clock]
        clocks += [self._station_clock(n, offset_ns=-int(clock_rng.integers(3 * _YEAR_NS))) for n in numbers]
        self.computers = {
            name: Computer(name, clock, self.air, self._settings, rngs[name], self._jitter(jitter_rng))
            for name, clock, jitter_rng in zip(names, clocks, jitter_rngs, strict=True)
        }
        self.instruments = {s.station: self._instrument(s) for s in scenario.stations}
        self.lines = {number: self._line(number) for number in numbers}
        self._boots = dict.fromkeys(numbers, 1)
        self.master_logs: list[MasterLog] = []  # one per start of the master
        self.other_master_logs: list[MasterLog] = []  # of masters that do not belong to the mission
        self.prisms = {s.station: s.prism for s in scenario.stations}
        self._placed = {s.station: s for s in scenario.stations}  # where the stations are now
        self.moves: list[StationMove] = []
        self.mistakes: dict[int, SetupMistake] = {}  # in force from the next start of the client on
        self.edit = NO_EDIT  # of the master's configuration, likewise
        self.drifting: set[int] = set()  # stations whose clock drift is changing
        self.superframe = isinstance(options.protocol, SuperframeMasterConfig)
        self.station_logs = {
            number: StationLog(
                number,
                None if options.station_software == "authors" else folder / station_name(number),
                self.instruments[number].reported_distances,
            )
            for number in numbers
        }

    def _station_clock(self, station: int, *, offset_ns: int, booted_ns: int = 0) -> DriftingClock:
        options = self._options
        sign = -1 if self._index(station) % 2 else 1
        drift_ppm, ramp_ppm_per_min = sign * options.drift_ppm, sign * options.drift_ramp_ppm_per_min
        steps = drift_ramp(drift_ppm, ramp_ppm_per_min, round((options.duration_s + 2 * DRAIN_S) * 1e9))
        return DriftingClock(
            self._true,
            offset_ns=offset_ns,
            drift_ppm=drift_ppm,
            drift_changes=steps if ramp_ppm_per_min else (),
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
        """Return a station of the scenario; the authors' instrument responds without processing time."""
        entry = self._scenario.stations[self._index(station)]
        if self._options.station_software != "authors":
            return entry
        model = entry.instrument.model_copy(update={"processing_min_ms": 0.0, "processing_max_ms": 1.0})
        return entry.model_copy(update={"instrument": model})

    def _jitter(self, rng: np.random.Generator) -> TimestampJitter | None:
        sigma_ns = round(self._options.stamp_jitter_us * 1e3)
        return TimestampJitter(sigma_ns, rng) if sigma_ns else None

    def _computer(self, station: int) -> Computer:
        return self.computers[station_name(station)]

    def _index(self, station: int) -> int:
        return [s.station for s in self._scenario.stations].index(station)

    @property
    def now_s(self) -> float:
        """True time in s from the start."""
        return self._true.monotonic_ns() / 1e9

    async def run_until(self, time_s: float) -> None:
        """Run until a true time; the robot's radio moves with the robot.

        Raises
        ------
        ExceptionGroup
            A daemon ended with an error.
        """
        while self.now_s < time_s:
            self._positions_m[MASTER] = tuple(self.world.pose_at(np.array([self.now_s]))[0, :3, 3].tolist())
            step_s = min(1.0, time_s - self.now_s)
            computers = self.computers.values()
            running = [each.task for each in computers if each.task is not None and not each.task.done()]
            if running:
                await asyncio.wait(running, timeout=step_s, return_when=asyncio.FIRST_EXCEPTION)
            else:  # all daemons are down
                await asyncio.sleep(step_s)
            if failures := [error for each in computers if (error := each.failure) is not None]:
                raise BaseExceptionGroup("a daemon has ended", failures)

    async def sleep_until(self, time_s: float) -> None:
        """Sleep until a true time in s from the start."""
        await self._true.sleep_until(round(time_s * 1e9))

    def start_master(self) -> None:
        """Start the master with a new recording."""
        master = self._new_master()
        sleeps = isinstance(self.clock, DriftingClock)
        self.computers[MASTER].start(self._through_suspensions(master) if sleeps else master)

    def _new_master(self, suspended: ComputerSuspendedError | None = None) -> Coroutine[None, None, None]:
        before = self.master_logs[-1] if self.master_logs else None
        master_log = self._new_master_log(f"master{len(self.master_logs)}", self.clock)
        master_log.folder.mkdir()
        if before is not None:  # all have the same folder in the field
            with suppress(FileNotFoundError):
                shutil.copy(before.folder / IMU_SHOCKS_FILE, master_log.folder)
        self.master_logs.append(master_log)
        return self._master(master_log, self.computers[MASTER], self.clock, suspended)

    async def _through_suspensions(self, master: Coroutine[None, None, None]) -> None:
        """Run the master, and after each suspension another one, as :func:`~tsgt.master.daemon.run_through_suspensions` does."""
        while True:
            master = self._new_master(await service.until_suspended(master))

    async def run_second_master(self, for_s: float) -> None:
        """Run another master with the same key, stations and set-up beside the robot's, and then stop it."""
        name = f"other master{len(self.other_master_logs)}"
        clock = VirtualClock(START_UNIX_NS, self._timeline)
        computer = Computer(name, clock, self.air, self._settings, self._interferer_rng.spawn(1)[0], None)
        self._positions_m[name] = _INTERFERER_POSITION_M
        master_log = self._new_master_log(name.replace(" ", "-"), clock)
        self.other_master_logs.append(master_log)
        master_log.folder.mkdir()
        computer.start(self._master(master_log, computer, clock))
        await asyncio.sleep(for_s)
        await computer.stop()

    def _new_master_log(self, folder: str, clock: VirtualClock | DriftingClock) -> MasterLog:
        unix_at_zero_ns = clock.realtime_ns() - self._true.monotonic_ns()
        return MasterLog(self._folder / folder, self._true.monotonic_ns, unix_at_zero_ns, self.parameters)

    def _master(
        self,
        master_log: MasterLog,
        computer: Computer,
        clock: VirtualClock | DriftingClock,
        suspended: ComputerSuspendedError | None = None,
    ) -> Coroutine[None, None, None]:
        folder = master_log.folder
        scenario, settings = self.edit.applied_to(self._scenario), self.edit.applied_to_radio(self._settings)
        config = master_config(scenario, self._options, folder)
        parameters = self.parameters
        if self.edit is not NO_EDIT:
            edited = scenario_parameters(scenario)
            frames = {each.station: each.T_station1_station for each in parameters.stations}
            stations = (replace(s, T_station1_station=frames[s.station]) for s in edited.stations)
            parameters = replace(
                edited, stations=tuple(stations), imu=parameters.imu, odometry=parameters.odometry
            )
        if parameters.imu is not None:
            shocks = read_imu_shocks(folder, parameters.imu)
            parameters = replace(parameters, imu=replace(parameters.imu, shocks_before=shocks))
        master_log.parameters = parameters
        start_imu = None
        if self.imu is not None:
            start_imu = ImuProgram(IMU_MODELS[self._scenario.imu.model], self.imu.samples, clock).start
        start_odometry = None
        if self.odometry is not None:
            start_odometry = OdometryProgram(self.odometry, clock).start
        writer = computer.new_writer()
        open_radio = computer.radio(settings)
        if not self.superframe:
            open_radio = observed_radio(
                open_radio, lambda reply: master_log.observe_reply(reply, clock.true_ns)
            )
        return run_master(
            config,
            parameters,
            settings,
            MasterDependencies(
                open_radio=open_radio,
                clock=clock,
                key=self._key,
                random_bits=self._random_bits,
                observe=master_log.observe,
                start_imu=start_imu,
                start_odometry=start_odometry,
                write=writer.write,
                sync=writer.sync,
                disk_status=lambda _folder: computer.disk.status(),
                suspended_ns=lambda: computer.suspended_ns,
                start_check=start_now,  # no other thread: it would break on a look at all objects
            ),
            suspended,
        )

    def start_station(self, station: int) -> None:
        """Start a station's client with a new journal, or the authors' node."""
        entry = self._entry(station)
        authors = self._options.station_software == "authors"
        self._computer(station).start(self._authors_node(entry) if authors else self._client(entry))

    async def run_interference(self) -> None:
        """Run the interferer until cancelled."""
        radio = ReplayAttacker(self._true, self._interferer_rng, self._options.interference_rate_hz)
        await radio.run(self.interferer_radio(INTERFERER))

    def interferer_radio(self, name: str, gain_db: float = 0.0, sync_word: int | None = None) -> RadioOpener:
        """Return the opener of a radio that does not belong to the mission; sync word None: the mission's."""
        self._positions_m[name] = _INTERFERER_POSITION_M
        for other in self.computers:
            self.air.link.set_attenuation(name, other, -gain_db)
        settings = self._settings if sync_word is None else replace(self._settings, sync_word=sync_word)
        return radio_opener(self.air, name, self._true, self._interferer_rng, settings)

    def _random_bits(self, count: int) -> int:
        return int.from_bytes(self._bits_rng.bytes(-(-count // 8))) >> -count % 8

    def _client(self, entry: SimulatedStation) -> Coroutine[None, None, None]:
        station, mistake = entry.station, self.mistakes.get(entry.station, NO_MISTAKE)
        station_log, computer = self.station_logs[station], self._computer(station)
        clock = ClientClock(computer)
        folder = self._folder / station_name(station)
        if not mistake.delivers:  # what it measures is of no station of the mission
            folder, station_log = folder / "mistake", StationLog(station, None)
            entry = entry.model_copy(update={"station": mistake.station or station})
        if mistake.prism is not None:
            entry = entry.model_copy(update={"prism": mistake.prism})
        folder.mkdir(exist_ok=True)

        def on_reading(reading: Reading) -> None:
            if computer.suspended_ns != clock.suspended_ns:
                return  # the client starts anew instead of using the reading: its time mixes two clocks
            host_time_ns = clock.unix_at_zero_ns + reading.at_ns
            station_log.true_times_ns[host_time_ns] = clock.true_ns(reading.at_ns)
            station_log.read_times_ns[host_time_ns] = self._true.monotonic_ns()

        settings = mistake.applied_to(self._settings)
        return run_client(
            client_config(
                self._scenario, entry, self._options, folder, other_protocol=mistake.other_protocol
            ),
            settings,
            ClientDependencies(
                instrument=self._driver(
                    self._entry(station), on_reading, prism_constant_mm=mistake.prism_constant_mm
                ),
                open_radio=computer.radio(settings),
                clock=clock,
                key=self._key if mistake.key is None else mistake.key,
                random_bits=self._random_bits,
                boot=f"{station_name(station)}-{self._boots[station]}",
                suspended_ns=lambda: computer.suspended_ns,
                write=computer.new_writer().write,
            ),
        )

    def _driver(
        self,
        entry: SimulatedStation,
        on_reading: Callable[[Reading], None],
        *,
        prism_constant_mm: float = 0.0,
    ) -> ObservedInstrument:
        folder = self._folder / station_name(entry.station)
        config = instrument_config(entry, folder, prism_constant_mm=prism_constant_mm)
        line, clock = self.lines[entry.station], self._computer(entry.station).clock
        return ObservedInstrument(config, line.open, clock, on_reading)

    async def _authors_node(self, entry: SimulatedStation) -> None:
        station = entry.station
        station_log, computer = self.station_logs[station], self._computer(station)
        clock = computer.clock

        def on_reading(_reading: Reading) -> None:
            station_log.true_times_ns[clock.realtime_ns()] = (
                self._true.monotonic_ns()
            )  # timestamped on arrival

        instrument = self._driver(entry, on_reading)
        async with computer.radio(slow=False)() as radio:
            await AuthorsNode(station, radio, clock, instrument, entry.prism, computer.rng).run()

    async def stop(self, name: str) -> None:
        """Stop a daemon by the name of its computer, as systemd does."""
        await self._record_status(name)
        await self.computers[name].stop()

    async def crash(self, name: str, *, down_s: float) -> None:
        """Kill a daemon as ``kill -9`` does, and restart it after ``down_s``.

        No effect on one that is down, or whose computer is suspended.
        """
        computer = self.computers[name]
        if computer.is_down or computer.is_suspended:
            return
        computer.is_down = True
        if name == MASTER:
            self.master_logs[-1].crashed = True
        else:
            self._record_crash_window(computer)
        await computer.kill()
        await asyncio.sleep(down_s)
        computer.is_down = False
        self._start(name)

    def _record_crash_window(self, computer: Computer) -> None:
        """Record that recent readings of a client need not be on its disk."""
        now_ns = self._true.monotonic_ns()
        station_log = self.station_logs[self._station(computer.name)]
        station_log.crash_windows_ns.append((computer.disk.failing_since_ns(now_ns), now_ns))

    def _note_waiting_lines(self, computer: Computer) -> None:
        """Record that a daemon that is stopped while its disk fails leaves its disk as one that is killed does."""
        now_ns = self._true.monotonic_ns()
        if computer.disk.failing_since_ns(now_ns) == now_ns - UNWRITTEN_WINDOW_NS:
            return
        if computer.name == MASTER:
            self.master_logs[-1].crashed = True
        else:
            self._record_crash_window(computer)

    async def suspend_master(self, for_s: float) -> None:
        """Suspend the master's computer; no effect on one that is down."""
        computer = self.computers[MASTER]
        if computer.is_down or computer.is_suspended:
            return
        resume = computer.suspend()
        await asyncio.sleep(for_s)
        self._note_waiting_lines(computer)  # The daemon begins anew
        resume()

    async def suspend(self, station: int, for_s: float) -> None:
        """Suspend a station's computer, whose instrument's responses are lost meanwhile; no effect on one that is down."""
        computer, line = self._computer(station), self.lines[station]
        if computer.is_down or computer.is_suspended:
            return
        line.faults.drop_responses = True
        # What was read before and not written yet is written after it, unless a kill prevents it.
        self._record_crash_window(computer)
        resume = computer.suspend()
        await asyncio.sleep(for_s)
        line.faults.drop_responses = False
        self._record_crash_window(computer)
        resume()

    async def make_mistake(self, station: int, mistake: SetupMistake, until_s: float) -> None:
        """Restart a station's client with a mistake in its set-up, and at a true time in s from the start with the right one."""
        if station in self.mistakes or self._computer(station).is_down:
            return
        self.mistakes[station] = mistake
        await self.restart(station, self.now_s)
        await self.sleep_until(until_s)
        del self.mistakes[station]
        await self.restart(station, self.now_s)

    async def edit_master(self, edit: MasterEdit, until_s: float) -> None:
        """Restart the master with another configuration, and at a true time in s from the start with its own one."""
        if self.edit is not NO_EDIT or self.computers[MASTER].is_down:
            return
        self.edit = edit
        await self.restart(None, self.now_s)
        await self.sleep_until(until_s)
        self.edit = NO_EDIT
        await self.restart(None, self.now_s)

    async def _record_status(self, name: str) -> None:
        """Record a client's status before it ends."""
        for number, station_log in self.station_logs.items():
            if name == station_name(number) and (status := await station_log.client_status()) is not None:
                station_log.statuses.append(status)

    async def restart(self, station: int | None, at_s: float) -> None:
        """Stop a client (None: the master) at a true time in s from the start, and restart it.

        Later if it is down, or its computer is suspended.
        """
        await self.sleep_until(at_s)
        name = MASTER if station is None else station_name(station)
        computer = self.computers[name]
        while computer.is_down or computer.is_suspended:  # noqa: ASYNC110 (waits in virtual time)
            await asyncio.sleep(RESTART_DELAY_S)
        computer.is_down = True
        self._note_waiting_lines(computer)
        await self.stop(name)
        await asyncio.sleep(RESTART_DELAY_S)
        computer.is_down = False
        self._start(name)

    def _start(self, name: str) -> None:
        if name == MASTER:
            self.start_master()
        else:
            self.start_station(self._station(name))

    def _station(self, name: str) -> int:
        return next(number for number in self.station_logs if station_name(number) == name)

    async def reboot(self, station: int, at_s: float, off_s: float) -> None:
        """Power a station's computer off and on: CLOCK_MONOTONIC restarts at zero, the Unix clock continues where it stopped.

        No effect on one that is down or suspended.
        """
        await self.sleep_until(at_s)
        computer = self._computer(station)
        if computer.is_down or computer.is_suspended:
            return
        computer.is_down = True
        await self.stop(computer.name)
        self._record_crash_window(computer)
        unix_ns = computer.clock.realtime_ns()
        await self.sleep_until(at_s + off_s)
        computer.is_down = False
        now_ns = self._true.monotonic_ns()
        computer.clock = self._station_clock(station, offset_ns=unix_ns - START_UNIX_NS, booted_ns=now_ns)
        self.lines[station] = self._line(station)
        self._boots[station] += 1
        computer.suspended_ns = 0
        self.start_station(station)

    def move_station(self, station: int, shift_m: Sequence[float], turn_rad: float) -> None:
        """Shift a station's levelled instrument along the axes of station 1's first frame and turn it about the vertical."""
        entry = self._placed[station]
        x, y, z = (float(at + by) for at, by in zip(entry.position_m, shift_m, strict=True))
        update = {"position_m": (x, y, z), "yaw_deg": entry.yaw_deg + math.degrees(turn_rad)}
        moved = self._placed[station] = entry.model_copy(update=update)
        self.instruments[station].set_up_at(moved)
        self.moves.append(StationMove(station, self.now_s, level_frame(moved)))

    async def recalibrate(self) -> None:
        """Restart the master with the stations' true frames."""
        frames = {number: level_frame(entry) for number, entry in self._placed.items()}
        stations = [
            replace(each, T_station1_station=frames[each.station]) for each in self.parameters.stations
        ]
        self.parameters = replace(self.parameters, stations=tuple(stations))
        await self.restart(None, self.now_s)

    def stream_socket(self) -> Path:
        """Return the stream socket of the current or last master."""
        return master_config(
            self._scenario, self._options, self._folder / f"master{len(self.master_logs) - 1}"
        ).stream.socket

    async def apply_outage(self, outage: Outage) -> None:
        """Interrupt the radio contact between the master and the stations of an outage."""
        for at_s in (outage.start_s, outage.end_s):
            await self.sleep_until(at_s)
            for station in outage.stations:
                hidden = any(station in o.stations and o.covers(at_s) for o in self._options.outages)
                self.air.link.set_attenuation(MASTER, station_name(station), _OUTAGE_DB if hidden else 0.0)

    async def stop_all(self) -> None:
        """Stop all daemons, the master first, so that it reports no lost stations."""
        for name in self.computers:
            if self.computers[name].task is not None:
                await self.stop(name)
