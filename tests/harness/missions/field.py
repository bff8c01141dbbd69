"""A master and three stations on a simulated channel, on virtual time; the stations track the robot of a scene."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NoReturn, TypeVar

import numpy as np
from harness.drives.scene import START, stationary_scene
from harness.hardware.radios import PAPER, running_timeline

from tsgt.clock import UnixTimeline
from tsgt.config import (
    ClassicMasterConfig,
    MasterConfig,
    RecordingConfig,
    SetupConfig,
    SimulatedRadioConfig,
    StationConfig,
    StreamConfig,
    SuperframeMasterConfig,
)
from tsgt.errors import InstrumentError
from tsgt.master.daemon import MasterDependencies, run_through_suspensions
from tsgt.model import Status
from tsgt.radio import DirectCommand, SearchCommand, TrackCommand
from tsgt.radio.classic import ClassicStation, MeasurementMessage, raw_status
from tsgt.radio.superframe import (
    COMPOSE_LEAD_NS,
    InstrumentState,
    QueuedMeasurement,
    SendQueue,
    SuperframeStation,
)
from tsgt.radio.superframe.wire import RESTART_SKIP, Authenticator, angle_code
from tsgt.recording import DiskStatus
from tsgt.simulation.kernel import DriftingClock, VirtualClock
from tsgt.simulation.lora import Air, LinkModel, radio_opener
from tsgt.simulation.mission.authors_node import AUTHORS_TIMESTAMP_DELAY_MS, AuthorsNode
from tsgt.station import Condition, Reading

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Coroutine
    from pathlib import Path
    from typing import Any

    from harness.drives.scene import Scene

    from tsgt.clock import Clock
    from tsgt.model import Parameters
    from tsgt.radio import Direction, Packet, Radio, RadioOpener
    from tsgt.radio.superframe import BeaconReception
    from tsgt.recording.journal import InstrumentRecord
    from tsgt.service import StartProgram
    from tsgt.station import Atmosphere

T = TypeVar("T")

STATIONS = (1, 2, 3)
PERIOD_NS = 400_000_000
DISK = DiskStatus(free_bytes=20_000_000_000, total_bytes=32_000_000_000)
KEY = bytes(range(32))
TRUE = VirtualClock(START)
"""True time and the master's clock; zero of the loop is the start of the scene."""


class SceneInstrument:
    """A total station that measures its prism of the scene without error at 2.5 Hz.

    Attributes
    ----------
    status
        Status of its measurements.
    refuses
        It refuses the command to track.
    direct_mode
        It was commanded to measure single targets.
    searches
        Search commands, with the true time.
    """

    def __init__(self, scene: Scene, station: int, clock: DriftingClock) -> None:
        self._scene = scene
        self._station = station
        self._clock = clock
        self.status = Status.OK
        self.refuses = False
        self.direct_mode = False
        self.searches: list[tuple[int, Direction]] = []

    async def connect(self) -> str:
        """Return its name."""
        return "scene"

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track, or refuse."""
        if towards is not None:
            self.searches.append((TRUE.monotonic_ns(), towards))
        if self.refuses:
            raise InstrumentError(f"no prism {prism}")
        self.direct_mode = False

    async def read(self) -> Reading:
        """Wait for the next measurement."""
        true_ns = (TRUE.monotonic_ns() // PERIOD_NS + 1) * PERIOD_NS + self._station
        await TRUE.sleep_until(true_ns)
        return self._reading(true_ns)

    async def direct(self) -> None:
        """Stop tracking."""
        self.direct_mode = True

    async def measure(self) -> Reading:
        """Measure once."""
        await asyncio.sleep(2.0)
        return self._reading(TRUE.monotonic_ns())

    async def check(self) -> None:
        """Succeed."""

    async def close(self) -> None:
        """Do nothing."""

    def host_clock_restarted(self) -> None:
        """Do nothing: its times are true ones."""

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Do nothing."""

    @property
    def condition(self) -> Condition:
        """Return an empty condition."""
        return Condition()

    @property
    def record(self) -> InstrumentRecord | None:
        """Return no record."""
        return None

    def _reading(self, true_ns: int) -> Reading:
        seen = self._scene.measure(self._station, true_ns / 1e9)
        return Reading(
            at_ns=self._clock.local_ns(true_ns),
            prism=self._station,
            horizontal_angle_rad=seen.horizontal_angle_rad,
            zenith_angle_rad=seen.zenith_angle_rad,
            slope_distance_m=seen.slope_distance_m,
            status=self.status,
        )


async def classic_client(station: int, radio: Radio, clock: DriftingClock, tool: SceneInstrument) -> NoReturn:
    """Run the client of a classic station."""
    timeline = UnixTimeline.fixed_now(clock)
    session = ClassicStation(station)

    async def read() -> NoReturn:
        while True:
            reading = await tool.read()
            session.measured(message(reading))

    def message(reading: Reading) -> MeasurementMessage:
        return MeasurementMessage(
            station=station,
            status=raw_status(reading.status),
            zenith_angle_rad=reading.zenith_angle_rad,
            horizontal_angle_rad=reading.horizontal_angle_rad,
            slope_distance_m=reading.slope_distance_m or 0.0,
            time_ns=timeline.unix_ns(reading.at_ns),
        )

    async def reply(packet: Packet) -> bytes | None:
        answer = session.received(packet.payload, timeline.unix_ns(packet.received_at_ns))
        if answer is None or isinstance(answer, bytes):
            return answer
        if isinstance(answer, TrackCommand):
            try:
                await tool.track(answer.prism or station)
            except InstrumentError:
                return session.executed(answer, ok=False)
            return session.executed(answer, ok=True)
        if isinstance(answer, DirectCommand):
            await tool.direct()
            return session.executed(answer, ok=True)
        return session.single_measured(message(await tool.measure()))

    async with asyncio.TaskGroup() as group:
        group.create_task(read())
        while True:
            answer = await reply(await radio.receive())
            if answer is not None:
                await radio.transmit(answer)


class Notebook:
    """What a superframe station keeps across restarts, like a journal.

    Attributes
    ----------
    send_queue
        Measurements that are not acknowledged.
    made_ns
        True time of each measurement, by sequence number.
    """

    def __init__(self) -> None:
        self.send_queue = SendQueue(0)
        self.made_ns: dict[int, int] = {}
        self.receptions: list[BeaconReception] = []

    def start(self) -> None:
        """Skip the sequence numbers that a torn journal may have lost."""
        if self.made_ns:
            first_sequence = max(self.made_ns) + 1 + RESTART_SKIP
            self.send_queue = SendQueue(first_sequence, reversed(list(self.send_queue.newest_first())))


async def superframe_client(
    number: int,
    radio: Radio,
    clock: DriftingClock,
    tool: SceneInstrument,
    notes: Notebook,
    rng: np.random.Generator,
) -> NoReturn:
    """Run the client of a superframe station."""
    notes.start()
    send_queue = notes.send_queue
    instrument_state = InstrumentState(prism=number, direct=tool.direct_mode, connected=True)
    station = SuperframeStation(
        number,
        PAPER,
        Authenticator(KEY),
        send_queue,
        stream_id=number,
        boot="boot",
        receptions=notes.receptions,
        random_bits=lambda bits: int(rng.integers(1 << bits)),
    )

    async def read() -> NoReturn:
        sequence = send_queue.first_sequence
        while True:
            reading = await tool.read()
            send_queue.add(
                QueuedMeasurement(
                    sequence=sequence,
                    at_ns=reading.at_ns,
                    boot="boot",
                    prism=reading.prism or number,
                    status=reading.status,
                    horizontal=angle_code(reading.horizontal_angle_rad),
                    zenith=angle_code(reading.zenith_angle_rad),
                    distance_m=reading.slope_distance_m,
                )
            )
            notes.made_ns[sequence] = TRUE.realtime_ns() - (TRUE.realtime_ns() - number) % PERIOD_NS
            sequence += 1

    async def execute_command() -> None:
        nonlocal instrument_state
        command = station.next_command()
        if isinstance(command, TrackCommand | SearchCommand):
            prism = (command.prism if isinstance(command, TrackCommand) else None) or instrument_state.prism
            try:
                await tool.track(prism, command.towards if isinstance(command, SearchCommand) else None)
            except InstrumentError:
                station.executed(ok=False)
            else:
                instrument_state = instrument_state._replace(prism=prism, direct=False)
                station.executed(ok=True)
        elif isinstance(command, DirectCommand):
            await tool.direct()
            instrument_state = instrument_state._replace(direct=True)
            station.executed(ok=True)

    async with asyncio.TaskGroup() as group:
        group.create_task(read())
        while True:
            received = station.received(await radio.receive())
            if received is not None and received.reception is not None:
                notes.receptions.append(received.reception)
            await execute_command()
            if received is None or received.slot_ns is None:
                continue
            await clock.sleep_until(received.slot_ns - COMPOSE_LEAD_NS)
            reply = station.compose(instrument_state, clock.monotonic_ns())
            if reply is not None:
                station.sent(await radio.transmit(reply, at_ns=received.slot_ns))


@dataclass
class Station:
    """A station that can be killed and started.

    Attributes
    ----------
    clock
        Of its computer: an offset of seconds to hours, and 10 ppm of skew.
    notes
        What it keeps across restarts, with the superframe.
    """

    number: int
    air: Air
    scene: Scene
    authors: bool
    clock: DriftingClock
    superframe: bool = False
    notes: Notebook = field(default_factory=Notebook)
    _task: asyncio.Task[None] | None = None
    _starts: int = 0
    instrument: SceneInstrument = field(init=False)

    def __post_init__(self) -> None:
        self.instrument = SceneInstrument(self.scene, self.number, self.clock)

    def start(self) -> None:
        """Start its client."""
        self._starts += 1
        self._task = asyncio.create_task(self._run(), name=f"station-{self.number}")

    async def kill(self) -> None:
        """Kill its client."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])
            self._task = None

    async def _run(self) -> None:
        rng = np.random.default_rng((self.number, self._starts))
        async with radio_opener(self.air, f"station-{self.number}", self.clock, rng, PAPER)() as radio:
            if self.authors:
                await AuthorsNode(self.number, radio, self.clock, self.instrument, self.number, rng).run()
            if self.superframe:
                await superframe_client(self.number, radio, self.clock, self.instrument, self.notes, rng)
            await classic_client(self.number, radio, self.clock, self.instrument)


@dataclass
class Field:
    """A master and three stations."""

    folder: Path
    air: Air
    scene: Scene
    stations: dict[int, Station]
    disk: DiskStatus | None = DISK
    records: list[Any] = field(default_factory=list)
    atmospheric_ppm: float = 0.0  # as configured, of all stations
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(11))

    def config(self, **changes: Any) -> MasterConfig:
        """Return the master's configuration, with a short first synchronisation, or without phase lock."""
        changed = changes.pop("protocol", {})
        protocol: ClassicMasterConfig | SuperframeMasterConfig
        if self.stations[1].superframe:
            protocol = SuperframeMasterConfig(kind="superframe", **{"phase_lock": False} | changed)
        else:
            protocol = ClassicMasterConfig(kind="classic", **{"initial_cycles": 5} | changed)
        delay_ms = AUTHORS_TIMESTAMP_DELAY_MS if self.stations[1].authors else 0.0
        return MasterConfig(
            kind="master",
            setup=SetupConfig(station_frames=self.folder / "frames", prism_layout=self.folder / "prisms"),
            stations=tuple(
                StationConfig(
                    station=n,
                    prism=n,
                    prism_constant_mm=10.0,
                    timestamp_delay_ms=delay_ms,
                    atmospheric_ppm=self.atmospheric_ppm,
                )
                for n in STATIONS
            ),
            radio=SimulatedRadioConfig(
                kind="simulated",
                air_socket=self.folder / "air.sock",
                name="master",
                frequency_mhz=905.0,
                spreading_factor=9,
            ),
            protocol=protocol,
            stream=StreamConfig(socket=self.folder / "poses.sock"),
            recording=RecordingConfig(directory=self.folder / "recordings"),
            **changes,
        )

    def open_radio(self) -> RadioOpener:
        """Return the opener of the master's radio."""
        return radio_opener(self.air, "master", TRUE, np.random.default_rng(100), PAPER)

    async def master(
        self,
        config: MasterConfig | None = None,
        *,
        open_radio: RadioOpener | None = None,
        clock: Clock = TRUE,
        key: bytes | None = KEY,
        start_imu: StartProgram | None = None,
        parameters: Parameters | None = None,
        read_setup: Callable[[], Parameters] | None = None,
        suspended_ns: Callable[[], int] = lambda: 0,
    ) -> None:
        """Run the master until cancelled; published records are appended to :attr:`records`."""
        await run_through_suspensions(
            config or self.config(),
            parameters or self.scene.parameters,
            PAPER,
            MasterDependencies(
                open_radio=open_radio or self.open_radio(),
                clock=clock,
                key=key,
                random_bits=lambda bits: int(self.rng.integers(1 << bits)),
                start_imu=start_imu,
                read_setup=read_setup,
                suspended_ns=suspended_ns,
                disk_status=lambda _folder: self.disk,
                observe=lambda record, _line: self.records.append(record),
            ),
        )

    def of(self, cls: type[T]) -> list[T]:
        """Return the published records of one type."""
        return [record for record in self.records if isinstance(record, cls)]

    def recording(self) -> Path:
        """Return the last recording."""
        return max((self.folder / "recordings").iterdir())


@asynccontextmanager
async def field_of(
    folder: Path,
    scene: Scene | None = None,
    *,
    authors: bool = False,
    superframe: bool = False,
    link: LinkModel | None = None,
) -> AsyncGenerator[Field]:
    """Start three stations; kill them at the end."""
    air = Air(running_timeline(), np.random.default_rng(7), link or LinkModel())
    scene = scene or stationary_scene()
    offsets_s = {1: 0.3, 2: -7200.0, 3: 86_400.0}
    stations = {
        n: Station(
            n,
            air,
            scene,
            authors,
            DriftingClock(TRUE, offset_ns=int(offsets_s[n] * 1e9), drift_ppm=10.0),
            superframe=superframe,
        )
        for n in STATIONS
    }
    for station in stations.values():
        station.start()
    try:
        yield Field(folder, air, scene, stations)
    finally:
        for station in stations.values():
            await station.kill()


@asynccontextmanager
async def running(coroutine: Coroutine[Any, Any, None]) -> AsyncGenerator[asyncio.Task[None]]:
    """Run a task during the test, and cancel it at the end."""
    task = asyncio.create_task(coroutine)
    try:
        yield task
    finally:
        task.cancel()
        await asyncio.wait([task])
        if not task.cancelled():
            task.result()
