"""The protocol superframe as the master runs it: frames, one after the other, and what replies bring put away."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import structlog

from tsgt.master.superframe.frame_loop import FrameLoop
from tsgt.model import LAST_INSTANT_NS, PolarMeasurement
from tsgt.radio import SearchCommand, TrackCommand
from tsgt.radio.superframe import PhaseLock, FrameTiming, SuperframeMaster
from tsgt.radio.superframe.wire import Authenticator
from tsgt.recording import BeaconRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.config import StationConfig, SuperframeMasterConfig
    from tsgt.master.publisher import Reports
    from tsgt.master.reacquisition_hints import Searches
    from tsgt.master.recording_thread import Disk
    from tsgt.radio import Direction, LoRaSettings, Packet, Radio, Transmission
    from tsgt.radio.superframe import TimedMeasurement
    from tsgt.radio.superframe.reception import ReceivedReply
    from tsgt.recording import StatusRecord

DISK_PATIENCE_S = 0.015
"""A beacon waits so long for the disk to take the last reply. Acknowledging it a frame later costs a repetition."""

TRACK_AGAIN_NS = 30_000_000_000
"""From one order to track to the next, while a station does not."""

log = structlog.get_logger()


class _Unwritten(NamedTuple):
    """The measurements of a reply, and the lines that have to be written before they are."""

    station: int
    sequences: tuple[int, ...]
    lines: range


class SuperframeLink:
    """Runs frames, and reports what they bring.

    Parameters
    ----------
    stations, protocol
        What the configuration says of them.
    settings
        Of the modem.
    disk
        Where the measurements that are reported end up.
    reports
        Told of all that happens.
    searches
        Says where stations that have lost their prism are to look for it.
    key
        Of the mission; None: anybody can take part.
    random_bits
        For nonces.

    Attributes
    ----------
    turn_ns
        When the present frame began, on the master's Unix clock; None without a radio.
    """

    def __init__(
        self,
        stations: Sequence[StationConfig],
        protocol: SuperframeMasterConfig,
        settings: LoRaSettings,
        disk: Disk,
        reports: Reports,
        searches: Searches,
        *,
        key: bytes | None,
        random_bits: Callable[[int], int],
    ) -> None:
        prisms = {station.station: station.prism for station in stations}
        timing = superframe_timing(protocol, settings)
        self._prisms = prisms
        self._authentic = key is not None
        self._disk = disk
        self._reports = reports
        self._searches = searches
        self._master = SuperframeMaster(
            prisms,
            timing,
            Authenticator(key),
            random_bits,
            reports.clock.monotonic_ns(),
            lock=PhaseLock(timing, max(prisms)) if protocol.phase_lock else None,
        )
        self._unwritten: deque[_Unwritten] = deque()
        self._tracking_ns: dict[int, int] = {}
        self._sought: dict[int, Direction] = {}
        self._beacons_ns: deque[int] = deque(maxlen=16)
        self.turn_ns: int | None = None
        if key is None:
            log.warning("unauthenticated", key_file=protocol.key_file)
            reports.event(
                "unauthenticated",
                "the radio has no key: anybody can send measurements and beacons; make one with `tsgt radio key`",
            )

    def status(self, now_ns: int) -> StatusRecord:
        """Report how the frames and the stations do at an instant on the master's Unix clock."""
        return self._reports.monitor.status(
            now_ns, protocol="superframe", authenticated=self._authentic, frame_ms=self._frame_ms()
        )

    async def run(self, radio: Radio) -> None:
        """Run frames for as long as the radio does.

        Raises
        ------
        RadioError
            It does no more.
        """
        try:
            await FrameLoop(radio, self._reports.clock, self._master, self).run()
        finally:
            self.turn_ns = None

    # --- What the frame loop says ---------------------------------------------------------------------------------

    async def ready(self) -> None:
        """Give the disk its time; then go on, written or not."""
        self.turn_ns = self._reports.now_ns()
        self._settle()
        while self._unwritten and await self._disk.flushed(DISK_PATIENCE_S):
            self._settle()
        self._search()

    def composing(self) -> None:
        """Tell what has been written while the beacon was waited for."""
        self._settle()

    def beacon(self, sent: Transmission) -> None:
        """Put a beacon on the stream and into the recording, for who merges journals later."""
        stamp_ns = self._reports.timeline.unix_ns(sent.done_at_ns)
        self._beacons_ns.append(stamp_ns)
        self._reports.outlet.put(
            BeaconRecord(
                stamp_ns=stamp_ns,
                stamp_sigma_ns=sent.stamp_sigma_ns,
                session=self._master.session,
                counter=self._master.counter,
            )
        )

    def heard(self, heard: ReceivedReply, packet: Packet) -> None:
        """Hand on what a reply brought."""
        reports, now_ns, station = self._reports, self._reports.now_ns(), heard.station
        reports.monitor.asked(station, answered=True)
        reports.events(reports.alerts.asked(station, now_ns, answered=True))
        reports.monitor.heard(station, now_ns, rssi_dbm=packet.rssi_dbm, snr_db=packet.snr_db)
        if heard.joined:
            log.info("station_joined", station=station)
        first_line = self._disk.taken
        received_ns = reports.timeline.unix_ns(packet.received_at_ns)
        reports.events(reports.alerts.polled(station, now_ns))
        for sighting in heard.measurements:
            measurement = self._measurement(station, sighting, received_ns)
            reports.measured(measurement)
            self._searches.measured(measurement)
        if heard.measurements:
            sequences = tuple(sighting.sequence for sighting in heard.measurements)
            self._unwritten.append(_Unwritten(station, sequences, range(first_line, self._disk.taken)))
        if heard.rejected_beacons:
            reports.events(reports.alerts.beacon_time_rejected(station, now_ns, heard.rejected_beacons))
        if heard.link_delay_anomaly:
            reports.events(reports.alerts.link_delay_anomaly(station, now_ns))
        self._stand(heard, now_ns)

    def silent(self, stations: Sequence[int]) -> None:
        """Count what did not come."""
        for station in stations:
            self._reports.monitor.asked(station, answered=False)
            self._reports.events(self._reports.alerts.asked(station, self._reports.now_ns(), answered=False))

    # --- Small things -----------------------------------------------------------------------------------------------

    def _frame_ms(self) -> float | None:
        """Return the mean of the last frames, from beacon to beacon; None before the second."""
        if len(self._beacons_ns) < 2:
            return None
        return (self._beacons_ns[-1] - self._beacons_ns[0]) / (len(self._beacons_ns) - 1) / 1e6

    def _settle(self) -> None:
        """Tell the master what the disk has taken, and what it has lost."""
        while self._unwritten and (written := self._disk.written(self._unwritten[0].lines)) is not None:
            reply = self._unwritten.popleft()
            window = self._master.station(reply.station).delivery.window
            (window.mark_written if written else window.mark_lost)(reply.sequences)

    def _stand(self, heard: ReceivedReply, now_ns: int) -> None:
        """Report how a station stands, and put one to work that does not track its prism."""
        reports, station = self._reports, heard.station
        station_state, prism = self._master.station(station), self._prisms[station]
        reports.monitor.stands(
            station,
            joined=not station_state.introducing,
            outstanding=station_state.delivery.window.outstanding,
            missed_slots=station_state.missed_slots,
            rejected_beacons=station_state.rejected_beacons,
        )
        if heard.response is not None and isinstance(heard.command, TrackCommand):
            reports.events(reports.alerts.ordered(station, prism, now_ns, tracks=heard.response.ok))
        if heard.status_report is None:
            return
        tracks = not heard.status_report.direct and heard.status_report.prism == prism
        reports.monitor.tracks(station, None if heard.status_report.direct else heard.status_report.prism)
        if tracks:
            reports.events(reports.alerts.ordered(station, prism, now_ns, tracks=True))
        elif now_ns - self._tracking_ns.get(station, -TRACK_AGAIN_NS) >= TRACK_AGAIN_NS:
            self._tracking_ns[station] = now_ns
            self._master.command(station, TrackCommand(prism))

    def _search(self) -> None:
        """Tell stations that have lost their prism where to look for it, and no more what has grown old."""
        now_ns = self._reports.now_ns()
        for station, prism in self._prisms.items():
            station_state = self._master.station(station)
            towards = self._searches.towards(station, now_ns) if station_state.is_tracking(prism) else None
            if towards is None:
                station_state.withdraw(SearchCommand)
            elif towards is not self._sought.get(station):
                self._sought[station] = towards
                self._master.command(station, SearchCommand(towards))
                log.info(
                    "search_ordered",
                    station=station,
                    horizontal_deg=round(math.degrees(towards.horizontal_angle_rad), 2),
                    zenith_deg=round(math.degrees(towards.zenith_angle_rad), 2),
                    spread_deg=round(math.degrees(towards.spread_rad), 2),
                )

    def _measurement(self, station: int, sighting: TimedMeasurement, received_ns: int) -> PolarMeasurement:
        true_ns = self._reports.timeline.unix_ns(sighting.measured_ns)
        # A master that believes to have started in 1970 may get measurements from before.
        stamp_ns = min(max(true_ns, 0), LAST_INSTANT_NS)
        return PolarMeasurement(
            station=station,
            prism=sighting.prism,
            sequence=sighting.sequence,
            stamp_ns=stamp_ns,
            stamp_sigma_ns=sighting.sigma_ns,
            stamp_bound_ns=sighting.bound_ns + abs(stamp_ns - true_ns),
            received_ns=received_ns,
            horizontal_angle_rad=sighting.horizontal_angle_rad,
            zenith_angle_rad=sighting.zenith_angle_rad,
            slope_distance_m=sighting.slope_distance_m,
            status=sighting.status,
            host_time_ns=None,
        )


def superframe_timing(protocol: SuperframeMasterConfig, settings: LoRaSettings) -> FrameTiming:
    """Return how long the parts of a frame last, as the configuration states."""
    return FrameTiming.stated(
        settings,
        start_jitter_ns=round(protocol.start_jitter_ms * 1e6),
        turnaround_ns=round(protocol.turnaround_ms * 1e6),
        clock_error_ppm=protocol.clock_error_ppm,
    )
