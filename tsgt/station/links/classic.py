"""A station's client on the paper's protocol: it answers whatever it is asked, at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NoReturn

import structlog

from tsgt.errors import RadioError
from tsgt.model import Status
from tsgt.radio import SearchOrder
from tsgt.radio.classic import MeasurementMessage, decode_command, raw_status
from tsgt.radio.classic.transactions import TURN_ROUND_NS, ClassicStation
from tsgt.station.links.traffic_monitor import Strangers
from tsgt.station.status import LinkStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.model import PolarMeasurement
    from tsgt.radio import DirectOrder, Order, Packet, Radio, TrackOrder
    from tsgt.recording.journal import TargetRecord
    from tsgt.station.session import Session

LATEST_ANSWER_NS = 20_000_000_000
"""An answer to an order that took longer is not sent: the master has given up, and asks others meanwhile."""

EXACT_SIGMA_NS = 1_000_000
"""RPi.GPIO's edges have this; the stamp of a packet that was found without its edge is a guess, tens of ms wide."""

log = structlog.get_logger()


class ClassicLink:
    """The shell around :class:`~tsgt.radio.classic.station.ClassicStation`; see :class:`~tsgt.station.links.base.Link`.

    Parameters
    ----------
    session
        Knows what is tracked.
    clock, timeline
        Of this computer.
    on_order
        Gets the master's orders.
    begin
        Runs a coroutine beside the radio's own task, which goes on answering.
    """

    def __init__(
        self,
        session: Session,
        clock: Clock,
        timeline: UnixTimeline,
        *,
        on_order: Callable[[Order], None],
        begin: Callable[[Coroutine[Any, Any, None]], object],
    ) -> None:
        self._session = session
        self._clock = clock
        self._timeline = timeline
        self._on_order = on_order
        self._begin = begin
        self._station = ClassicStation(session.station)
        self._radio: Radio | None = None
        self._heard: Packet | None = None
        self._strangers = Strangers(clock)
        self._ordered_ns = 0

    def offer(self, measurement: PolarMeasurement) -> None:
        """Answer the master with this one from now on.

        One that the disk held up until the station did something else is not offered any more.
        """
        if self._session.mode == "tracking" and measurement.prism == self._session.prism:
            self._station.measured(_message(measurement))

    def executed(self, order: TrackOrder | SearchOrder | DirectOrder, *, ok: bool) -> None:
        """See the protocol; the master cannot order a search."""
        if not isinstance(order, SearchOrder):
            self._answer(self._station.executed(order, ok=ok))

    def shot(self, target: TargetRecord | None) -> None:
        """See the protocol."""
        if target is not None:
            self._answer(self._station.shot(_message(target)))
            return
        failed = MeasurementMessage(
            station=self._session.station,
            status=raw_status(Status.ERROR),
            zenith_angle_rad=0.0,
            horizontal_angle_rad=0.0,
            slope_distance_m=0.0,
            time_ns=self._now_ns(),
        )
        self._answer(self._station.shot(failed))

    def _answer(self, answer: bytes) -> None:
        late_ns = self._now_ns() - self._ordered_ns
        if self._radio is None or late_ns > LATEST_ANSWER_NS:
            log.warning("order_unanswered", late_s=late_ns / 1e9)
            return
        self._begin(self._send(self._radio, answer))

    async def _send(self, radio: Radio, answer: bytes) -> None:
        try:
            await radio.transmit(answer)
        except RadioError as error:
            log.warning("order_unanswered", error=str(error))

    async def talk(self, radio: Radio) -> NoReturn:
        """See the protocol; nothing on this way waits for anything but the radio."""
        self._radio = radio
        try:
            while True:
                packet = await radio.receive()
                if self._clock.monotonic_ns() - packet.received_at_ns > TURN_ROUND_NS:
                    # This computer was busy; the master asks somebody else by now.
                    log.warning("request_expired")
                    continue
                await self._received(packet, radio)
        finally:
            self._radio = None

    async def _received(self, packet: Packet, radio: Radio) -> None:
        command = decode_command(packet.payload)
        self._strangers.heard(master=command is not None)
        if command is not None and command.station == self._session.station:
            self._heard = packet
        received_ns = self._timeline.unix_ns(packet.received_at_ns)
        if packet.stamp_sigma_ns > EXACT_SIGMA_NS:
            # What the master finds out of our clock rests on stamps that are never early. One that is late makes
            # the exchange longer, and so counts in the bound.
            received_ns = self._now_ns()
        answer = self._station.received(packet.payload, received_ns)
        if isinstance(answer, bytes):
            await radio.transmit(answer)
        elif answer is not None:
            self._ordered_ns = received_ns
            self._on_order(answer)

    def status(self) -> LinkStatus:
        """See the protocol."""
        heard = self._heard
        return LinkStatus(
            protocol="classic",
            heard_ns=None if heard is None else self._timeline.unix_ns(heard.received_at_ns),
            rssi_dbm=None if heard is None else heard.rssi_dbm,
            snr_db=None if heard is None else heard.snr_db,
            unknown_packets=self._strangers.packets,
        )

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())


def _message(measurement: PolarMeasurement | TargetRecord) -> MeasurementMessage:
    """Raw values, as the authors' nodes send them: no prism constant, 0 for a distance that is missing."""
    return MeasurementMessage(
        station=measurement.station,
        status=raw_status(measurement.status),
        zenith_angle_rad=measurement.zenith_angle_rad,
        horizontal_angle_rad=measurement.horizontal_angle_rad,
        slope_distance_m=measurement.slope_distance_m or 0.0,
        time_ns=measurement.stamp_ns,
    )
