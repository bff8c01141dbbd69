"""The protocol classic as the master runs it: turns with the stations, one after the other."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tsgt.master.classic.ingest import RESTART_NS, Intake
from tsgt.master.classic.scheduler import Cadence, Scheduler, StationPlan
from tsgt.master.classic.transport import Collector
from tsgt.radio.classic import CommandTransaction, Poll, Synchronisation
from tsgt.radio.classic.transactions import LinkTiming
from tsgt.timesync.two_way import clock_filter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.config import ClassicMasterConfig, StationConfig
    from tsgt.master.classic.scheduler import Task
    from tsgt.master.publisher import Reports
    from tsgt.radio import LoRaSettings, Packet, Radio
    from tsgt.recording import StatusRecord


class ClassicLink:
    """Takes turns with the stations, and reports what they bring.

    Parameters
    ----------
    stations, protocol
        What the configuration says of them.
    settings
        Of the modem.
    reports
        Told of all that happens.

    Attributes
    ----------
    turn_ns
        When the present turn began, on the master's Unix clock; None without a radio.
    """

    def __init__(
        self,
        stations: Sequence[StationConfig],
        protocol: ClassicMasterConfig,
        settings: LoRaSettings,
        reports: Reports,
    ) -> None:
        self._reports = reports
        self._prisms = {station.station: station.prism for station in stations}
        delays_ns = {station.station: round(station.timestamp_delay_ms * 1e6) for station in stations}
        self._timing = LinkTiming.of(settings, round(protocol.reply_timeout_ms * 1e6))
        self._scheduler = Scheduler(
            [
                StationPlan(
                    station=station.station,
                    prism=station.prism,
                    stamp_delay_ns=delays_ns[station.station],
                )
                for station in stations
            ],
            _cadence(protocol),
            self._timing,
            reports.now_ns(),
        )
        self._intake = Intake(self._prisms, lambda: clock_filter(protocol.clock_filter), delays_ns)
        self.turn_ns: int | None = None

    def status(self, now_ns: int) -> StatusRecord:
        """Report how the stations do at an instant on the master's Unix clock."""
        return self._reports.monitor.status(
            now_ns, clock=self._intake.clock, protocol="classic", authenticated=False
        )

    async def run(self, radio: Radio) -> None:
        """Take turns for as long as the radio does.

        Raises
        ------
        RadioError
            It does no more.
        """
        reports = self._reports
        collector = Collector(radio, reports.clock, reports.timeline, self._timing)
        try:
            while True:
                self.turn_ns = reports.now_ns()
                turn = self._scheduler.next(self.turn_ns)
                if isinstance(turn, int):
                    await reports.clock.sleep_until(reports.timeline.monotonic_ns(turn))
                    continue
                await collector.take(turn)
                self._finished(turn, collector)
        finally:
            self.turn_ns = None

    def _finished(self, turn: Task, collector: Collector) -> None:
        reports = self._reports
        now_ns, station = reports.now_ns(), turn.station
        self._scheduler.finished(turn, now_ns)
        answered = turn.ok is not None if isinstance(turn, CommandTransaction) else turn.answered
        reports.monitor.asked(station, answered=answered)
        reports.events(reports.alerts.asked(station, now_ns, answered=answered))
        if not answered or collector.last is None:
            self._intake.unanswered(station)
            return
        reports.monitor.heard(station, now_ns, rssi_dbm=collector.last.rssi_dbm, snr_db=collector.last.snr_db)
        if isinstance(turn, CommandTransaction):
            prism = self._prisms[station]
            reports.monitor.tracks(station, prism if turn.ok else None)
            reports.events(reports.alerts.ordered(station, prism, now_ns, tracks=bool(turn.ok)))
        elif isinstance(turn, Synchronisation):
            if turn.unanswered:
                self._intake.unanswered(station)
            if turn.restarted:
                self._intake.doubt(station)
            if turn.samples:
                self._synchronised(turn, now_ns)
            if _leaves_doubt(turn) and self._intake.clock(station, now_ns) is not None:
                self._intake.doubt(station)
                self._scheduler.doubted(station, now_ns)
        elif isinstance(turn, Poll):
            self._polled(turn, collector.last, collector.requested_ns)

    def _synchronised(self, turn: Synchronisation, now_ns: int) -> None:
        reports, station = self._reports, turn.station
        found = self._intake.synchronised(station, turn.samples, now_ns)
        if found.stepped:
            reports.events(reports.alerts.stepped(station, now_ns))
        reports.outlet.put(found.record)
        for measurement in found.measurements:
            reports.measured(measurement)

    def _polled(self, poll: Poll, packet: Packet, requested_ns: int) -> None:
        reports = self._reports
        if poll.message is None:
            return
        reports.events(reports.alerts.polled(poll.station, reports.now_ns()))
        arrival = self._intake.answered(
            poll.message,
            requested_ns=requested_ns,
            received_ns=reports.timeline.unix_ns(packet.received_at_ns),
        )
        if arrival.measurement is not None:
            reports.measured(arrival.measurement)
        if arrival.doubtful:
            self._scheduler.resynchronise(poll.station, reports.now_ns())
        if arrival.stepped:
            reports.events(reports.alerts.stepped(poll.station, reports.now_ns()))


def _leaves_doubt(turn: Synchronisation) -> bool:
    """Whether the station may have another clock than that of the samples.

    It tells of a restart until it is pinged. If that was done here, and what it answered was lost, nothing else will tell.
    One that was restarted here may track another prism besides.
    """
    return turn.restarted or (turn.unanswered > 0 and (not turn.samples or turn.silence_ns > RESTART_NS))


def _cadence(protocol: ClassicMasterConfig) -> Cadence:
    interval_ns = round(protocol.resync_interval_s * 1e9)
    cadence = Cadence(
        initial_cycles=protocol.initial_cycles,
        resync_cycles=protocol.resync_cycles,
        interval_ns=interval_ns,
    )
    if protocol.clock_filter == "paper":  # which knows no frequency that it could learn sooner
        return replace(cadence, first_interval_ns=interval_ns)
    return cadence
