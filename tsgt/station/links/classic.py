"""The classic link of a station: replies at once to each request of the paper's polling protocol."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NoReturn

import structlog

from tsgt.errors import RadioError
from tsgt.model import Status
from tsgt.radio import SearchCommand
from tsgt.radio.classic import TURNAROUND_NS, ClassicStation, MeasurementMessage, decode_command, raw_status
from tsgt.station.links.traffic_monitor import UnknownTrafficMonitor
from tsgt.station.status import LinkStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from tsgt.clock import Clock, SuspensionWatch, UnixTimeline
    from tsgt.model import PolarMeasurement
    from tsgt.radio import Command, DirectCommand, Packet, Radio, TrackCommand
    from tsgt.recording.journal import TargetRecord
    from tsgt.station.session import ClientSession

RESPONSE_TIMEOUT_NS = 20_000_000_000
"""A later response is not sent: the master has given up and polls other stations."""

MAX_EDGE_SIGMA_NS = 1_000_000
"""The jitter of edges from RPi.GPIO. A packet found without its edge has a timestamp uncertain by tens of ms."""

log = structlog.get_logger()


class ClassicLink:
    """The asyncio half of :class:`~tsgt.radio.classic.ClassicStation`; a :class:`~tsgt.station.links.base.Link`.

    Parameters
    ----------
    session
        Supplies mode and prism.
    on_command
        Called with each command of the master.
    create_task
        Runs a coroutine concurrently with the radio's task, which keeps replying.
    """

    def __init__(
        self,
        session: ClientSession,
        clock: Clock,
        watch: SuspensionWatch,
        timeline: UnixTimeline,
        *,
        on_command: Callable[[Command], None],
        create_task: Callable[[Coroutine[Any, Any, None]], object],
    ) -> None:
        self._session = session
        self._clock = clock
        self._watch = watch
        self._timeline = timeline
        self._on_command = on_command
        self._create_task = create_task
        self._station = ClassicStation(session.station)
        self._radio: Radio | None = None
        self._last_packet: Packet | None = None
        self._traffic_monitor = UnknownTrafficMonitor(clock)
        self._command_ns = 0

    def offer(self, measurement: PolarMeasurement) -> None:
        """Reply with this measurement from now on, unless mode or prism have changed while the disk delayed it."""
        if self._session.mode == "tracking" and measurement.prism == self._session.prism:
            self._station.measured(_message(measurement))

    def respond(self, command: TrackCommand | SearchCommand | DirectCommand, *, ok: bool) -> None:
        """Send the response; this protocol has no search command."""
        if not isinstance(command, SearchCommand):
            self._send_response(self._station.executed(command, ok=ok))

    def respond_single(self, target: TargetRecord | None) -> None:
        """Send a single measurement, or an error status."""
        message = (
            _message(target)
            if target is not None
            else MeasurementMessage(
                station=self._session.station,
                status=raw_status(Status.ERROR),
                zenith_angle_rad=0.0,
                horizontal_angle_rad=0.0,
                slope_distance_m=0.0,
                time_ns=self._now_ns(),
            )
        )
        self._send_response(self._station.single_measured(message))

    def _send_response(self, payload: bytes) -> None:
        late_ns = self._now_ns() - self._command_ns
        if self._radio is None or late_ns > RESPONSE_TIMEOUT_NS:
            log.warning("response_not_sent", late_s=late_ns / 1e9)
            return
        self._create_task(self._transmit(self._radio, payload))

    async def _transmit(self, radio: Radio, payload: bytes) -> None:
        try:
            await radio.transmit(payload)
        except RadioError as error:
            log.warning("response_not_sent", error=str(error))

    async def run(self, radio: Radio) -> NoReturn:
        """Reply to each request; nothing here waits for anything but the radio.

        Raises ComputerSuspendedError after a suspension: no reply mixes times from before and after it. Raises RadioError.
        """
        self._radio = radio
        try:
            while True:
                packet = await radio.receive()
                self._watch.check()
                if self._clock.monotonic_ns() - packet.received_at_ns > TURNAROUND_NS:
                    # This computer was busy; the master polls another station by now.
                    log.warning("request_expired")
                    continue
                await self._received(packet, radio)
        finally:
            self._radio = None

    async def _received(self, packet: Packet, radio: Radio) -> None:
        message = decode_command(packet.payload)
        self._traffic_monitor.received(from_master=message is not None)
        if message is not None and message.station == self._session.station:
            self._last_packet = packet
        received_ns = self._timeline.unix_ns(packet.received_at_ns)
        if packet.stamp_sigma_ns > MAX_EDGE_SIGMA_NS:
            # The master's offset bounds require timestamps that are never early. A late one lengthens the exchange and
            # so widens the bound.
            received_ns = self._now_ns()
        reply = self._station.received(packet.payload, received_ns)
        if isinstance(reply, bytes):
            await radio.transmit(reply)
        elif reply is not None:
            self._command_ns = received_ns
            self._on_command(reply)

    def status(self) -> LinkStatus:
        """Return the link's current status."""
        packet = self._last_packet
        return LinkStatus(
            protocol="classic",
            master_received_ns=None if packet is None else self._timeline.unix_ns(packet.received_at_ns),
            rssi_dbm=None if packet is None else packet.rssi_dbm,
            snr_db=None if packet is None else packet.snr_db,
            unknown_packets=self._traffic_monitor.packets,
        )

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())


def _message(measurement: PolarMeasurement | TargetRecord) -> MeasurementMessage:
    """Encode raw values as the authors' nodes do: no prism constant, 0 for a missing distance."""
    return MeasurementMessage(
        station=measurement.station,
        status=raw_status(measurement.status),
        zenith_angle_rad=measurement.zenith_angle_rad,
        horizontal_angle_rad=measurement.horizontal_angle_rad,
        slope_distance_m=measurement.slope_distance_m or 0.0,
        time_ns=measurement.stamp_ns,
    )
