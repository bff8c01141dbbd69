"""The master's daemon: receives measurements over the radio, publishes and records poses.

One task group owns every task: the radio with its link to the stations, the deadlines of the poses, the status of each
second, the recording.
"""

from __future__ import annotations

import asyncio
import secrets
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn, Protocol

import structlog

import tsgt
from tsgt import service
from tsgt.clock import SuspensionWatch, UnixTimeline, suspended_ns
from tsgt.config import ClassicMasterConfig
from tsgt.errors import ComputerSuspendedError, ConfigError, RadioError, StreamError
from tsgt.imu import Imu, WheelOdometry
from tsgt.master.alarms import Alarms
from tsgt.master.classic import ClassicLink
from tsgt.master.link_events import MasterEvent
from tsgt.master.monitors import (
    GeofenceObserver,
    ImuUseMonitor,
    OdometryUseMonitor,
    RecordingDisk,
    ShockMemory,
    disk_status,
    layout_monitor,
)
from tsgt.master.publisher import Observer, Publisher
from tsgt.master.reacquisition_hints import ReacquisitionHints
from tsgt.master.recording_thread import RecordingThread
from tsgt.master.reload import reloading, usable_setup
from tsgt.master.station_events import StationEventDetector
from tsgt.master.statistics import Statistics
from tsgt.master.stream_server import StreamServer
from tsgt.master.superframe import SuperframeLink
from tsgt.model import ImuSamples, OdometrySamples, PolarMeasurement
from tsgt.radio.supervisor import supervise_radio
from tsgt.recording import (
    EventRecord,
    HelloRecord,
    RecordingHeader,
    RecordingWriter,
    SetupGeofence,
    SetupRecord,
    encode_line,
    new_recording_path,
    read_target_checks,
)
from tsgt.recording.recorder import Recorder

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.config import MasterConfig
    from tsgt.estimation import StartCheck
    from tsgt.master.link_events import LinkStatus
    from tsgt.model import Parameters
    from tsgt.radio import LoRaSettings, Radio, RadioOpener
    from tsgt.recording import DiskStatus
    from tsgt.service import StartProgram

STATUS_PERIOD_NS = 1_000_000_000

STALL_TIMEOUT_NS = 60_000_000_000
"""An exchange or frame that lasts longer has stalled: a reply is waited for half as long at most. systemd then restarts the
master."""

log = structlog.get_logger()


@dataclass(frozen=True, kw_only=True)
class MasterDependencies:
    """What the master needs besides its configuration."""

    open_radio: RadioOpener  # opens the radio; called again after each failure
    clock: Clock  # the radio's
    key: bytes | None = None  # content of ``protocol.key_file``; None: the radio is not authenticated
    random_bits: Callable[[int], int] = secrets.randbits
    """Returns a random number of this many bits, for nonces."""
    observe: Callable[[object, bytes], None] = lambda _record, _line: None
    """Called with each published record and its line."""
    start_imu: StartProgram | None = None
    """Starts the program that reads the IMU; None: as a child process."""
    start_odometry: StartProgram | None = None
    """Starts the program that reads the wheel odometry, likewise."""
    read_setup: Callable[[], Parameters] | None = None
    """Reads the set-up files again, at the signal of :mod:`tsgt.master.reload`; raises ConfigError. None: the signal is not handled."""
    write: Callable[[int, memoryview], int] | None = None  # see :class:`~tsgt.recording.RecordingWriter`
    sync: Callable[[int], None] | None = None  # likewise
    disk_status: Callable[[Path], DiskStatus | None] = disk_status
    """Returns the space on the disk of a folder; called in a thread."""
    start_check: StartCheck | None = None
    """Starts a check of the IMU's set-up; None: in a thread of its own."""
    suspended_ns: Callable[[], int] = suspended_ns
    """Returns for how long the computer has been suspended since its start."""


async def run_through_suspensions(
    config: MasterConfig, parameters: Parameters, settings: LoRaSettings, dependencies: MasterDependencies
) -> None:
    """Run the master until cancelled. Raises as :func:`run_master`.

    After a suspension of the computer everything restarts: recording, session with the stations, timeline.
    """
    suspended: ComputerSuspendedError | None = None

    def keep(applied: Parameters) -> None:
        nonlocal parameters
        parameters = applied

    while True:
        suspended = await service.until_suspended(
            run_master(config, parameters, settings, dependencies, suspended, keep)
        )
        log.warning("computer_resumed", for_s=round(suspended.for_s, 3))
        if dependencies.read_setup is not None:
            with suppress(ConfigError):  # a file that is being edited: those in force before remain
                parameters = usable_setup(dependencies.read_setup)


async def run_master(
    config: MasterConfig,
    parameters: Parameters,
    settings: LoRaSettings,
    dependencies: MasterDependencies,
    suspended: ComputerSuspendedError | None = None,
    on_set_up: Callable[[Parameters], None] = lambda _: None,
) -> None:
    """Receive, compute, stream and record until cancelled; ``parameters`` are those in force.

    ``suspended``: the computer has just been suspended; an event says so. ``on_set_up`` is called with those that replace them.

    Raises RecordingError if the recording cannot be opened. Raises StreamError if the socket cannot be opened. Raises
    ComputerSuspendedError, in a group, after a suspension, before anything is published or recorded: times of CLOCK_MONOTONIC from
    before do not compare with later ones, and the timeline would be behind by the time of the suspension.
    """
    watch = SuspensionWatch(dependencies.suspended_ns)
    clock = dependencies.clock
    timeline = UnixTimeline.fixed_now(clock)

    def unix_now_ns() -> int:
        return timeline.unix_ns(clock.monotonic_ns())

    shocks = ShockMemory(config.recording.directory)
    parameters = shocks.recall(parameters)
    start_ns = unix_now_ns()
    server = StreamServer(
        config.stream.socket,
        encode_line(HelloRecord.of(parameters)),
        mode=int(config.stream.mode, 8),
        queue_lines=config.stream.queue_lines,
        unix_now_ns=unix_now_ns,
    )
    async with AsyncExitStack() as stack:
        # Before the recording is made: a start that is refused, because another master serves the socket, leaves none.
        await stack.enter_async_context(server)
        path = new_recording_path(config.recording.directory, "master", start_ns)
        checks = stack.enter_context(ThreadPoolExecutor(1, "imu_setup_check"))
        writer = stack.enter_context(RecordingWriter(path, write=dependencies.write, sync=dependencies.sync))
        recorder = Recorder(writer)
        recording = RecordingThread(recorder, unix_now_ns)
        header = RecordingHeader(
            software=f"tsgt {tsgt.__version__}", created_ns=start_ns, source="tsgt-master"
        )
        recorder.put(encode_line(header))
        recorder.put(encode_line(parameters))

        alarms = None if config.alarms is None else Alarms(config.alarms, clock, unix_now_ns)

        def emit(record: object, line: bytes) -> None:
            watch.check()
            if isinstance(record, EventRecord):
                log.info("stream_event", name=record.event, message=record.message)
                if alarms is not None:
                    alarms.take(record)
            recording.put(line, measurement=isinstance(record, PolarMeasurement))
            if not isinstance(record, ImuSamples | OdometrySamples):  # raw samples are for post-processing
                server.publish(line)
            dependencies.observe(record, line)

        try:
            async with asyncio.TaskGroup() as group:
                stations = [station.station for station in config.stations]
                lasting = [
                    OdometryUseMonitor(),
                    *(GeofenceObserver(geofence, group) for geofence in config.geofences),
                ]

                def observers(found: Parameters) -> list[Observer]:
                    return [layout_monitor(config.frame_watch, found), ImuUseMonitor(), *lasting]

                publisher = Publisher(
                    parameters,
                    Statistics(stations, read_target_checks(config.recording.directory)),
                    StationEventDetector(stations, start_ns),
                    observers(parameters),
                    emit,
                    unix_now_ns,
                    dependencies.start_check or (lambda work: checks.submit(work).result),
                )
                publisher.put(_setup_record(config, parameters, start_ns, path.name, dependencies.key))
                if parameters.no_poses is not None:
                    publisher.report(MasterEvent("setup_missing", f"no poses: {parameters.no_poses}"))
                if suspended is not None:
                    publisher.report(
                        MasterEvent("computer_resumed", f"the master has restarted: {suspended}")
                    )
                hints = ReacquisitionHints(parameters)
                link = _link(config, hints, settings, timeline, recording, publisher, dependencies)

                def set_up(found: Parameters) -> None:
                    on_set_up(found)
                    found = shocks.recall(found)
                    publisher.set_up(found, observers(found), recording.put)
                    hints.set_up(found)
                    server.greet_with(encode_line(HelloRecord.of(found)))
                    publisher.put(_setup_record(config, found, unix_now_ns(), path.name, dependencies.key))

                stack.enter_context(reloading(dependencies.read_setup, set_up, publisher.report))
                imu = _imu(config, timeline, publisher, shocks, dependencies)
                disk = RecordingDisk(recording, path, start_ns, dependencies.disk_status)
                odometry = _odometry(config, timeline, publisher, dependencies)
                master = _Master(clock, timeline, publisher, link, imu, odometry, disk)
                log.info("master_started", recording=str(path), stations=len(config.stations))
                service.sd_notify("READY=1")
                group.create_task(recording.run())
                group.create_task(
                    service.sync_periodically(recorder.sync, clock, config.recording.fsync_interval_s)
                )
                group.create_task(disk.measure_space(clock))
                group.create_task(master.publish_due_poses())
                group.create_task(master.publish_status())
                group.create_task(master.notify_watchdog())
                if alarms is not None:
                    group.create_task(alarms.run())
                if imu is not None:
                    group.create_task(imu.run())
                    group.create_task(shocks.run(clock))
                if odometry is not None:
                    group.create_task(odometry.run())
                radio_opener = master.with_radio_events(dependencies.open_radio)
                group.create_task(supervise_radio(radio_opener, link.run, clock))
        finally:
            service.sd_notify("STOPPING=1")
            recorder.close()
            log.info("master_stopped")


def _setup_record(
    config: MasterConfig, parameters: Parameters, stamp_ns: int, recording: str, key: bytes | None
) -> SetupRecord:
    return SetupRecord.of(
        parameters,
        stamp_ns,
        protocol=config.protocol.kind,
        authenticated=key is not None,
        geofences=(
            SetupGeofence(
                name=fence.name,
                allowed_side=fence.allowed_side,
                polygon_m=fence.polygon_m,
                margin_m=fence.margin_m,
            )
            for fence in config.geofences
        ),
        recording=recording,
    )


class Link(Protocol):
    """A protocol on the master's side; reports link events to the publisher."""

    @property
    def exchange_start_ns(self) -> int | None:
        """When the present exchange or frame began, on the master's Unix clock; None without a radio."""
        ...

    def status(self) -> LinkStatus:
        """Return what the status record states about the link."""
        ...

    async def run(self, radio: Radio) -> None:
        """Use a radio until it fails."""
        ...


def _link(
    config: MasterConfig,
    hints: ReacquisitionHints,
    settings: LoRaSettings,
    timeline: UnixTimeline,
    recording: RecordingThread,
    publisher: Publisher,
    dependencies: MasterDependencies,
) -> Link:
    protocol, clock = config.protocol, dependencies.clock
    if isinstance(protocol, ClassicMasterConfig):
        return ClassicLink(config.stations, protocol, settings, clock, timeline, publisher.report)
    return SuperframeLink(
        config.stations,
        protocol,
        settings,
        clock,
        timeline,
        publisher.report,
        recording,
        hints,
        key=dependencies.key,
        random_bits=dependencies.random_bits,
    )


def _imu(
    config: MasterConfig,
    timeline: UnixTimeline,
    publisher: Publisher,
    shocks: ShockMemory,
    dependencies: MasterDependencies,
) -> Imu | None:
    if config.imu is None:
        return None

    def take(samples: ImuSamples) -> None:
        publisher.imu_samples(samples)
        shocks.note(publisher.imu_shocks)

    return Imu(
        config.imu,
        dependencies.clock,
        timeline,
        on_samples=take,
        on_event=lambda event, message: publisher.report(MasterEvent(event, message)),
        start=dependencies.start_imu,
    )


def _odometry(
    config: MasterConfig, timeline: UnixTimeline, publisher: Publisher, dependencies: MasterDependencies
) -> WheelOdometry | None:
    if config.odometry is None:
        return None
    return WheelOdometry(
        config.odometry,
        dependencies.clock,
        timeline,
        on_samples=publisher.odometry_samples,
        on_event=lambda event, message: publisher.report(MasterEvent(event, message)),
        start=dependencies.start_odometry,
    )


class _Master:
    """The tasks of the master."""

    def __init__(
        self,
        clock: Clock,
        timeline: UnixTimeline,
        publisher: Publisher,
        link: Link,
        imu: Imu | None,
        odometry: WheelOdometry | None,
        disk: RecordingDisk,
    ) -> None:
        self._clock = clock
        self._timeline = timeline
        self._publisher = publisher
        self._link = link
        self._imu, self._odometry = imu, odometry
        self._disk = disk
        self._radio_failed = False

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())

    async def publish_due_poses(self) -> NoReturn:
        """Publish poses when they are due and no measurement completes them."""
        while True:
            deadline_ns = self._publisher.next_deadline_ns()
            wait_s = None if deadline_ns is None else max(0, deadline_ns - self._now_ns()) / 1e9
            try:
                async with asyncio.timeout(wait_s):
                    await self._publisher.changed()
            except TimeoutError:
                self._publisher.advance(self._now_ns())

    async def publish_status(self) -> NoReturn:
        """Publish a status record each second."""
        next_ns = self._clock.monotonic_ns()
        while True:
            next_ns = max(next_ns + STATUS_PERIOD_NS, self._clock.monotonic_ns())
            await self._clock.sleep_until(next_ns)
            for event in self._disk.events(self._now_ns()):
                self._publisher.report(event)
            status = self._publisher.publish_status(
                self._link.status(),
                None if self._imu is None else self._imu.status(),
                self._disk.recording_status(),
                self._disk.space,
                odometry=None if self._odometry is None else self._odometry.status(),
                realtime_ns=self._clock.realtime_ns(),
            )
            received = sum(s.last_heard_s is not None and s.last_heard_s < 5 for s in status.stations)
            service.sd_notify(
                f"STATUS={received} of {len(status.stations)} stations received, "
                f"{status.valid_poses} of {status.poses} poses valid"
            )

    async def notify_watchdog(self) -> None:
        """Notify systemd's watchdog at its interval, unless the link has stalled."""
        interval_s = service.watchdog_interval_s()
        while interval_s is not None:
            start_ns, now_ns = self._link.exchange_start_ns, self._now_ns()
            if start_ns is not None and now_ns - start_ns > STALL_TIMEOUT_NS:
                log.error("scheduler_stalled", for_s=(now_ns - start_ns) / 1e9)
            else:
                service.sd_notify("WATCHDOG=1")
            await self._clock.sleep_until(self._clock.monotonic_ns() + round(interval_s * 1e9))

    def with_radio_events(self, open_radio: RadioOpener) -> RadioOpener:
        """Publish an event when the radio fails, and when it has recovered."""

        @asynccontextmanager
        async def opened() -> AsyncGenerator[Radio]:
            try:
                async with open_radio() as radio:
                    if self._radio_failed:
                        self._radio_failed = False
                        self._publisher.report(
                            MasterEvent("radio_recovered", "the radio of the master works again")
                        )
                    yield radio
            except (RadioError, StreamError) as error:
                if not self._radio_failed:
                    self._radio_failed = True
                    message = f"the radio of the master failed, no station can be reached: {error}"
                    self._publisher.report(MasterEvent("radio_failed", message))
                raise

        return opened
