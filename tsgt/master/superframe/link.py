"""The master's side of the protocol superframe: runs frames, reports and acknowledges what the replies carry."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import structlog

from tsgt.master import link_events
from tsgt.master.superframe.frame_loop import FrameLoop
from tsgt.model import MAX_INSTANT_NS, PolarMeasurement
from tsgt.radio import SearchCommand, TrackCommand
from tsgt.radio.superframe import FrameTiming, PhaseLock, SuperframeMaster
from tsgt.radio.superframe.wire import Authenticator
from tsgt.recording import BeaconRecord
from tsgt.service import LogLimiter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.config import StationConfig, SuperframeMasterConfig
    from tsgt.master.reacquisition_hints import ReacquisitionHints
    from tsgt.master.recording_thread import RecordingThread
    from tsgt.radio import Direction, LoRaSettings, Packet, Radio, Transmission
    from tsgt.radio.superframe import ReceivedReply, TimedMeasurement

SYNC_TIMEOUT_S = 0.06
"""How long a beacon waits for the last reply to be on the disk. Acknowledging a frame later costs retransmissions, which make
frames of three stations 110 ms longer."""

TRACK_RETRY_INTERVAL_NS = 30_000_000_000  # between two commands to track, while a station does not

log = structlog.get_logger()


class _Unsynced(NamedTuple):
    """A measurement, and the number of its line in the recording."""

    station: int
    sequence: int
    line: int


class SuperframeLink:
    """Runs frames and reports results; ``exchange_start_ns``: when the present one began, None without a radio."""

    def __init__(
        self,
        stations: Sequence[StationConfig],
        protocol: SuperframeMasterConfig,
        settings: LoRaSettings,
        clock: Clock,
        timeline: UnixTimeline,
        report: link_events.Report,
        recording: RecordingThread,
        hints: ReacquisitionHints,
        *,
        key: bytes | None,
        random_bits: Callable[[int], int],
    ) -> None:
        prisms = {station.station: station.prism for station in stations}
        timing = superframe_timing(protocol, settings)
        self._prisms = prisms
        self._authenticated = key is not None
        self._clock = clock
        self._timeline = timeline
        self._report = report
        self._recording = recording
        self._hints = hints
        self._master = SuperframeMaster(
            prisms,
            timing,
            Authenticator(key),
            random_bits,
            clock.monotonic_ns(),
            phase_lock=PhaseLock(timing, max(prisms)) if protocol.phase_lock else None,
        )
        self._unsynced: deque[_Unsynced] = deque()
        self._track_commanded_ns: dict[int, int] = {}
        self._directions: dict[int, Direction] = {}
        self._beacons_ns: deque[int] = deque(maxlen=16)
        self._other_beacons = 0
        self._log_limiter = LogLimiter()
        self.exchange_start_ns: int | None = None
        if key is None:
            log.warning("unauthenticated", key_file=protocol.key_file)
            message = "the radio has no key: anyone can send measurements and beacons; make one with `tsgt radio key`"
            report(link_events.MasterEvent("unauthenticated", message))

    def status(self) -> link_events.LinkStatus:
        """Return what the status record states about the link."""
        return link_events.LinkStatus(
            protocol="superframe", authenticated=self._authenticated, frame_ms=self._frame_ms()
        )

    async def run(self, radio: Radio) -> None:
        """Run frames until the radio raises RadioError."""
        try:
            await FrameLoop(radio, self._clock, self._master, self).run()
        finally:
            self.exchange_start_ns = None

    # --- FrameObserver ----------------------------------------------------------------------------------------------

    async def ready(self) -> None:
        """Wait a little for the disk to have the last replies; what it gets later is acknowledged a frame later."""
        self.exchange_start_ns = self._now_ns()
        self._acknowledge()
        if self._unsynced:
            await self._recording.sync(SYNC_TIMEOUT_S)
            self._acknowledge()
        self._send_hints()

    def composing(self) -> None:
        """Acknowledge what reached the disk while the beacon was due."""
        self._acknowledge()

    def beacon_sent(self, sent: Transmission) -> None:
        """Report a beacon: merging a journal later needs its time."""
        stamp_ns = self._timeline.unix_ns(sent.done_at_ns)
        self._beacons_ns.append(stamp_ns)
        record = BeaconRecord(
            stamp_ns=stamp_ns,
            stamp_sigma_ns=sent.stamp_sigma_ns,
            session=self._master.session,
            counter=self._master.counter,
        )
        self._report(link_events.BeaconSent(record))

    def received(self, reply: ReceivedReply, packet: Packet) -> None:
        """Report a reply."""
        report, now_ns, station = self._report, self._now_ns(), reply.station
        report(link_events.StationResponded(station, packet.rssi_dbm, packet.snr_db))
        if reply.joined:
            log.info("station_joined", station=station)
        received_ns = self._timeline.unix_ns(packet.received_at_ns)
        report(link_events.ReplyReceived(station))
        for timed in reply.measurements:
            measurement = self._measurement(station, timed, received_ns)
            report(link_events.MeasurementReceived(measurement))
            self._unsynced.append(_Unsynced(station, timed.sequence, self._recording.measurement_line))
            self._hints.measured(measurement)
        if reply.rejected_beacons:
            report(link_events.BeaconTimeRejected(station, reply.rejected_beacons))
        if reply.link_delay_anomaly:
            report(link_events.LinkDelayAnomaly(station))
        self._report_state(reply, now_ns)

    def not_received(self, stations: Sequence[int]) -> None:
        """Report the stations whose slots stayed empty."""
        for station in stations:
            self._report(link_events.NoResponse(station))
        if self._master.other_beacons != self._other_beacons:
            self._other_beacons = self._master.other_beacons
            if self._log_limiter.allows("other_master", self._clock.monotonic_ns()):
                message = (
                    "beacons of another session arrive that have this master's key: switch the other master off, "
                    "or somebody replays recorded packets"
                )
                self._report(link_events.MasterEvent("other_master", message))

    # ----------------------------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())

    def _frame_ms(self) -> float | None:
        """Return the mean duration of the last frames, from beacon to beacon; None before the second beacon."""
        if len(self._beacons_ns) < 2:
            return None
        return (self._beacons_ns[-1] - self._beacons_ns[0]) / (len(self._beacons_ns) - 1) / 1e6

    def _acknowledge(self) -> None:
        """Mark measurements that are on the disk, or lost, for the next acknowledgement: a power cut takes none of them back."""
        while self._unsynced and (synced := self._recording.synced(self._unsynced[0].line)) is not None:
            unsynced = self._unsynced.popleft()
            window = self._master.station(unsynced.station).window
            (window.mark_written if synced else window.mark_lost)((unsynced.sequence,))

    def _report_state(self, reply: ReceivedReply, now_ns: int) -> None:
        """Report the state of a station, and command one to track that does not track its prism."""
        station, prism = reply.station, self._prisms[reply.station]
        state, status = self._master.station(station), reply.status_report
        self._report(
            link_events.SuperframeState(
                station,
                joined=not state.join_pending,
                outstanding=state.window.outstanding,
                missed_slots=state.missed_slots,
                rejected_beacons=state.rejected_beacons,
                condition=state.condition,
            )
        )
        if reply.response is not None and isinstance(reply.command, TrackCommand):
            self._report(link_events.TrackingResult(station, prism, reply.response.ok))
        if status is None:
            return
        tracked = None if status.direct else status.prism
        self._report(link_events.TrackedPrism(station, tracked))
        if tracked == prism:
            self._report(link_events.TrackingResult(station, prism, tracks=True))
        elif (
            now_ns - self._track_commanded_ns.get(station, -TRACK_RETRY_INTERVAL_NS)
            >= TRACK_RETRY_INTERVAL_NS
        ):
            self._track_commanded_ns[station] = now_ns
            self._master.station(station).submit(TrackCommand(prism))

    def _send_hints(self) -> None:
        """Command stations that have lost their prism to search for it; withdraw commands that are out of date."""
        now_ns = self._now_ns()
        for station, prism in self._prisms.items():
            state = self._master.station(station)
            direction = self._hints.direction(station, now_ns) if state.is_tracking(prism) else None
            if direction is None:
                state.withdraw(SearchCommand)
            elif direction is not self._directions.get(station):
                self._directions[station] = direction
                self._master.station(station).submit(SearchCommand(direction))
                log.info(
                    "search_commanded",
                    station=station,
                    horizontal_deg=round(math.degrees(direction.horizontal_angle_rad), 2),
                    zenith_deg=round(math.degrees(direction.zenith_angle_rad), 2),
                    spread_deg=round(math.degrees(direction.spread_rad), 2),
                )

    def _measurement(self, station: int, timed: TimedMeasurement, received_ns: int) -> PolarMeasurement:
        true_ns = self._timeline.unix_ns(timed.measured_ns)
        # The clock of a master may show 1970; measurements from before its start then have negative times.
        stamp_ns = min(max(true_ns, 0), MAX_INSTANT_NS)
        return PolarMeasurement(
            station=station,
            prism=timed.prism,
            sequence=timed.sequence,
            stamp_ns=stamp_ns,
            stamp_sigma_ns=timed.sigma_ns,
            stamp_bound_ns=timed.bound_ns + abs(stamp_ns - true_ns),
            received_ns=received_ns,
            horizontal_angle_rad=timed.horizontal_angle_rad,
            zenith_angle_rad=timed.zenith_angle_rad,
            slope_distance_m=timed.slope_distance_m,
            status=timed.status,
            host_time_ns=None,
        )


def superframe_timing(protocol: SuperframeMasterConfig, settings: LoRaSettings) -> FrameTiming:
    """Return the frame timing of a configuration."""
    return FrameTiming.from_tolerances(
        settings,
        start_jitter_ns=round(protocol.start_jitter_ms * 1e6),
        turnaround_ns=round(protocol.turnaround_ms * 1e6),
        clock_error_ppm=protocol.clock_error_ppm,
    )
