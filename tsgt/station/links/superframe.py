"""A station's client on the superframe: it answers each beacon in its slot, until everything is delivered."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.radio.superframe.wire import angle_code
from tsgt.recording.journal import AcknowledgedRecord, ReceptionRecord
from tsgt.station.backlog import queued
from tsgt.station.links.traffic_monitor import Strangers
from tsgt.station.status import LinkStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.model import PolarMeasurement
    from tsgt.radio import DirectOrder, Order, Radio, SearchOrder, TrackOrder
    from tsgt.radio.superframe import Outbox, Situation, SuperframeStation
    from tsgt.radio.superframe.station import Heard
    from tsgt.recording.journal import TargetRecord

LEAD_NS = 6_000_000
"""A reply is put together so long before its slot: the radio wants three milliseconds, a Raspberry Pi the rest."""

ACKNOWLEDGED_EVERY_NS = 5_000_000_000
"""From one line in the journal of how far the master has got to the next."""

SELDOM_NS = 60_000_000_000
"""A warning that may come with each packet is logged so often."""

log = structlog.get_logger()


class SuperframeLink:
    """The shell around :class:`~tsgt.radio.superframe.station.SuperframeStation`; see :class:`~tsgt.station.links.base.Link`.

    Parameters
    ----------
    station
        Knows what to say.
    outbox
        What it delivers.
    boot
        Since which start of this computer its clock has run like this.
    clock, timeline
        Of this computer.
    authenticated
        Whether there is a key.
    situation
        Says what the instrument is doing.
    on_order
        Gets the master's orders.
    write
        Puts a record into the journal.
    """

    def __init__(
        self,
        station: SuperframeStation,
        outbox: Outbox,
        boot: str,
        clock: Clock,
        timeline: UnixTimeline,
        *,
        authenticated: bool,
        situation: Callable[[], Situation],
        on_order: Callable[[Order], None],
        write: Callable[[object], None],
    ) -> None:
        self._station = station
        self._outbox = outbox
        self._boot = boot
        self._clock = clock
        self._timeline = timeline
        self._authenticated = authenticated
        self._situation = situation
        self._on_order = on_order
        self._write = write
        self._acknowledged = outbox.oldest
        self._acknowledged_ns = clock.monotonic_ns()
        self._write_acknowledged()
        if not authenticated:
            log.warning("unauthenticated", key_file=None)
        self._logged_ns: dict[str, int] = {}
        self._strangers = Strangers(clock)

    def offer(self, measurement: PolarMeasurement) -> None:
        """See the protocol; whatever has been measured will be delivered."""
        left_through = self._outbox.left_through
        self._outbox.add(queued(measurement, self._timeline.unix_at_zero_ns, self._boot))
        if self._outbox.left_through != left_through and self._is_seldom("measurements_discarded"):
            log.warning("measurements_discarded", measurements=1)

    def executed(self, order: TrackOrder | SearchOrder | DirectOrder, *, ok: bool) -> None:  # noqa: ARG002 (one at a time)
        """See the protocol."""
        self._station.executed(ok=ok)
        self._give()

    def shot(self, target: TargetRecord | None) -> None:
        """See the protocol."""
        if target is None:
            self._station.executed(ok=False)
        else:
            self._station.shot(
                target.status,
                angle_code(target.horizontal_angle_rad),
                angle_code(target.zenith_angle_rad),
                target.slope_distance_m,
            )
        self._give()

    async def talk(self, radio: Radio) -> NoReturn:
        """See the protocol."""
        while True:
            packet = await radio.receive()
            refused = self._station.refused
            heard = self._station.received(packet)
            self._strangers.heard(master=heard is not None)
            if self._station.refused != refused and self._is_seldom("beacon_authentication_failed"):
                log.warning("beacon_authentication_failed", refused=self._station.refused)
            if heard is not None:
                self._note(heard)
                self._give()
                if heard.slot_ns is not None:
                    await self._reply(radio, heard.slot_ns)

    async def _reply(self, radio: Radio, slot_ns: int) -> None:
        late = self._station.late
        await self._clock.sleep_until(slot_ns - LEAD_NS)
        reply = self._station.compose(self._situation(), self._clock.monotonic_ns())
        if reply is not None:
            self._station.sent(await radio.transmit(reply, at_ns=slot_ns))
        if self._station.late != late:
            log.info("slot_missed", late=self._station.late)

    def _note(self, heard: Heard) -> None:
        """Put into journal and log what a beacon has brought."""
        reception = heard.reception
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
        self._note_acknowledged()
        if heard.joined:
            log.info("session_joined", queued=len(self._outbox))
        if heard.left_behind:
            log.warning("measurements_discarded", measurements=heard.left_behind)
        if heard.doubted and self._is_seldom("beacon_time_rejected"):
            log.warning("beacon_time_rejected", doubted=self._station.doubted)

    def _note_acknowledged(self) -> None:
        now_ns = self._clock.monotonic_ns()
        if (
            self._outbox.oldest != self._acknowledged
            and now_ns >= self._acknowledged_ns + ACKNOWLEDGED_EVERY_NS
        ):
            self._acknowledged, self._acknowledged_ns = self._outbox.oldest, now_ns
            self._write_acknowledged()

    def _write_acknowledged(self) -> None:
        stamp_ns = self._timeline.unix_ns(self._acknowledged_ns)
        self._write(AcknowledgedRecord(stamp_ns=stamp_ns, oldest=self._acknowledged))

    def _give(self) -> None:
        if (order := self._station.next_order()) is not None:
            self._on_order(order)

    def _is_seldom(self, event: str) -> bool:
        """Whether an event that may come with each packet is to be logged now."""
        now_ns = self._clock.monotonic_ns()
        seldom = now_ns - self._logged_ns.get(event, -SELDOM_NS) >= SELDOM_NS
        if seldom:
            self._logged_ns[event] = now_ns
        return seldom

    def status(self) -> LinkStatus:
        """See the protocol."""
        station = self._station
        bound_us = station.clock_bound_us(self._clock.monotonic_ns())
        return LinkStatus(
            protocol="superframe",
            heard_ns=None if station.heard_ns is None else self._timeline.unix_ns(station.heard_ns),
            rssi_dbm=station.rssi_dbm,
            snr_db=station.snr_db,
            unknown_packets=self._strangers.packets,
            refused=station.refused,
            authenticated=self._authenticated,
            joined=station.joined,
            queued=len(self._outbox),
            late=station.late,
            doubted=station.doubted,
            clock_bound_ns=None if bound_us is None else round(1000 * bound_us),
        )
