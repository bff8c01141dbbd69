"""The superframe link of a station: replies to each beacon in the station's slot until all measurements are delivered."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.radio.superframe import COMPOSE_LEAD_NS, SendQueue, SuperframeStation
from tsgt.radio.superframe.wire import Authenticator, angle_code
from tsgt.recording.journal import AcknowledgedRecord, ReceptionRecord
from tsgt.service import LogLimiter
from tsgt.station.backlog import queued_measurement
from tsgt.station.links.traffic_monitor import UnknownTrafficMonitor
from tsgt.station.status import LinkStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import SuspensionWatch, UnixTimeline
    from tsgt.model import PolarMeasurement
    from tsgt.radio import Command, DirectCommand, LoRaSettings, Radio, SearchCommand, TrackCommand
    from tsgt.radio.superframe import InstrumentState, ReceivedBeacon
    from tsgt.recording.journal import TargetRecord
    from tsgt.station.backlog import Backlog
    from tsgt.station.dependencies import ClientDependencies

NO_SLOT_TIMEOUT_NS = 30_000_000_000
"""A station that the master has not received lately has a slot in each fourth frame only, of at most 3 s with 16 stations."""

ACKNOWLEDGED_INTERVAL_NS = 5_000_000_000
"""Interval of the journal's records of the cumulative acknowledgement."""

log = structlog.get_logger()


class SuperframeLink:
    """The asyncio half of :class:`~tsgt.radio.superframe.SuperframeStation`; a :class:`~tsgt.station.links.base.Link`.

    Parameters
    ----------
    watch
        Checked before the times of a beacon and of a reply are used.
    backlog
        Measurements and receptions of earlier runs.
    instrument_state
        Returns the instrument's current state for the reply.
    on_command
        Called with each command of the master.
    write
        Writes a record to the journal.
    """

    def __init__(
        self,
        station: int,
        settings: LoRaSettings,
        dependencies: ClientDependencies,
        watch: SuspensionWatch,
        timeline: UnixTimeline,
        backlog: Backlog,
        *,
        stream_id: int,
        instrument_state: Callable[[], InstrumentState],
        on_command: Callable[[Command], None],
        write: Callable[[object], None],
    ) -> None:
        self._clock = clock = dependencies.clock
        self._timeline = timeline
        self._watch = watch
        self._boot = dependencies.boot
        self._authenticator = Authenticator(dependencies.key)
        self._send_queue = SendQueue(backlog.first_sequence, backlog.queued)
        self._station = SuperframeStation(
            station,
            settings,
            self._authenticator,
            self._send_queue,
            stream_id=stream_id,
            boot=self._boot,
            receptions=backlog.receptions,
            random_bits=dependencies.random_bits,
        )
        self._instrument_state = instrument_state
        self._on_command = on_command
        self._write = write
        self._acknowledged = self._send_queue.oldest
        self._acknowledged_ns = clock.monotonic_ns()
        self._write_acknowledged()
        if not self._authenticator.authentic:
            log.warning("unauthenticated", key_file=None)
        self._slot_ns: int | None = None  # first beacon without a slot since the last one with it
        self._discarded = 0  # and not logged yet
        self._log_limiter = LogLimiter()
        self._traffic_monitor = UnknownTrafficMonitor(clock)

    def offer(self, measurement: PolarMeasurement) -> None:
        """Queue a measurement for delivery."""
        dropped_through = self._send_queue.dropped_through
        self._send_queue.add(queued_measurement(measurement, self._timeline.unix_at_zero_ns, self._boot))
        self._log_discarded(int(self._send_queue.dropped_through != dropped_through))

    def respond(self, command: TrackCommand | SearchCommand | DirectCommand, *, ok: bool) -> None:  # noqa: ARG002 (only one is pending)
        """Queue the response to the pending command."""
        self._station.executed(ok=ok)
        self._submit_next()

    def respond_single(self, target: TargetRecord | None) -> None:
        """Queue a single measurement as the response."""
        if target is None:
            self._station.executed(ok=False)
        else:
            self._station.measured(
                target.status,
                angle_code(target.horizontal_angle_rad),
                angle_code(target.zenith_angle_rad),
                target.slope_distance_m,
            )
        self._submit_next()

    async def run(self, radio: Radio) -> NoReturn:
        """Reply to each beacon in the station's slot. Raises ComputerSuspendedError after a suspension, RadioError."""
        while True:
            packet = await radio.receive()
            self._watch.check()
            failures = self._station.authentication_failures
            beacon = self._station.received(packet)
            self._traffic_monitor.received(from_master=beacon is not None)
            if self._station.authentication_failures != failures and self._may_log(
                "beacon_authentication_failed"
            ):
                log.warning("beacon_authentication_failed", refused=self._station.authentication_failures)
            if beacon is not None:
                self._record(beacon)
                self._submit_next()
                if beacon.slot_ns is not None:
                    self._slot_ns = None
                    await self._reply(radio, beacon.slot_ns)
                else:
                    self._no_slot(packet.received_at_ns)

    def _no_slot(self, now_ns: int) -> None:
        """Warn if beacons have been without a slot for this station for long."""
        if self._slot_ns is None:
            self._slot_ns = now_ns
        elif now_ns - self._slot_ns > NO_SLOT_TIMEOUT_NS and self._may_log("no_slot"):
            log.warning("no_slot", for_s=round((now_ns - self._slot_ns) / 1e9))

    async def _reply(self, radio: Radio, slot_ns: int) -> None:
        missed_slots = self._station.missed_slots
        await self._clock.sleep_until(slot_ns - COMPOSE_LEAD_NS)
        self._watch.check()
        reply = self._station.compose(self._instrument_state(), self._clock.monotonic_ns())
        # A late reply would collide with the next slot. To the station it is one that was lost on the air.
        if reply is not None and not self._station.misses_slot(self._clock.monotonic_ns()):
            self._station.sent(await radio.transmit(reply, at_ns=slot_ns))
        if self._station.missed_slots != missed_slots:
            log.info("slot_missed", missed_slots=self._station.missed_slots)

    def _record(self, beacon: ReceivedBeacon) -> None:
        """Journal and log what a beacon has brought."""
        reception = beacon.reception
        if reception is not None:
            self._write(
                ReceptionRecord(
                    stamp_ns=self._timeline.unix_ns(reception.received_ns),
                    stamp_sigma_ns=reception.sigma_ns,
                    session=reception.session,
                    counter=reception.counter,
                    sent_us=reception.sent_us,
                )
            )
        now_ns, oldest = self._clock.monotonic_ns(), self._send_queue.oldest
        if oldest != self._acknowledged and now_ns >= self._acknowledged_ns + ACKNOWLEDGED_INTERVAL_NS:
            self._acknowledged, self._acknowledged_ns = oldest, now_ns
            self._write_acknowledged()
        if beacon.joined:
            log.info("session_joined", queued=len(self._send_queue))
        self._log_discarded(beacon.discarded)
        if beacon.time_rejected and self._may_log("beacon_time_rejected"):
            log.warning("beacon_time_rejected", rejected_beacons=self._station.rejected_beacons)

    def _log_discarded(self, measurements: int) -> None:
        self._discarded += measurements
        if self._discarded and self._may_log("measurements_discarded"):
            log.warning("measurements_discarded", measurements=self._discarded)
            self._discarded = 0

    def _write_acknowledged(self) -> None:
        stamp_ns = self._timeline.unix_ns(self._acknowledged_ns)
        self._write(AcknowledgedRecord(stamp_ns=stamp_ns, oldest=self._acknowledged))

    def _submit_next(self) -> None:
        if (command := self._station.next_command()) is not None:
            self._on_command(command)

    def _may_log(self, event: str) -> bool:
        return self._log_limiter.allows(event, self._clock.monotonic_ns())

    def status(self) -> LinkStatus:
        """Return the link's current status."""
        station = self._station
        bound_us = station.clock_bound_us(self._clock.monotonic_ns())
        return LinkStatus(
            protocol="superframe",
            master_received_ns=None if station.heard_ns is None else self._timeline.unix_ns(station.heard_ns),
            rssi_dbm=station.rssi_dbm,
            snr_db=station.snr_db,
            unknown_packets=self._traffic_monitor.packets,
            refused=station.authentication_failures,
            authenticated=self._authenticator.authentic,
            joined=station.joined,
            queued=len(self._send_queue),
            missed_slots=station.missed_slots,
            rejected_beacons=station.rejected_beacons,
            clock_bound_ns=None if bound_us is None else round(1000 * bound_us),
        )
