"""The master's daemon: radio in, poses out.

One task group holds everything: the radio with the turns of the stations, the timer of the poses, the status of
each second, the disk. What happens is decided in the pure parts (:mod:`tsgt.master.scheduler`,
:mod:`tsgt.master.intake`, :mod:`tsgt.master.outlet`); here they are connected with radio, socket, disk and time.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, NoReturn

import structlog

import tsgt
from tsgt import service
from tsgt.clock import UnixTimeline
from tsgt.errors import RadioError, StreamError
from tsgt.master.alerts import Alerts
from tsgt.master.clock_offset import clock_filter
from tsgt.master.collector import Collector
from tsgt.master.fence_command import run_fence_command
from tsgt.master.frame_watch import FrameWatch
from tsgt.master.geofence import Geofence
from tsgt.master.intake import Intake
from tsgt.master.monitor import Monitor
from tsgt.master.outlet import Outlet
from tsgt.master.scheduler import Cadence, Scheduler, StationPlan
from tsgt.master.stream import StreamServer
from tsgt.master.stream_records import EventRecord, HelloRecord
from tsgt.radio.classic import Ordered, Poll, Synchronisation, Timing
from tsgt.radio.supervised import keep_radio
from tsgt.recording import RecordingHeader, RecordingWriter, encode_line
from tsgt.recording.files import new_recording_path
from tsgt.recording.recorder import Recorder

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Sequence

    from tsgt.clock import Clock
    from tsgt.config import MasterConfig
    from tsgt.config.master import FrameWatchConfig, GeofenceConfig
    from tsgt.master.outlet import Watcher
    from tsgt.master.scheduler import Task
    from tsgt.master.stream_records import PoseRecord
    from tsgt.model import Parameters, PolarMeasurement
    from tsgt.radio.base import LoRaSettings, OpenRadio, Packet, Radio

STATUS_PERIOD_NS = 1_000_000_000

STUCK_NS = 60_000_000_000
"""No turn takes so long, not even a first synchronisation over a bad link; systemd then starts the master anew."""

log = structlog.get_logger()


async def run_master(
    config: MasterConfig,
    parameters: Parameters,
    settings: LoRaSettings,
    *,
    open_radio: OpenRadio,
    clock: Clock,
    observe: Callable[[object], None] = lambda _record: None,
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
    observe
        Sees every record that goes out, in their order: for simulations and tests.

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
    with RecordingWriter(path) as writer:
        recorder, unwritten = Recorder(writer), asyncio.Event()

        def hand_out(record: object, line: bytes) -> None:
            recorder.put(line)
            unwritten.set()
            server.publish(line)
            observe(record)

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
                master = _Master(config, parameters, settings, clock, timeline, hand_out, group)
                log.info("master_started", recording=str(path), stations=len(config.stations))
                service.sd_notify("READY=1")
                group.create_task(_write(recorder, unwritten))
                group.create_task(service.keep_synced(writer.sync, clock, config.recording.fsync_interval_s))
                group.create_task(master.keep_time())
                group.create_task(master.report())
                group.create_task(master.watchdog())
                group.create_task(keep_radio(master.watched(open_radio), master.collect, clock))
        finally:
            service.sd_notify("STOPPING=1")
            recorder.close()
            log.info("master_stopped")


async def _write(recorder: Recorder, unwritten: asyncio.Event) -> NoReturn:
    """Write lines in a thread: a disk that takes its time must not keep the radio waiting."""
    while True:
        await unwritten.wait()
        unwritten.clear()
        await asyncio.to_thread(recorder.flush)


class _Master:
    """The connected parts, and the tasks that move them."""

    def __init__(
        self,
        config: MasterConfig,
        parameters: Parameters,
        settings: LoRaSettings,
        clock: Clock,
        timeline: UnixTimeline,
        hand_out: Callable[[object, bytes], None],
        group: asyncio.TaskGroup,
    ) -> None:
        self._clock = clock
        self._timeline = timeline
        now_ns = self._now_ns()
        protocol = config.protocol
        self._prisms = {station.station: station.prism for station in config.stations}
        delays_ns = {station.station: round(station.stamp_delay_ms * 1e6) for station in config.stations}
        self._timing = Timing.of(settings, round(protocol.reply_timeout_ms * 1e6))
        self._scheduler = Scheduler(
            [
                StationPlan(
                    station=station.station,
                    prism=station.prism,
                    stamp_delay_ns=delays_ns[station.station],
                )
                for station in config.stations
            ],
            _cadence(config),
            self._timing,
            now_ns,
        )
        self._intake = Intake(self._prisms, lambda: clock_filter(protocol.clock_filter), delays_ns)
        self._monitor = Monitor(self._prisms, self._intake.clock)
        self._alerts = Alerts(self._prisms, now_ns)
        watchers: list[Watcher] = [
            _FrameWatcher(config.frame_watch, parameters.pipeline.period_ns),
            *(_Fence(fence, group) for fence in config.geofences),
        ]
        self._outlet = Outlet(parameters, self._monitor, watchers, self._logged(hand_out))
        self._radio_failed = False
        self._turn_ns: int | None = None  # since when there has been a turn; None without a radio

    # --- Time ---------------------------------------------------------------------------------------------------

    async def keep_time(self) -> NoReturn:
        """Send poses when they are due and no measurement brings them."""
        while True:
            deadline_ns = self._outlet.next_deadline_ns()
            wait_s = None if deadline_ns is None else max(0, deadline_ns - self._now_ns()) / 1e9
            try:
                async with asyncio.timeout(wait_s):
                    await self._outlet.changed()
            except TimeoutError:
                self._outlet.advance(self._now_ns())

    async def report(self) -> NoReturn:
        """Send a status each second, and what time has brought."""
        next_ns = self._clock.monotonic_ns()
        while True:
            next_ns = max(next_ns + STATUS_PERIOD_NS, self._clock.monotonic_ns())
            await self._clock.sleep_until(next_ns)
            now_ns = self._now_ns()
            self._put(self._alerts.tick(now_ns, unix_ns=self._clock.realtime_ns()))
            status = self._monitor.status(now_ns)
            self._outlet.put(status)
            heard = sum(s.last_heard_s is not None and s.last_heard_s < 5 for s in status.stations)
            service.sd_notify(
                f"STATUS={heard} of {len(status.stations)} stations heard, "
                f"{status.valid_poses} of {status.poses} poses valid"
            )

    async def watchdog(self) -> None:
        """Tell systemd that this program lives, as often as it wants, unless its turns have come to a standstill."""
        interval_s = service.watchdog_interval_s()
        while interval_s is not None:
            if self._turn_ns is not None and self._now_ns() - self._turn_ns > STUCK_NS:
                log.error("turns_stuck", for_s=(self._now_ns() - self._turn_ns) / 1e9)
            else:
                service.sd_notify("WATCHDOG=1")
            await self._clock.sleep_until(self._clock.monotonic_ns() + round(interval_s * 1e9))

    # --- Radio --------------------------------------------------------------------------------------------------

    def watched(self, open_radio: OpenRadio) -> OpenRadio:
        """Tell the stream when the radio fails, and when it is back."""

        @asynccontextmanager
        async def opened() -> AsyncGenerator[Radio]:
            try:
                async with open_radio() as radio:
                    if self._radio_failed:
                        self._radio_failed = False
                        self._put([self._event("radio_back", "the radio of the master works again")])
                    yield radio
            except (RadioError, StreamError) as error:
                if not self._radio_failed:
                    self._radio_failed = True
                    self._put([self._event("radio_failed", f"no station can be asked: {error}")])
                raise

        return opened

    async def collect(self, radio: Radio) -> None:
        """Take turns with the stations, for as long as the radio does."""
        collector = Collector(radio, self._clock, self._timeline, self._timing)
        try:
            while True:
                self._turn_ns = self._now_ns()
                turn = self._scheduler.next(self._turn_ns)
                if isinstance(turn, int):
                    await self._clock.sleep_until(self._timeline.monotonic_ns(turn))
                    continue
                await collector.take(turn)
                self._finished(turn, collector)
        finally:
            self._turn_ns = None

    def _finished(self, turn: Task, collector: Collector) -> None:
        now_ns, station = self._now_ns(), turn.station
        self._scheduler.finished(turn, now_ns)
        answered = turn.ok is not None if isinstance(turn, Ordered) else turn.answered
        self._monitor.asked(station, answered=answered)
        self._put(self._alerts.asked(station, now_ns, answered=answered))
        if not answered or collector.last is None:
            self._intake.unanswered(station)
            return
        self._monitor.heard(station, now_ns, rssi_dbm=collector.last.rssi_dbm, snr_db=collector.last.snr_db)
        if isinstance(turn, Ordered):
            prism = self._prisms[station]
            self._monitor.tracks(station, prism if turn.ok else None)
            self._put(self._alerts.ordered(station, prism, now_ns, tracks=bool(turn.ok)))
        elif isinstance(turn, Synchronisation) and turn.samples:
            found = self._intake.synchronised(station, turn.samples, now_ns)
            if found.stepped:
                self._put(self._alerts.stepped(station, now_ns))
            self._outlet.put(found.record)
            for measurement in found.measurements:
                self._measured(measurement)
        elif isinstance(turn, Poll):
            self._polled(turn, collector.last, collector.requested_ns)

    def _polled(self, poll: Poll, packet: Packet, requested_ns: int) -> None:
        if poll.message is None:
            return
        self._put(self._alerts.polled(poll.station, self._now_ns()))
        arrival = self._intake.answered(
            poll.message,
            requested_ns=requested_ns,
            received_ns=self._timeline.unix_ns(packet.received_at_ns),
        )
        if arrival.measurement is not None:
            self._measured(arrival.measurement)
        if arrival.doubtful:
            self._scheduler.resynchronise(poll.station, self._now_ns())
        if arrival.stepped:
            self._put(self._alerts.stepped(poll.station, self._now_ns()))

    def _measured(self, measurement: PolarMeasurement) -> None:
        self._outlet.measurement(measurement)
        self._put(self._alerts.measurement(measurement, self._now_ns()))

    # --- Small things -------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())

    def _put(self, events: Sequence[EventRecord]) -> None:
        for event in events:
            self._outlet.put(event)

    def _event(self, event: str, message: str) -> EventRecord:
        return EventRecord(stamp_ns=self._now_ns(), event=event, message=message)

    @staticmethod
    def _logged(hand_out: Callable[[object, bytes], None]) -> Callable[[object, bytes], None]:
        """Put events into the log as well: there they are found without a reader of the stream."""

        def logged(record: object, line: bytes) -> None:
            if isinstance(record, EventRecord):
                log.info("stream_event", name=record.event, message=record.message)
            hand_out(record, line)

        return logged


class _FrameWatcher:
    """The watch over the frames, as one that knows no time."""

    def __init__(self, config: FrameWatchConfig, period_ns: int) -> None:
        self._watch = FrameWatch(config, period_ns)

    def pose(self, record: PoseRecord, now_ns: int) -> Sequence[EventRecord]:
        return self._watch.pose(record, now_ns)

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


def _cadence(config: MasterConfig) -> Cadence:
    protocol = config.protocol
    interval_ns = round(protocol.resync_interval_s * 1e9)
    cadence = Cadence(
        initial_cycles=protocol.initial_cycles,
        resync_cycles=protocol.resync_cycles,
        interval_ns=interval_ns,
    )
    if protocol.clock_filter == "paper":  # which knows no frequency that it could learn sooner
        return replace(cadence, first_interval_ns=interval_ns)
    return cadence
