"""The master's daemon: radio in, poses out.

One task group holds everything: the radio with its link to the stations, the timer of the poses, the status of each
second, the disk. What is spoken over the radio is a matter of the link (:mod:`tsgt.master.classic.link`,
:mod:`tsgt.master.superframe.link`), what leaves the program one of :mod:`tsgt.master.publisher`; here they are connected
with radio, socket, disk and time.
"""

from __future__ import annotations

import asyncio
import secrets
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, NoReturn, Protocol

import structlog

import tsgt
from tsgt import service
from tsgt.clock import UnixTimeline
from tsgt.config import ClassicMasterConfig
from tsgt.errors import RadioError, StreamError
from tsgt.estimation import Feed
from tsgt.master.classic import ClassicLink
from tsgt.master.geofence import Geofence, run_fence_command
from tsgt.master.layout_monitor import FrameWatch
from tsgt.master.publisher import Outlet, Reports
from tsgt.master.reacquisition_hints import Searches
from tsgt.master.recording_thread import Disk
from tsgt.master.station_events import Alerts
from tsgt.master.statistics import Monitor
from tsgt.master.stream_server import StreamServer
from tsgt.master.superframe import SuperframeLink
from tsgt.radio.supervisor import supervise_radio
from tsgt.recording import (
    EventRecord,
    HelloRecord,
    PoseRecord,
    RecordingHeader,
    RecordingWriter,
    encode_line,
    new_recording_path,
)
from tsgt.recording.recorder import Recorder

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Sequence

    from tsgt.clock import Clock
    from tsgt.config import FrameWatchConfig, GeofenceConfig, MasterConfig
    from tsgt.master.publisher import Watcher
    from tsgt.model import Measurement, Parameters
    from tsgt.radio import LoRaSettings, RadioOpener, Radio
    from tsgt.recording import StatusRecord

STATUS_PERIOD_NS = 1_000_000_000

STUCK_NS = 60_000_000_000
"""No turn takes so long, not even a first synchronisation over a bad link; systemd then starts the master anew."""

log = structlog.get_logger()


async def run_master(
    config: MasterConfig,
    parameters: Parameters,
    settings: LoRaSettings,
    *,
    open_radio: RadioOpener,
    clock: Clock,
    key: bytes | None = None,
    random_bits: Callable[[int], int] = secrets.randbits,
    observe: Callable[[object, bytes], None] = lambda _record, _line: None,
    write: Callable[[int, memoryview], int] | None = None,
) -> None:
    """Collect, compute, stream and record until cancelled.

    Parameters
    ----------
    config
        Of the master.
    parameters
        What the set-up files and the configuration come to.
    settings
        Of the modem.
    open_radio
        Opens the radio, as often as it takes.
    clock
        Time; the radio's.
    key
        That of ``protocol.key_file``; None: there is none, and anybody can take part.
    random_bits
        Returns so many random bits: for nonces.
    observe
        Sees every record that goes out with its line, in their order: for simulations and tests.
    write
        See :class:`~tsgt.recording.RecordingWriter`.

    Raises
    ------
    RecordingError
        The recording cannot be opened.
    StreamError
        The socket cannot be opened.
    """
    timeline = UnixTimeline.fixed_now(clock)
    start_ns = timeline.unix_ns(clock.monotonic_ns())
    path = new_recording_path(config.recording.directory, "master", start_ns)
    with RecordingWriter(path, write=write) as writer:
        recorder = Recorder(writer)
        disk = Disk(recorder)

        def hand_out(record: object, line: bytes) -> None:
            disk.put(line)
            server.publish(line)
            observe(record, line)

        header = RecordingHeader(
            software=f"tsgt {tsgt.__version__}", created_ns=start_ns, source="tsgt-master"
        )
        recorder.put(encode_line(header))
        recorder.put(encode_line(parameters))
        server = StreamServer(
            config.stream.socket,
            encode_line(HelloRecord()),
            mode=int(config.stream.mode, 8),
            queue_lines=config.stream.queue_lines,
            unix_now_ns=lambda: timeline.unix_ns(clock.monotonic_ns()),
        )
        try:
            async with server, asyncio.TaskGroup() as group:
                master = _Master(config, parameters, clock, timeline, hand_out, group)
                link = _link(
                    config, parameters, settings, disk, master.reports, key=key, random_bits=random_bits
                )
                log.info("master_started", recording=str(path), stations=len(config.stations))
                service.sd_notify("READY=1")
                group.create_task(disk.run())
                group.create_task(service.sync_periodically(writer.sync, clock, config.recording.fsync_interval_s))
                group.create_task(master.keep_time())
                group.create_task(master.report(link))
                group.create_task(master.watchdog(link))
                group.create_task(supervise_radio(master.watched(open_radio), link.run, clock))
        finally:
            service.sd_notify("STOPPING=1")
            recorder.close()
            log.info("master_stopped")


class Link(Protocol):
    """A protocol as the master runs it: reports what the stations send."""

    @property
    def turn_ns(self) -> int | None:
        """Since when the present turn with a station, or frame with all, lasts; None without a radio."""
        ...

    def status(self, now_ns: int) -> StatusRecord:
        """Report how the link and its stations do at an instant on the master's Unix clock."""
        ...

    async def run(self, radio: Radio) -> None:
        """Use a radio for as long as it works."""
        ...


def _link(
    config: MasterConfig,
    parameters: Parameters,
    settings: LoRaSettings,
    disk: Disk,
    reports: Reports,
    *,
    key: bytes | None,
    random_bits: Callable[[int], int],
) -> Link:
    protocol = config.protocol
    if isinstance(protocol, ClassicMasterConfig):
        return ClassicLink(config.stations, protocol, settings, reports)
    return SuperframeLink(
        config.stations,
        protocol,
        settings,
        disk,
        reports,
        Searches(parameters),
        key=key,
        random_bits=random_bits,
    )


class _Master:
    """The connected parts, and the tasks that move them."""

    def __init__(
        self,
        config: MasterConfig,
        parameters: Parameters,
        clock: Clock,
        timeline: UnixTimeline,
        hand_out: Callable[[object, bytes], None],
        group: asyncio.TaskGroup,
    ) -> None:
        self._clock = clock
        stations = [station.station for station in config.stations]
        monitor = Monitor(stations)
        alerts = Alerts(stations, timeline.unix_ns(clock.monotonic_ns()))
        watchers: list[Watcher] = [
            _FrameWatcher(config.frame_watch, parameters),
            *(_Fence(fence, group) for fence in config.geofences),
        ]
        self._outlet = Outlet(parameters, monitor, watchers, self._logged(hand_out))
        self.reports = Reports(clock, timeline, self._outlet, monitor, alerts)
        self._radio_failed = False

    # --- Time ---------------------------------------------------------------------------------------------------

    async def keep_time(self) -> NoReturn:
        """Send poses when they are due and no measurement brings them."""
        while True:
            deadline_ns = self._outlet.next_deadline_ns()
            wait_s = None if deadline_ns is None else max(0, deadline_ns - self.reports.now_ns()) / 1e9
            try:
                async with asyncio.timeout(wait_s):
                    await self._outlet.changed()
            except TimeoutError:
                self._outlet.advance(self.reports.now_ns())

    async def report(self, link: Link) -> NoReturn:
        """Send a status each second, and what time has brought."""
        next_ns = self._clock.monotonic_ns()
        while True:
            next_ns = max(next_ns + STATUS_PERIOD_NS, self._clock.monotonic_ns())
            await self._clock.sleep_until(next_ns)
            now_ns = self.reports.now_ns()
            self.reports.events(self.reports.alerts.tick(now_ns, unix_ns=self._clock.realtime_ns()))
            status = link.status(now_ns)
            self._outlet.put(status)
            heard = sum(s.last_heard_s is not None and s.last_heard_s < 5 for s in status.stations)
            service.sd_notify(
                f"STATUS={heard} of {len(status.stations)} stations heard, "
                f"{status.valid_poses} of {status.poses} poses valid"
            )

    async def watchdog(self, link: Link) -> None:
        """Tell systemd that this program lives, as often as it wants, unless its turns have come to a standstill."""
        interval_s = service.watchdog_interval_s()
        while interval_s is not None:
            turn_ns, now_ns = link.turn_ns, self.reports.now_ns()
            if turn_ns is not None and now_ns - turn_ns > STUCK_NS:
                log.error("scheduler_stalled", for_s=(now_ns - turn_ns) / 1e9)
            else:
                service.sd_notify("WATCHDOG=1")
            await self._clock.sleep_until(self._clock.monotonic_ns() + round(interval_s * 1e9))

    # --- Radio --------------------------------------------------------------------------------------------------

    def watched(self, open_radio: RadioOpener) -> RadioOpener:
        """Tell the stream when the radio fails, and when it is back."""

        @asynccontextmanager
        async def opened() -> AsyncGenerator[Radio]:
            try:
                async with open_radio() as radio:
                    if self._radio_failed:
                        self._radio_failed = False
                        self.reports.event("radio_recovered", "the radio of the master works again")
                    yield radio
            except (RadioError, StreamError) as error:
                if not self._radio_failed:
                    self._radio_failed = True
                    self.reports.event("radio_failed", f"no station can be asked: {error}")
                raise

        return opened

    @staticmethod
    def _logged(hand_out: Callable[[object, bytes], None]) -> Callable[[object, bytes], None]:
        """Put events into the log as well: there they are found without a reader of the stream."""

        def logged(record: object, line: bytes) -> None:
            if isinstance(record, EventRecord):
                log.info("stream_event", name=record.event, message=record.message)
            hand_out(record, line)

        return logged


class _FrameWatcher:
    """The watch over the frames, as one that knows no time; it has the poses of the estimator ``linear`` in any case."""

    def __init__(self, config: FrameWatchConfig, parameters: Parameters) -> None:
        self._watch = FrameWatch(config, parameters.pipeline.period_ns)
        self._linear: Feed | None = None  # of its own, unless those that go out are the same
        if parameters.pipeline.estimator != "linear":
            pipeline = replace(parameters.pipeline, estimator="linear")
            self._linear = Feed(replace(parameters, pipeline=pipeline))

    def pose(self, record: PoseRecord, now_ns: int) -> Sequence[EventRecord]:
        return self._watch.pose(record, now_ns) if self._linear is None else ()

    def measurement(self, record: Measurement) -> Sequence[EventRecord]:
        if self._linear is None:
            return ()
        poses = (found for found in self._linear.measurement(record) if isinstance(found, PoseRecord))
        return [event for pose in poses for event in self._watch.pose(pose, record.received_ns)]

    def tick(self, now_ns: int) -> Sequence[EventRecord]:  # noqa: ARG002 (nothing runs out)
        return ()

    def next_deadline_ns(self) -> None:
        return None


class _Fence:
    """A geo-fence with the command that is run at its crossings."""

    def __init__(self, config: GeofenceConfig, group: asyncio.TaskGroup) -> None:
        self._fence = Geofence(config)
        self._config = config
        self._group = group

    def pose(self, record: PoseRecord, now_ns: int) -> Sequence[EventRecord]:
        return self._acted_on(self._fence.pose(record, now_ns))

    def measurement(self, record: Measurement) -> Sequence[EventRecord]:
        return self._fence.measurement(record)

    def tick(self, now_ns: int) -> Sequence[EventRecord]:
        return self._acted_on(self._fence.tick(now_ns))

    def next_deadline_ns(self) -> int | None:
        return self._fence.next_deadline_ns()

    def _acted_on(self, events: Sequence[EventRecord]) -> Sequence[EventRecord]:
        if self._config.command:
            for event in events:
                command = run_fence_command(self._config.command, event=event.event, fence=self._config.name)
                try:
                    self._group.create_task(command)
                except RuntimeError:  # the master is ending, and starts nothing any more
                    command.close()
        return events
