"""What came from each station, counted: the content of the ``status`` lines. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from tsgt.estimation import usable
from tsgt.model import PolarMeasurement, Status
from tsgt.recording import StationStatus, StatusRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from tsgt.model import Measurement
    from tsgt.timesync.two_way import ClockEstimate

RATE_WINDOW_NS = 10_000_000_000
LOSS_REQUESTS = 50

_LOCKED = (Status.OK, Status.LOW_ACCURACY, Status.ANGLE_ONLY)


class Monitor:
    """Counts requests, measurements and poses for the next status line.

    Parameters
    ----------
    stations
        Numbers of the stations to report on, in the order of the report.
    """

    def __init__(self, stations: Iterable[int]) -> None:
        self._stations = {station: _Station() for station in stations}
        self._poses = 0
        self._valid_poses = 0

    def asked(self, station: int, *, answered: bool) -> None:
        """Count a turn of a station on the radio."""
        self._stations[station].answers.append(answered)

    def heard(self, station: int, now_ns: int, *, rssi_dbm: float, snr_db: float) -> None:
        """Take note of a radio message of a station."""
        found = self._stations[station]
        found.heard_ns, found.rssi_dbm, found.snr_db = now_ns, rssi_dbm, snr_db

    def tracks(self, station: int, prism: int | None) -> None:
        """Take note of the prism that a station says it tracks; None: it does not."""
        self._stations[station].prism = prism

    def stands(
        self, station: int, *, joined: bool, outstanding: int, missed_slots: int, rejected_beacons: int
    ) -> None:
        """Take note of how a station stands in the protocol superframe; see :class:`StationStatus`."""
        found = self._stations[station]
        found.joined, found.outstanding = joined, outstanding
        found.missed_slots, found.rejected_beacons = missed_slots, rejected_beacons

    def measurement(self, measurement: Measurement) -> None:
        """Count a measurement; one of a station that is not reported on is passed over."""
        station = self._stations.get(measurement.station)
        if station is None:
            return
        station.measurements += 1
        station.first_ns = station.first_ns or measurement.received_ns
        station.usable += usable(measurement)
        late = measurement.sequence < station.sequence and measurement.stamp_ns < (station.stamp_ns or 0)
        if not late:
            station.sequence = measurement.sequence
            station.stamp_ns, station.status = measurement.stamp_ns, measurement.status
            if isinstance(measurement, PolarMeasurement):
                station.stamp_bound_ns = measurement.stamp_bound_ns
        station.arrivals_ns.append(measurement.received_ns)

    def outside_lag_window(self, counts: Mapping[int, int]) -> None:
        """Take note of how many measurements of each station came too late for the estimator so far."""
        for number, station in self._stations.items():
            station.outside_lag_window = counts.get(number, 0)

    def pose(self, *, valid: bool) -> None:
        """Count a pose."""
        self._poses += 1
        self._valid_poses += valid

    def status(
        self,
        now_ns: int,
        *,
        clock: Callable[[int, int], ClockEstimate | None] = lambda _station, _now_ns: None,
        protocol: Literal["classic", "superframe"] | None = None,
        authenticated: bool | None = None,
        frame_ms: float | None = None,
    ) -> StatusRecord:
        """Report what was counted so far.

        Parameters
        ----------
        now_ns
            The present on the master's Unix clock.
        clock
            Returns what a station's clock shows against the master's at an instant; None while nobody knows.
        protocol, authenticated, frame_ms
            See :class:`~tsgt.recording.stream_records.StatusRecord`.
        """
        stations = (
            station.status_at(number, now_ns, clock(number, now_ns))
            for number, station in self._stations.items()
        )
        return StatusRecord(
            stamp_ns=now_ns,
            poses=self._poses,
            valid_poses=self._valid_poses,
            stations=tuple(stations),
            protocol=protocol,
            authenticated=authenticated,
            frame_ms=frame_ms,
        )


@dataclass(slots=True)
class _Station:
    """What is known of one station; instants on the master's Unix clock in ns."""

    measurements: int = 0
    usable: int = 0
    sequence: int = -1
    stamp_ns: int | None = None
    stamp_bound_ns: int | None = None
    status: Status | None = None
    prism: int | None = None
    heard_ns: int | None = None
    rssi_dbm: float | None = None
    snr_db: float | None = None
    answers: deque[bool] = field(default_factory=lambda: deque(maxlen=LOSS_REQUESTS))
    arrivals_ns: deque[int] = field(default_factory=deque)
    first_ns: int = 0
    joined: bool | None = None
    outstanding: int | None = None
    missed_slots: int | None = None
    rejected_beacons: int | None = None
    outside_lag_window: int | None = None

    def status_at(self, number: int, now_ns: int, clock: ClockEstimate | None) -> StationStatus:
        while self.arrivals_ns and self.arrivals_ns[0] <= now_ns - RATE_WINDOW_NS:
            self.arrivals_ns.popleft()
        return StationStatus(
            id=number,
            measurements=self.measurements,
            usable=self.usable,
            age_s=_age_s(self.stamp_ns, now_ns),
            status=self.status,
            prism=self.prism,
            locked=None if self.status is None else self.status in _LOCKED,
            last_heard_s=_age_s(self.heard_ns, now_ns),
            answering=self.answers[-1] if self.answers else None,
            rate_hz=self._rate_hz(now_ns),
            loss=1 - sum(self.answers) / len(self.answers) if self.answers else None,
            rssi_dbm=self.rssi_dbm,
            snr_db=self.snr_db,
            clock_offset_ns=None if clock is None else clock.offset_ns,
            clock_bound_ns=None if clock is None else clock.bound_ns,
            stamp_bound_ns=self.stamp_bound_ns,
            joined=self.joined,
            outstanding=self.outstanding,
            missed_slots=self.missed_slots,
            rejected_beacons=self.rejected_beacons,
            outside_lag_window=self.outside_lag_window,
        )

    def _rate_hz(self, now_ns: int) -> float | None:
        if not self.measurements:
            return None
        # The first measurement begins the count, and one second is the shortest that a rate is taken over.
        span_ns = min(RATE_WINDOW_NS, max(now_ns - self.first_ns, 1_000_000_000))
        return len(self.arrivals_ns) / (span_ns / 1e9)


def _age_s(instant_ns: int | None, now_ns: int) -> float | None:
    return None if instant_ns is None else (now_ns - instant_ns) / 1e9
