"""The master's side of the protocol classic: transactions with the stations, one after the other."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tsgt.master import link_events
from tsgt.master.classic.ingest import MIN_RESTART_NS, StationIngest
from tsgt.master.classic.scheduler import Scheduler, StationPlan, SynchronisationSchedule
from tsgt.master.classic.transport import Transport
from tsgt.radio.classic import CommandTransaction, LinkTiming, Poll, Synchronisation
from tsgt.timesync.two_way import clock_filter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.config import ClassicMasterConfig, StationConfig
    from tsgt.master.classic.scheduler import ScheduledTransaction
    from tsgt.radio import LoRaSettings, Packet, Radio


class ClassicLink:
    """Runs transactions and reports results; ``exchange_start_ns``: when the present exchange began, None without radio."""

    def __init__(
        self,
        stations: Sequence[StationConfig],
        protocol: ClassicMasterConfig,
        settings: LoRaSettings,
        clock: Clock,
        timeline: UnixTimeline,
        report: link_events.Report,
    ) -> None:
        self._clock = clock
        self._timeline = timeline
        self._report = report
        self._prisms = {station.station: station.prism for station in stations}
        delays_ns = {station.station: round(station.timestamp_delay_ms * 1e6) for station in stations}
        self._timing = LinkTiming(settings, round(protocol.reply_timeout_ms * 1e6))
        plans = [
            StationPlan(
                station=station.station, prism=station.prism, stamp_delay_ns=delays_ns[station.station]
            )
            for station in stations
        ]
        self._scheduler = Scheduler(plans, _schedule(protocol), self._timing, self._now_ns())
        self._ingest = {
            station: StationIngest(station, prism, clock_filter(protocol.clock_filter), delays_ns[station])
            for station, prism in self._prisms.items()
        }
        self.exchange_start_ns: int | None = None

    def status(self) -> link_events.LinkStatus:
        """Return what the status record states about the link."""
        return link_events.LinkStatus(
            protocol="classic",
            authenticated=False,
            clock=lambda station, now_ns: self._ingest[station].clock(now_ns),
        )

    async def run(self, radio: Radio) -> None:
        """Run transactions until the radio raises RadioError."""
        transport = Transport(
            radio, self._clock, self._timeline, self._timing, on_request=self._exchange_starts
        )
        try:
            while True:
                self._exchange_starts()
                transaction = self._scheduler.next(self._now_ns())
                if isinstance(transaction, int):
                    await self._clock.sleep_until(self._timeline.monotonic_ns(transaction))
                    continue
                await transport.run(transaction)
                self._finished(transaction, transport)
        finally:
            self.exchange_start_ns = None

    def _exchange_starts(self) -> None:
        self.exchange_start_ns = self._now_ns()

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())

    def _finished(self, transaction: ScheduledTransaction, transport: Transport) -> None:
        now_ns, station = self._now_ns(), transaction.station
        self._scheduler.finished(transaction, now_ns)
        responded = (
            transaction.ok is not None
            if isinstance(transaction, CommandTransaction)
            else transaction.has_reply
        )
        if not responded or transport.last is None:
            self._report(link_events.NoResponse(station))
            self._ingest[station].no_response()
            return
        self._report(link_events.StationResponded(station, transport.last.rssi_dbm, transport.last.snr_db))
        if isinstance(transaction, CommandTransaction):
            prism = self._prisms[station]
            self._report(link_events.TrackedPrism(station, prism if transaction.ok else None))
            self._report(link_events.TrackingResult(station, prism, bool(transaction.ok)))
        elif isinstance(transaction, Synchronisation):
            if transaction.missed_replies:
                self._ingest[station].no_response()
            if transaction.restarted:
                self._ingest[station].suspend()
            if transaction.samples:
                self._synchronised(transaction, now_ns)
            if _is_inconclusive(transaction) and self._ingest[station].clock(now_ns) is not None:
                self._ingest[station].suspend()
                self._scheduler.synchronisation_inconclusive(station, now_ns)
        elif isinstance(transaction, Poll):
            self._polled(transaction, transport.last, transport.requested_ns)

    def _synchronised(self, transaction: Synchronisation, now_ns: int) -> None:
        result = self._ingest[transaction.station].synchronised(transaction.samples, now_ns)
        if result.stepped:
            self._report(link_events.ClockStepped(transaction.station))
        self._report(link_events.ClockUpdate(result.record))
        for measurement in result.measurements:
            self._report(link_events.MeasurementReceived(measurement))

    def _polled(self, poll: Poll, packet: Packet, requested_ns: int) -> None:
        if poll.message is None:
            return
        self._report(link_events.ReplyReceived(poll.station))
        result = self._ingest[poll.station].reply(
            poll.message,
            requested_ns=requested_ns,
            received_ns=self._timeline.unix_ns(packet.received_at_ns),
        )
        if result.measurement is not None:
            self._report(link_events.MeasurementReceived(result.measurement))
        if result.needs_synchronisation:
            self._scheduler.resynchronise(poll.station, self._now_ns())
        if result.stepped:
            self._report(link_events.ClockStepped(poll.station))


def _is_inconclusive(transaction: Synchronisation) -> bool:
    """Whether the station may have restarted, and have another clock than the samples', without a report of it."""
    return transaction.restarted or (
        transaction.missed_replies > 0
        and (not transaction.samples or transaction.longest_silence_ns > MIN_RESTART_NS)
    )


def _schedule(protocol: ClassicMasterConfig) -> SynchronisationSchedule:
    interval_ns = round(protocol.resync_interval_s * 1e9)
    schedule = SynchronisationSchedule(
        initial_cycles=protocol.initial_cycles,
        resync_cycles=protocol.resync_cycles,
        interval_ns=interval_ns,
    )
    if (
        protocol.clock_filter == "paper"
    ):  # it estimates no skew, so an early second synchronisation gains nothing
        return replace(schedule, first_interval_ns=interval_ns)
    return schedule
