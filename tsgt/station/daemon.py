"""The client daemon of a station: reads the total station, journals every measurement, and replies to the master."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import structlog

import tsgt
from tsgt import service
from tsgt.clock import SuspensionWatch, UnixTimeline
from tsgt.errors import RecordingError
from tsgt.radio import Command, MeasureCommand
from tsgt.radio.superframe import UNKNOWN_CONDITION, InstrumentCondition, InstrumentState
from tsgt.radio.supervisor import supervise_radio
from tsgt.recording import RecordingHeader, RecordingWriter, decode, encode_line, new_recording_path
from tsgt.recording.journal import InstrumentRecord, JournalRecord
from tsgt.recording.recorder import Recorder
from tsgt.station.backlog import STREAM_ID_BITS, Backlog, read_backlog
from tsgt.station.control_socket import AtmosphereRequest, AtmosphereResponse, ControlSocket
from tsgt.station.instrument import Atmosphere
from tsgt.station.instrument_supervisor import CommandResult, InstrumentSupervisor, RequestedAtmosphere
from tsgt.station.journal import WRITE_TIMEOUT_S, JournalQueue
from tsgt.station.links import ClassicLink, SuperframeLink
from tsgt.station.session import ClientSession

if TYPE_CHECKING:
    from pathlib import Path
    from typing import NoReturn

    from tsgt.config import ClientConfig
    from tsgt.radio import LoRaSettings, Radio
    from tsgt.station.dependencies import ClientDependencies
    from tsgt.station.instrument import Reading
    from tsgt.station.links import Link
    from tsgt.station.status import ClientStatus

_SKIP_BITS = 22
"""Random bits added to a 32-bit sequence number: two streams of a thousand measurements collide once in 4000 times."""

log = structlog.get_logger()


async def run_client(config: ClientConfig, settings: LoRaSettings, dependencies: ClientDependencies) -> None:
    """Run a station's client until it is cancelled.

    Instrument, radio and disk may fail and recover; the other parts continue meanwhile. Raises RecordingError if the
    journal cannot be created: missing folder, no permission. Raises StreamError if the control socket cannot be
    created: another client serves it.
    """
    requested = RequestedAtmosphere()
    # Before a journal is made: a start that is refused, because another client serves the socket, leaves none.
    with ControlSocket(config.status_socket) as control_socket:
        while True:
            watch = SuspensionWatch(dependencies.suspended_ns)
            booted = replace(dependencies, boot=watch.boot(dependencies.boot))
            run = _run_until_suspended(config, settings, booted, watch, requested, control_socket)
            suspended = await service.until_suspended(run)
            log.warning("computer_resumed", for_s=round(suspended.for_s, 3))
            dependencies.instrument.host_clock_restarted()


async def _run_until_suspended(
    config: ClientConfig,
    settings: LoRaSettings,
    dependencies: ClientDependencies,
    watch: SuspensionWatch,
    requested: RequestedAtmosphere,
    control_socket: ControlSocket,
) -> None:
    """Run until cancelled. Raises ComputerSuspendedError after a resume: nothing then compares with times from before.

    All that is known of the clocks is made anew, as after a reboot; the backlog is in the journal. The requested
    atmosphere is kept.
    """
    clock, random_bits = dependencies.clock, dependencies.random_bits
    timeline = UnixTimeline.fixed_now(clock)
    now_ns = timeline.unix_ns(clock.monotonic_ns())
    backlog, write_timeout_s = Backlog(), None
    if config.protocol.kind == "superframe":
        backlog = read_backlog(config.journal.directory, config.station)
        if backlog.stream_id is None:
            backlog = replace(backlog, stream_id=random_bits(STREAM_ID_BITS))
    else:
        # A classic master polls for the newest measurement only: a delayed one is worthless to it.
        write_timeout_s = WRITE_TIMEOUT_S
    path = new_recording_path(config.journal.directory, f"station{config.station}", now_ns)
    with RecordingWriter(path, write=dependencies.write) as writer:
        recorder = Recorder(writer)
        journal = JournalQueue(recorder, write_timeout_s=write_timeout_s)
        header = RecordingHeader(
            software=f"tsgt {tsgt.__version__}",
            created_ns=now_ns,
            source=f"tsgt-client, station {config.station}",
        )
        recorder.write_line(encode_line(header))
        if backlog.stream_id is not None and recorder.failing:
            # Without a journal the next run could not know which sequence numbers this one has used. So this run starts a
            # stream of its own and leaves the backlog to the next run.
            backlog = Backlog(
                stream_id=random_bits(STREAM_ID_BITS),
                first_sequence=backlog.first_sequence + random_bits(_SKIP_BITS),
            )
        journal.write(
            JournalRecord(
                station=config.station,
                unix_at_zero_ns=timeline.unix_at_zero_ns,
                boot=dependencies.boot,
                stream_id=backlog.stream_id,
                first_sequence=backlog.first_sequence,
            )
        )
        # On disk before the first sequence number is used: after a power cut before the first regular sync the next run
        # would otherwise use the same numbers again.
        recorder.flush()
        with suppress(RecordingError):
            writer.sync()
        try:
            async with asyncio.TaskGroup() as group:
                client = _StationClient(
                    config,
                    settings,
                    dependencies,
                    watch,
                    requested,
                    timeline,
                    recorder,
                    journal,
                    path,
                    backlog,
                    group,
                )
                log.info("client_started", station=config.station, journal=str(path))
                group.create_task(journal.run())
                group.create_task(
                    service.sync_periodically(writer.sync, clock, config.journal.fsync_interval_s)
                )
                group.create_task(client.supervisor.run())
                group.create_task(supervise_radio(dependencies.open_radio, client.run_link, clock))
                group.create_task(control_socket.serve(client.status, client.handle_request))
                group.create_task(service.notify_systemd(client.status_line, clock))
        finally:
            recorder.close()
            log.info("client_stopped", station=config.station)


class _StationClient:
    """Connects instrument, journal and radio link."""

    def __init__(
        self,
        config: ClientConfig,
        settings: LoRaSettings,
        dependencies: ClientDependencies,
        watch: SuspensionWatch,
        requested: RequestedAtmosphere,
        timeline: UnixTimeline,
        recorder: Recorder,
        journal: JournalQueue,
        path: Path,
        backlog: Backlog,
        group: asyncio.TaskGroup,
    ) -> None:
        self._clock = dependencies.clock
        self._watch = watch
        self._timeline = timeline
        self._recorder = recorder
        self._journal = journal
        self._path = path
        self._radio_ok = False
        self._record: InstrumentRecord | None = None
        self._session = ClientSession(config.station, config.prism, backlog.first_sequence)
        self.supervisor = InstrumentSupervisor(
            dependencies.instrument,
            self._session,
            self._clock,
            on_reading=self._on_reading,
            on_record=self._on_record,
            on_result=self._on_result,
            requested=requested,
        )
        self._link: Link = (
            ClassicLink(
                self._session,
                self._clock,
                watch,
                timeline,
                on_command=self._on_command,
                create_task=group.create_task,
            )
            if backlog.stream_id is None
            else SuperframeLink(
                config.station,
                settings,
                dependencies,
                watch,
                timeline,
                backlog,
                stream_id=backlog.stream_id,
                instrument_state=self._instrument_state,
                on_command=self._on_command,
                write=journal.write,
            )
        )

    # --- Instrument -------------------------------------------------------------------------------------------

    def _on_reading(self, reading: Reading) -> None:
        self._watch.check()
        measurement = self._session.measurement(reading, self._timeline.unix_ns(reading.at_ns))
        self._journal.write(measurement, partial(self._link.offer, measurement))

    def _on_record(self, record: InstrumentRecord) -> None:
        self._watch.check()
        self._record = replace(record, stamp_ns=self._now_ns())
        self._journal.write(self._record)

    def _on_result(self, result: CommandResult) -> None:
        """Respond to a command; with a measurement only when that is journalled."""
        if not isinstance(result.command, MeasureCommand):
            if result.ok:
                self._session.apply(result.command)
            self._link.respond(result.command, ok=result.ok)
        elif result.reading is None:
            self._link.respond_single(None)
        else:
            self._watch.check()
            reading = result.reading
            target = self._session.single_measurement(reading, self._timeline.unix_ns(reading.at_ns))
            self._journal.write(target, partial(self._link.respond_single, target))

    # --- Radio ------------------------------------------------------------------------------------------------

    async def run_link(self, radio: Radio) -> NoReturn:
        """Reply to the master over this radio."""
        self._radio_ok = True
        try:
            await self._link.run(radio)
        finally:
            self._radio_ok = False

    def _on_command(self, command: Command) -> None:
        log.info("command_received", command=type(command).__name__)
        self.supervisor.submit(command)

    def _instrument_state(self) -> InstrumentState:
        return InstrumentState(
            prism=self._session.prism,
            direct=self._session.mode == "direct",
            connected=self.supervisor.description is not None,
            condition=self._instrument_condition(),
        )

    def _instrument_condition(self) -> InstrumentCondition:
        if self.supervisor.description is None:
            return UNKNOWN_CONDITION
        condition, settings = self.supervisor.condition, self._settings()
        return InstrumentCondition(
            battery_percent=condition.battery_percent,
            atmospheric_ppm=None if settings is None else settings.atmospheric_ppm,
            activity=condition.activity,
            problem=condition.problem,
        )

    # --- Control socket and systemd ---------------------------------------------------------------------------

    def status(self) -> ClientStatus:
        """Return the client's status."""
        return self._session.status(
            self._now_ns(),
            self._link.status(),
            instrument=self.supervisor.description,
            condition=self.supervisor.condition,
            settings=self._settings(),
            journal=str(self._path),
            journal_ok=not self._recorder.failing,
            journal_waiting=self._recorder.pending,
            journal_lost=self._recorder.lost,
            radio_ok=self._radio_ok,
        )

    def _settings(self) -> InstrumentRecord | None:
        return None if self.supervisor.description is None else self._record

    async def handle_request(self, line: bytes) -> AtmosphereResponse:
        """Carry out a request from the control socket."""
        try:
            request = decode(AtmosphereRequest, line)
        except ValueError as error:
            return AtmosphereResponse(problem=f"invalid request: {error}", settings=self._settings())
        problem = await self.supervisor.set_atmosphere(
            Atmosphere(temperature_c=request.temperature_c, pressure_hpa=request.pressure_hpa)
        )
        return AtmosphereResponse(problem=problem, settings=self._settings())

    def status_line(self) -> str:
        """Return the status in one line, for systemd."""
        status = self.status()
        instrument = "no instrument" if status.instrument is None else f"prism {status.prism}"
        if status.instrument is not None and status.mode == "direct":
            instrument = "single measurements"
        last = (
            "no measurement yet" if status.last is None else f"{status.last.status}, {status.rate_hz:.1f} Hz"
        )
        master = (
            "no packet from the master yet"
            if status.master_heard_s is None
            else f"master {status.master_heard_s:.0f} s ago"
        )
        parts = [instrument, last, master]
        if status.queued:
            parts.append(f"{status.queued} queued")
        if status.problem:
            parts.append(status.problem)
        if not status.radio_ok:
            parts.append("no radio")
        if not status.journal_ok:
            parts.append(f"disk fails: {status.journal_waiting} lines not written")
        if status.journal_lost:
            parts.append(f"{status.journal_lost} lines lost")
        return f"station {status.station}: {', '.join(parts)}"

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())
