"""The client beside a total station: reads it, journals every measurement, answers the master over the radio."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import structlog

import tsgt
from tsgt import service
from tsgt.clock import UnixTimeline
from tsgt.errors import RecordingError
from tsgt.radio import MeasureOrder, Order
from tsgt.radio.superframe import Outbox, Situation, SuperframeStation
from tsgt.radio.superframe.wire import Authenticator
from tsgt.radio.supervisor import keep_radio
from tsgt.recording import RecordingHeader, RecordingWriter, decode, encode_line, new_recording_path
from tsgt.recording.journal import InstrumentRecord, JournalRecord
from tsgt.recording.recorder import Recorder
from tsgt.station.backlog import LINEAGE_BITS, Backlog, read_backlog
from tsgt.station.control_socket import Answer, AtmosphereRequest, StatusSocket
from tsgt.station.instrument import Atmosphere
from tsgt.station.instrument_supervisor import Done, InstrumentKeeper
from tsgt.station.journal import PATIENCE_S, JournalQueue
from tsgt.station.links import ClassicLink, SuperframeLink
from tsgt.station.session import Session

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from pathlib import Path
    from typing import Any, NoReturn

    from tsgt.clock import Clock
    from tsgt.config import ClientConfig
    from tsgt.radio import LoRaSettings, OpenRadio, Radio
    from tsgt.station.instrument import Instrument, Reading
    from tsgt.station.links import Link
    from tsgt.station.status import ClientStatus

_SKIP_BITS = 22
"""So many random bits of the 32 of a sequence number: a run of a thousand measurements meets another one in 4000."""

log = structlog.get_logger()


async def run_client(
    config: ClientConfig,
    settings: LoRaSettings,
    *,
    instrument: Instrument,
    open_radio: OpenRadio,
    clock: Clock,
    key: bytes | None = None,
    random_bits: Callable[[int], int] = secrets.randbits,
    boot: str = "",
    write: Callable[[int, memoryview], int] | None = None,
) -> None:
    """Run a station's client until it is cancelled.

    Instrument, radio and disk may fail and come back; the other parts go on meanwhile.

    Parameters
    ----------
    config
        Station, prism, protocol, journal and status socket; the rest is given by what follows.
    settings
        Those of the radio.
    instrument
        The total station.
    open_radio
        Opens the radio.
    clock
        Its Unix time is read once, here, and need not be right.
    key
        What the radios of a mission share, where the protocol has one; None: whoever speaks the protocol is believed.
    random_bits
        Returns a number with so many random bits.
    boot
        Which start of this computer its clock counts from; empty where unknown, and then no other run's clock is
        taken for this one.
    write
        See :class:`~tsgt.recording.RecordingWriter`.

    Raises
    ------
    RecordingError
        The journal cannot be begun: no such folder, no permission.
    StreamError
        The status socket cannot be made: another client serves it.
    """
    timeline = UnixTimeline.fixed_now(clock)
    now_ns = timeline.unix_ns(clock.monotonic_ns())
    superframe = config.protocol.kind == "superframe"
    # What earlier runs have left; over the protocol classic each begins anew.
    backlog = read_backlog(config.journal.directory, config.station) if superframe else Backlog()
    lineage = backlog.lineage
    if superframe and lineage is None:
        lineage = random_bits(LINEAGE_BITS)
    path = new_recording_path(config.journal.directory, f"station{config.station}", now_ns)
    with RecordingWriter(path, write=write) as writer:
        recorder = Recorder(writer)
        # To a classic master, which asks for the newest measurement only, one that has waited is worth nothing.
        journal = JournalQueue(recorder, patience_s=None if superframe else PATIENCE_S)
        header = RecordingHeader(
            software=f"tsgt {tsgt.__version__}",
            created_ns=now_ns,
            source=f"tsgt-client, station {config.station}",
        )
        recorder.write_line(encode_line(header))
        run_start = backlog.run_start
        if superframe and recorder.failing:
            # Where nothing can be written, the next run would not know which numbers this one has given away. So this one
            # begins anew, with numbers of its own, and leaves what earlier runs have left to the next one.
            backlog, lineage, run_start = (
                Backlog(),
                random_bits(LINEAGE_BITS),
                run_start + random_bits(_SKIP_BITS),
            )
        session = Session(config.station, config.prism, run_start)
        client = _Client(session, instrument, clock, timeline, recorder, journal, path)
        client.write(
            JournalRecord(
                station=config.station,
                unix_at_zero_ns=timeline.unix_at_zero_ns,
                boot=boot,
                lineage=lineage,
                run_start=run_start,
            )
        )
        # The next run goes on from here, even if the power goes before the first regular sync: otherwise it would
        # give numbers again that the master has.
        recorder.flush()
        with suppress(RecordingError):
            writer.sync()
        if lineage is None:
            client.link = ClassicLink(session, clock, timeline, on_order=client.give, begin=client.begin)
        else:
            authenticator = Authenticator(key)
            outbox = Outbox(run_start, backlog.queued)
            station = SuperframeStation(
                config.station,
                settings,
                authenticator,
                outbox,
                lineage=lineage,
                boot=boot,
                receptions=backlog.receptions,
                random_bits=random_bits,
            )
            client.link = SuperframeLink(
                station,
                outbox,
                boot,
                clock,
                timeline,
                authenticated=authenticator.authentic,
                situation=client.situation,
                on_order=client.give,
                write=client.write,
            )
        try:
            with StatusSocket(config.status_socket) as status_socket:
                log.info("client_started", station=config.station, journal=str(path))
                async with asyncio.TaskGroup() as group:
                    client.tasks = group
                    group.create_task(journal.keep_writing())
                    group.create_task(
                        service.keep_synced(writer.sync, clock, config.journal.fsync_interval_s)
                    )
                    group.create_task(client.keeper.keep())
                    group.create_task(keep_radio(open_radio, client.talk, clock))
                    group.create_task(status_socket.keep_answering(client.status, client.asked))
                    group.create_task(service.keep_notified(client.status_line, clock))
        finally:
            recorder.close()
            log.info("client_stopped", station=config.station)


class _Client:
    """What ties instrument, journal and radio together.

    Attributes
    ----------
    link
        The protocol.
    tasks
        What runs beside each other.
    """

    link: Link
    tasks: asyncio.TaskGroup

    def __init__(
        self,
        session: Session,
        instrument: Instrument,
        clock: Clock,
        timeline: UnixTimeline,
        recorder: Recorder,
        journal: JournalQueue,
        path: Path,
    ) -> None:
        self._session = session
        self._clock = clock
        self._timeline = timeline
        self._recorder = recorder
        self._journal = journal
        self._path = path
        self._radio_ok = False
        self._record: InstrumentRecord | None = None
        self.keeper = InstrumentKeeper(
            instrument,
            session,
            clock,
            on_reading=self._measured,
            on_record=self._set,
            on_done=self._done,
        )

    def write(self, record: object) -> None:
        """Put a record into the journal that nothing follows from."""
        self._journal.write(record, _nothing)

    # --- Instrument -------------------------------------------------------------------------------------------

    def _measured(self, reading: Reading) -> None:
        measurement = self._session.measured(reading, self._timeline.unix_ns(reading.at_ns))
        self._journal.write(measurement, partial(self.link.offer, measurement))

    def _set(self, record: InstrumentRecord) -> None:
        """Keep how the instrument is set from now on."""
        self._record = replace(record, stamp_ns=self._now_ns())
        self.write(self._record)

    def give(self, order: Order) -> None:
        """Have an order of the master carried out."""
        log.info("order_received", order=type(order).__name__)
        self.keeper.give(order)

    def _done(self, done: Done) -> None:
        """Answer an order, a measurement when it is journalled."""
        if not isinstance(done.order, MeasureOrder):
            if done.ok:
                self._session.executed(done.order)
            self.link.executed(done.order, ok=done.ok)
        elif done.reading is None:
            self.link.shot(None)
        else:
            target = self._session.shot(done.reading, self._timeline.unix_ns(done.reading.at_ns))
            self._journal.write(target, partial(self.link.shot, target))

    def situation(self) -> Situation:
        """Say what the instrument is doing."""
        return Situation(
            prism=self._session.prism,
            direct=self._session.mode == "direct",
            connected=self.keeper.description is not None,
        )

    # --- Radio ------------------------------------------------------------------------------------------------

    async def talk(self, radio: Radio) -> NoReturn:
        """Answer the master over this radio."""
        self._radio_ok = True
        try:
            await self.link.talk(radio)
        finally:
            self._radio_ok = False

    def begin(self, coroutine: Coroutine[Any, Any, None]) -> None:
        """Run something beside the radio's own task, and beside the instrument's."""
        self.tasks.create_task(coroutine)

    # --- People -----------------------------------------------------------------------------------------------

    def status(self) -> ClientStatus:
        """Say how it goes."""
        return self._session.status(
            self._now_ns(),
            self.link.status(),
            instrument=self.keeper.description,
            condition=self.keeper.condition,
            settings=self._settings(),
            journal=str(self._path),
            journal_ok=not self._recorder.failing,
            journal_waiting=self._recorder.waiting,
            journal_lost=self._recorder.lost,
            radio_ok=self._radio_ok,
        )

    def _settings(self) -> InstrumentRecord | None:
        return None if self.keeper.description is None else self._record

    async def asked(self, line: bytes) -> Answer:
        """Do what somebody asks for over the status socket."""
        try:
            request = decode(AtmosphereRequest, line)
        except ValueError as error:
            return Answer(problem=f"not understood: {error}", settings=self._settings())
        problem = await self.keeper.set_atmosphere(
            Atmosphere(temperature_c=request.temperature_c, pressure_hpa=request.pressure_hpa)
        )
        return Answer(problem=problem, settings=self._settings())

    def status_line(self) -> str:
        """Say the same in one line, for systemd."""
        status = self.status()
        instrument = "no instrument" if status.instrument is None else f"prism {status.prism}"
        if status.instrument is not None and status.mode == "direct":
            instrument = "single measurements"
        last = (
            "no measurement yet" if status.last is None else f"{status.last.status}, {status.rate_hz:.1f} Hz"
        )
        master = (
            "master not heard yet"
            if status.master_heard_s is None
            else f"master {status.master_heard_s:.0f} s ago"
        )
        queued = f", {status.queued} queued" if status.queued else ""
        problems = (f", {status.problem}" if status.problem else "") + (
            "" if status.radio_ok else ", no radio"
        )
        if not status.journal_ok:
            problems += f", disk fails: {status.journal_waiting} lines not written"
        if status.journal_lost:
            problems += f", {status.journal_lost} lines lost"
        return f"station {status.station}: {instrument}, {last}, {master}{queued}{problems}"

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())


def _nothing() -> None:
    """Follows the lines that nothing follows from."""
