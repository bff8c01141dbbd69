"""The client beside a total station: reads it, journals every measurement, answers the master over the radio."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, NoReturn

import structlog

import tsgt
from tsgt import service
from tsgt.clock import UnixTimeline
from tsgt.errors import RadioError
from tsgt.radio.classic import TURN_ROUND_NS, MeasureOrder, Order
from tsgt.radio.supervised import keep_radio
from tsgt.recording import RecordingHeader, RecordingWriter, new_recording_path
from tsgt.recording.journal import JournalRecord
from tsgt.recording.recorder import Recorder
from tsgt.station.journal import JournalQueue
from tsgt.station.keeper import Done, InstrumentKeeper
from tsgt.station.session import Session
from tsgt.station.status_socket import serving_status

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.config import ClientConfig
    from tsgt.radio.base import OpenRadio, Radio
    from tsgt.recording.journal import TargetRecord
    from tsgt.station.instrument import Instrument, Reading
    from tsgt.station.status import ClientStatus

LATEST_ANSWER_NS = 20_000_000_000
"""An answer to an order that took longer is not sent: the master has given up, and asks others meanwhile."""

log = structlog.get_logger()


async def run_client(
    config: ClientConfig, *, instrument: Instrument, open_radio: OpenRadio, clock: Clock
) -> None:
    """Run a station's client until it is cancelled.

    Instrument, radio and disk may fail and come back; the other parts go on meanwhile.

    Parameters
    ----------
    config
        Station, prism, journal and status socket; the rest is given by what follows.
    instrument
        The total station.
    open_radio
        Opens the radio.
    clock
        Its Unix time is read once, here, and need not be right.

    Raises
    ------
    RecordingError
        The journal cannot be begun: no such folder, no permission.
    StreamError
        The status socket cannot be made: another client serves it.
    """
    timeline = UnixTimeline.fixed_now(clock)
    now_ns = timeline.unix_ns(clock.monotonic_ns())
    path = new_recording_path(config.journal.directory, f"station{config.station}", now_ns)
    with RecordingWriter(path) as writer:
        recorder = Recorder(writer)
        journal = JournalQueue(recorder)
        client = _Client(config, instrument, clock, timeline, recorder, journal, path)
        header = RecordingHeader(
            software=f"tsgt {tsgt.__version__}",
            created_ns=now_ns,
            source=f"tsgt-client, station {config.station}",
        )
        journal.write(header, _nothing)
        journal.write(
            JournalRecord(station=config.station, unix_at_zero_ns=timeline.unix_at_zero_ns), _nothing
        )
        try:
            with serving_status(config.status_socket, client.status):
                log.info("client_started", station=config.station, journal=str(path))
                async with asyncio.TaskGroup() as group:
                    client.tasks = group
                    group.create_task(journal.keep_writing())
                    group.create_task(
                        service.keep_synced(writer.sync, clock, config.journal.fsync_interval_s)
                    )
                    group.create_task(client.keeper.keep())
                    group.create_task(keep_radio(open_radio, client.answer, clock))
                    group.create_task(service.keep_notified(client.status_line, clock))
        finally:
            recorder.close()
            log.info("client_stopped", station=config.station)


class _Client:
    """What ties instrument, journal and radio together."""

    tasks: asyncio.TaskGroup

    def __init__(
        self,
        config: ClientConfig,
        instrument: Instrument,
        clock: Clock,
        timeline: UnixTimeline,
        recorder: Recorder,
        journal: JournalQueue,
        path: Path,
    ) -> None:
        self._clock = clock
        self._timeline = timeline
        self._recorder = recorder
        self._journal = journal
        self._path = path
        self._session = Session(config.station, config.prism)
        self._radio: Radio | None = None
        self._ordered_ns = 0
        self.keeper = InstrumentKeeper(
            instrument, self._session, clock, on_reading=self._measured, on_done=self._done
        )

    # --- Instrument -------------------------------------------------------------------------------------------

    def _measured(self, reading: Reading) -> None:
        measurement = self._session.measured(reading, self._timeline.unix_ns(reading.at_ns))
        self._journal.write(measurement, partial(self._session.offer, measurement))

    def _done(self, done: Done) -> None:
        """Answer an order, a measurement when it is journalled."""
        if not isinstance(done.order, MeasureOrder):
            self._answer_order(self._session.executed(done.order, ok=done.ok))
        elif done.reading is None:
            self._answer_order(self._session.shot_failed(self._now_ns()))
        else:
            target = self._session.shot(done.reading, self._timeline.unix_ns(done.reading.at_ns))
            self._journal.write(target, partial(self._answer_shot, target))

    def _answer_shot(self, target: TargetRecord) -> None:
        self._answer_order(self._session.shot_answer(target))

    def _answer_order(self, answer: bytes) -> None:
        late_ns = self._now_ns() - self._ordered_ns
        if self._radio is None or late_ns > LATEST_ANSWER_NS:
            log.warning("order_unanswered", late_s=late_ns / 1e9)
            return
        # Beside the radio's own task, which goes on answering, and beside the instrument's, which goes on reading.
        self.tasks.create_task(self._send(self._radio, answer))

    async def _send(self, radio: Radio, answer: bytes) -> None:
        try:
            await radio.transmit(answer)
        except RadioError as error:
            log.warning("order_unanswered", error=str(error))

    # --- Radio ------------------------------------------------------------------------------------------------

    async def answer(self, radio: Radio) -> NoReturn:
        """Answer the master; nothing on this way waits for anything but the radio."""
        self._radio = radio
        try:
            while True:
                packet = await radio.receive()
                if self._clock.monotonic_ns() - packet.received_at_ns > TURN_ROUND_NS:
                    log.warning(
                        "request_too_old"
                    )  # this computer was busy; the master asks somebody else by now
                    continue
                received_ns = self._timeline.unix_ns(packet.received_at_ns)
                answer = self._session.received(
                    packet.payload, received_ns, rssi_dbm=packet.rssi_dbm, snr_db=packet.snr_db
                )
                if isinstance(answer, bytes):
                    await radio.transmit(answer)
                elif answer is not None:
                    self._give(answer, received_ns)
        finally:
            self._radio = None

    def _give(self, order: Order, received_ns: int) -> None:
        log.info("order_received", order=type(order).__name__)
        self._ordered_ns = received_ns
        self.keeper.give(order)

    # --- People -----------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())

    def status(self) -> ClientStatus:
        """Say how it goes."""
        return self._session.status(
            self._now_ns(),
            instrument=self.keeper.description,
            journal=str(self._path),
            journal_ok=not self._recorder.failing,
            journal_waiting=self._recorder.waiting,
            radio_ok=self._radio is not None,
        )

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
        problems = ("" if status.radio_ok else ", no radio") + ("" if status.journal_ok else ", disk fails")
        return f"station {status.station}: {instrument}, {last}, {master}{problems}"


def _nothing() -> None:
    """Follows the lines that nothing follows from."""
