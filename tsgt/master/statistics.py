"""Counts packets, measurements and poses for the ``status`` records. Sans-I/O."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tsgt.estimation import usable
from tsgt.master.link_events import NO_LINK
from tsgt.model import NO_MEASUREMENT, NewestMeasurement, PolarMeasurement, Status
from tsgt.radio.superframe import UNKNOWN_CONDITION
from tsgt.recording import StationStatus, StatusRecord

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from tsgt.master.link_events import LinkStatus, SuperframeState
    from tsgt.model import Measurement
    from tsgt.recording import DiskStatus, ImuStatus, OdometryStatus, RecordingStatus
    from tsgt.timesync.two_way import ClockEstimate

RATE_WINDOW_NS = 10_000_000_000
LOSS_WINDOW_EXCHANGES = 50
DRAIN_WINDOW_NS = 60_000_000_000
MIN_DRAIN_SPAN_NS = 10_000_000_000
MAX_BACKLOG_SAMPLES = 61  # of a window, one a second


class Statistics:
    """Counts packets, measurements and poses of the stations that it was made for, in their order.

    ``target_checks``: Unix time in ns at which a station was last found where it was calibrated, where known.
    """

    def __init__(self, stations: Iterable[int], target_checks: Mapping[int, int] | None = None) -> None:
        checks = target_checks or {}
        self._stations = {station: _Station(checked_ns=checks.get(station)) for station in stations}
        self._poses = 0
        self._valid_poses = 0

    def exchange(self, station: int, *, responded: bool) -> None:
        """Count a request to a station, or a slot of it."""
        found = self._stations[station]
        found.responses.append(responded)
        found.answering = responded

    def radio_failed(self) -> None:
        """Record that no station can be asked."""
        for station in self._stations.values():
            station.answering = None if station.answering is None else False

    def packet(self, station: int, now_ns: int, *, rssi_dbm: float, snr_db: float) -> None:
        """Record the reception of a station's packet."""
        found = self._stations[station]
        found.received_ns, found.rssi_dbm, found.snr_db = now_ns, rssi_dbm, snr_db

    def tracked_prism(self, station: int, prism: int | None) -> None:
        """Record the prism that a station reports to track; None: it does not track."""
        self._stations[station].prism = prism

    def superframe_state(self, state: SuperframeState) -> None:
        """Record the state of a station in the protocol superframe."""
        self._stations[state.station].superframe = state

    def measurement(self, measurement: Measurement) -> None:
        """Count a measurement; one of an unknown station is ignored."""
        station = self._stations.get(measurement.station)
        if station is None:
            return
        station.measurements += 1
        station.first_ns = station.first_ns or measurement.received_ns
        station.usable += usable(measurement)
        if not station.newest.is_newer_than(measurement):
            station.newest = NewestMeasurement.of(measurement)
            station.stamp_ns, station.status = measurement.stamp_ns, measurement.status
            if isinstance(measurement, PolarMeasurement):
                station.stamp_bound_ns = measurement.stamp_bound_ns
        station.arrivals_ns.append(measurement.received_ns)

    def outside_lag_window(self, counts: Mapping[int, int]) -> None:
        """Record by station how many measurements arrived outside the lag window so far."""
        for number, station in self._stations.items():
            station.outside_lag_window = counts.get(number, 0)

    def pose(self, *, valid: bool) -> None:
        """Count a pose."""
        self._poses += 1
        self._valid_poses += valid

    def status(
        self,
        now_ns: int,
        link: LinkStatus = NO_LINK,
        imu: ImuStatus | None = None,
        recording: RecordingStatus | None = None,
        disk: DiskStatus | None = None,
        odometry: OdometryStatus | None = None,
    ) -> StatusRecord:
        """Return the status at an instant on the master's Unix clock."""
        stations = (
            station.status_at(number, now_ns, link.clock(number, now_ns))
            for number, station in self._stations.items()
        )
        return StatusRecord(
            stamp_ns=now_ns,
            poses=self._poses,
            valid_poses=self._valid_poses,
            stations=tuple(stations),
            protocol=link.protocol,
            authenticated=link.authenticated,
            frame_ms=link.frame_ms,
            imu=imu,
            odometry=odometry,
            recording=recording,
            disk=disk,
        )


@dataclass(slots=True)
class _Station:
    """Counters of one station; instants on the master's Unix clock in ns."""

    measurements: int = 0
    usable: int = 0
    newest: NewestMeasurement = NO_MEASUREMENT
    stamp_ns: int | None = None
    stamp_bound_ns: int | None = None
    status: Status | None = None
    prism: int | None = None
    received_ns: int | None = None
    rssi_dbm: float | None = None
    snr_db: float | None = None
    answering: bool | None = None
    responses: deque[bool] = field(default_factory=lambda: deque(maxlen=LOSS_WINDOW_EXCHANGES))
    arrivals_ns: deque[int] = field(default_factory=deque)
    first_ns: int = 0
    superframe: SuperframeState | None = None
    outside_lag_window: int | None = None
    checked_ns: int | None = None
    backlog: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=MAX_BACKLOG_SAMPLES))

    def status_at(self, number: int, now_ns: int, clock: ClockEstimate | None) -> StationStatus:
        while self.arrivals_ns and self.arrivals_ns[0] <= now_ns - RATE_WINDOW_NS:
            self.arrivals_ns.popleft()
        state = self.superframe
        condition = UNKNOWN_CONDITION if state is None else state.condition
        drain_rate_hz = (
            None if state is None or not state.joined else self._drain_rate_hz(now_ns, state.outstanding)
        )
        return StationStatus(
            id=number,
            measurements=self.measurements,
            usable=self.usable,
            age_s=_age_s(self.stamp_ns, now_ns),
            status=self.status,
            prism=self.prism,
            locked=None if self.status is None else self.status.has_target,
            last_heard_s=_age_s(self.received_ns, now_ns),
            answering=self.answering,
            rate_hz=self._rate_hz(now_ns),
            loss=1 - sum(self.responses) / len(self.responses) if self.responses else None,
            rssi_dbm=self.rssi_dbm,
            snr_db=self.snr_db,
            clock_offset_ns=None if clock is None else clock.offset_ns,
            clock_bound_ns=None if clock is None else clock.bound_ns,
            stamp_bound_ns=self.stamp_bound_ns,
            joined=None if state is None else state.joined,
            outstanding=None if state is None else state.outstanding,
            drain_rate_hz=drain_rate_hz,
            drain_s=None
            if state is None or not drain_rate_hz or drain_rate_hz < 0
            else state.outstanding / drain_rate_hz,
            missed_slots=None if state is None else state.missed_slots,
            rejected_beacons=None if state is None else state.rejected_beacons,
            outside_lag_window=self.outside_lag_window,
            battery_percent=condition.battery_percent,
            atmospheric_ppm=condition.atmospheric_ppm,
            activity=condition.activity,
            problem=condition.problem,
            last_target_check_age_s=_age_s(self.checked_ns, now_ns),
        )

    def _drain_rate_hz(self, now_ns: int, outstanding: int) -> float | None:
        samples = self.backlog
        if not samples or now_ns - samples[-1][0] >= MIN_DRAIN_SPAN_NS // 10:
            samples.append((now_ns, outstanding))
        while samples[0][0] <= now_ns - DRAIN_WINDOW_NS:
            samples.popleft()
        span_ns = now_ns - samples[0][0]
        return None if span_ns < MIN_DRAIN_SPAN_NS else (samples[0][1] - outstanding) / (span_ns / 1e9)

    def _rate_hz(self, now_ns: int) -> float | None:
        if not self.measurements:
            return None
        # The window starts at the first measurement and spans at least one second.
        span_ns = min(RATE_WINDOW_NS, max(now_ns - self.first_ns, 1_000_000_000))
        return len(self.arrivals_ns) / (span_ns / 1e9)


def _age_s(instant_ns: int | None, now_ns: int) -> float | None:
    return None if instant_ns is None else (now_ns - instant_ns) / 1e9
