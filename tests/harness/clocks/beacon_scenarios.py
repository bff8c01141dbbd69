"""Scenarios of a station's clock between beacons, and the errors of :class:`BeaconClock` in each.

Only the clock is simulated: timestamps of beacons on both sides, measurements in between, and a station that reports their
times in its slots as in the protocol ``superframe``: new ones at once, those of an outage when there are beacons from after
it, newest first. The truth is the master's clock without jitter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsgt.radio.superframe import SESSION_INTERVAL
from tsgt.radio.superframe.master import SESSION_INTERVAL_JOINING
from tsgt.radio.superframe.station_state import FULL_TIME_FRAMES
from tsgt.radio.superframe.wire import TIME_UNIT_US
from tsgt.timesync import BeaconClock
from tsgt.timesync.dual_rate import SIGMAS

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.timesync.beacon_clock import TimeEstimate

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# At SF 9 and 250 kHz; constant but for the jitter of the chips.
_LINK_S = 1.489e-3
_LINK_SIGMA_S = 3e-6

_SLOT_S = 0.1
"""From the end of a beacon to the slot of the station."""
_BATCH = 8
"""Measurements of an outage in a reply."""
_LIVE_S = 1.0
_DIRECT_EXTRA_US = 2000.0
"""The bound of a time from a single beacon must be smaller by this than that of the fit."""

_GRID_S = 0.05
"""Interval of constant skew."""

_EARLIEST_NS = 3_600_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class BeaconScenario:
    """A station's clock and its beacons; times count from the start, in s.

    Attributes
    ----------
    drift_ppm, ramp_ppm_per_min, wander_ppm
        Skew of the station's clock, positive: it runs fast; its change per minute; one sigma of its random walk after a
        second.
    changes_ppm
        Times and sizes of steps of the skew.
    outages_s
        Start and end of intervals without beacons.
    stamp_sigma_us, stated_sigma_us
        Jitter of each timestamp on either side, and the radio's claim of it; None: the same.
    late_share, late_us
        Share of the station's timestamps that are late, and the mean of their exponentially distributed delay.
    delayed_s
        The beacons at about these times are delayed by 80 ms (delayed replay).
    loss
        Share of lost beacons.
    frame_s, measuring_s
        Interval of beacons, and of measurements.
    """

    name: str
    summary: str = ""
    drift_ppm: float = 50.0
    ramp_ppm_per_min: float = 1.0
    wander_ppm: float = 0.0
    changes_ppm: tuple[tuple[float, float], ...] = ()
    outages_s: tuple[tuple[float, float], ...] = ()
    stamp_sigma_us: float = 20.0
    stated_sigma_us: float | None = None
    late_share: float = 0.0
    late_us: float = 0.0
    delayed_s: tuple[float, ...] = ()
    loss: float = 0.0
    frame_s: float = 0.4
    measuring_s: float = 0.4007
    duration_s: float = 600.0


BEACON_SCENARIOS: tuple[BeaconScenario, ...] = (
    BeaconScenario(name="usual", summary="50 ppm, and 1 ppm more each minute"),
    BeaconScenario(name="loss", summary="the same, 20 % of the beacons lost", loss=0.2),
    BeaconScenario(name="outage", summary="no beacons for 60 s", outages_s=((300.0, 360.0),)),
    BeaconScenario(
        name="long-outage", summary="no beacons for 600 s", outages_s=((300.0, 900.0),), duration_s=1200.0
    ),
    BeaconScenario(
        name="steps",
        summary="2 ppm more, and 2 ppm less, every 20 s",
        changes_ppm=tuple((20.0 * k, 2.0 if k % 2 else -2.0) for k in range(1, 30)),
    ),
    BeaconScenario(
        name="outage-step",
        summary="no beacons for 60 s, and 10 ppm more from its middle on",
        outages_s=((300.0, 360.0),),
        changes_ppm=((330.0, 10.0),),
    ),
    BeaconScenario(name="slow-frames", summary="a frame every 2.5 s, for 16 stations", frame_s=2.5),
    BeaconScenario(name="exact", summary="stamps to 3 us", stamp_sigma_us=3.0),
    BeaconScenario(name="coarse", summary="stamps to 1 ms", stamp_sigma_us=1000.0),
    BeaconScenario(
        name="coarse-master",
        summary="stamps to 1 ms, stated as 10 us",
        stamp_sigma_us=1000.0,
        stated_sigma_us=10.0,
    ),
    BeaconScenario(
        name="late", summary="2 % of the stamps late, by 0.5 ms on average", late_share=0.02, late_us=500.0
    ),
    BeaconScenario(
        name="delayed",
        summary="a beacon delayed by 80 ms, every 20 s",
        delayed_s=tuple(np.arange(20.0, 590.0, 20.0)),
    ),
    BeaconScenario(
        name="slewed",
        summary="NTP takes 10 ms off the clock, at 500 ppm for 20 s",
        changes_ppm=((300.0, -500.0), (320.0, 500.0)),
    ),
)


class ReportedTime(NamedTuple):
    """The reported time of a measurement.

    Attributes
    ----------
    measured_s
        Its true time.
    error_us, rounded_us
        Reported less true time, before and after rounding to the unit of the radio message.
    live
        Reported within a second.
    """

    measured_s: float
    error_us: float
    rounded_us: float
    bound_us: float
    live: bool


@dataclass(frozen=True, slots=True)
class BeaconRun:
    """The outcome of a scenario: reported times in order, and the number of rejected samples."""

    times: list[ReportedTime]
    rejected: int

    def quantile_us(self, share: float, *, live: bool, since_s: float = 0.0) -> float:
        """Return a quantile of the absolute errors, rounding included, or NaN where there are none."""
        errors = [abs(t.rounded_us) for t in self.times if t.live == live and t.measured_s >= since_s]
        return float(np.quantile(errors, share)) if errors else float("nan")


def run_beacon_scenario(scenario: BeaconScenario, seed: int = 0) -> BeaconRun:
    """Run a scenario; the seed is that of jitter, losses and wander."""
    s, rng = scenario, np.random.default_rng(seed)
    local_ns = _local(s, rng)
    frames = int(s.duration_s / s.frame_s)
    true_s = s.frame_s * np.arange(frames) + rng.uniform(0.1, 0.12, frames)
    sent_us = np.rint(1e6 * true_s + rng.normal(0.0, s.stamp_sigma_us, frames)).astype(np.int64)
    delays_s = np.where(np.isin(np.arange(frames), np.searchsorted(true_s, s.delayed_s)), 0.08, 0.0)
    received_ns = local_ns(true_s + delays_s + rng.normal(_LINK_S, _LINK_SIGMA_S, frames))
    late_us = np.where(rng.random(frames) < s.late_share, rng.exponential(s.late_us, frames), 0.0)
    received_ns += np.rint(1e3 * (late_us + rng.normal(0.0, s.stamp_sigma_us, frames))).astype(np.int64)
    received = rng.random(frames) >= s.loss
    for from_s, until_s in s.outages_s:
        received &= (true_s < from_s) | (true_s >= until_s)
    measured_s = np.arange(rng.uniform(0.0, s.measuring_s), s.duration_s, s.measuring_s)
    station = _Station(s, measured_s, local_ns(measured_s))
    for frame in np.flatnonzero(received).tolist():
        if frame and received[frame - 1]:
            station.take_sample(frame, int(received_ns[frame - 1]), int(sent_us[frame - 1]))
        beacon = _Beacon(
            true_s[frame],
            int(received_ns[frame]),
            int(sent_us[frame]),
            1e6 * delays_s[frame] + late_us[frame],
        )
        station.report(beacon)
    return BeaconRun(station.times, station.rejected)


class _Beacon(NamedTuple):
    """A received beacon, ``late_us`` too late."""

    true_s: float
    received_ns: int
    sent_us: int
    late_us: float


class _Station:
    """Synchronises to beacons, and reports times in its slots."""

    def __init__(self, scenario: BeaconScenario, measured_s: Floats, at_ns: Integers) -> None:
        stated_us = scenario.stamp_sigma_us if scenario.stated_sigma_us is None else scenario.stated_sigma_us
        self._sigma_ns, self._master_sigma_us = round(1e3 * stated_us), scenario.stamp_sigma_us
        self._clock = BeaconClock()
        self._measured_s, self._at_ns = measured_s.tolist(), at_ns.tolist()
        self._queue: list[int] = []
        self._next = 0
        self.times: list[ReportedTime] = []
        self.rejected = 0

    def take_sample(self, frame: int, received_ns: int, sent_us: int) -> None:
        """Take a sample, if its session time is unambiguous."""
        every = SESSION_INTERVAL if self._clock.initialised else SESSION_INTERVAL_JOINING
        unambiguous = frame < FULL_TIME_FRAMES or frame % every == 0
        full_us = (
            sent_us if unambiguous else self._clock.unwrap(received_ns, sent_us & 0xFFFF, self._sigma_ns)
        )
        if full_us is not None:
            self.rejected += not self._clock.add(
                received_ns, full_us, self._sigma_ns, unambiguous=unambiguous
            )

    def report(self, beacon: _Beacon) -> None:
        """Report times, newest first, in the slot after a beacon."""
        while self._next < len(self._at_ns) and self._measured_s[self._next] <= beacon.true_s + _SLOT_S:
            self._queue.append(self._next)
            self._next += 1
        for _ in range(min(_BATCH, len(self._queue))):
            index = self._queue[-1]
            live = beacon.true_s - self._measured_s[index] < _LIVE_S
            known_ns = self._clock.last_received_ns
            if not live and (known_ns is None or known_ns < self._at_ns[index]):
                return
            self._queue.pop()
            self._note(index, self._time(self._at_ns[index], beacon, live=live), live=live)

    def _time(self, at_ns: int, beacon: _Beacon, *, live: bool) -> TimeEstimate:
        """Return the time from the fit, or from this beacon alone where its bound is smaller."""
        fitted = self._clock.at(at_ns)
        if fitted is not None and not live:
            return fitted
        since = self._clock.elapsed(beacon.received_ns, at_ns)
        stamp_us = SIGMAS * self._sigma_ns / 1000
        if fitted is not None and fitted.bound_us <= since.bound_us + stamp_us + _DIRECT_EXTRA_US:
            return fitted
        # The master adds the jitter of its own timestamp, and the delay of the reply.
        return since._replace(
            time_us=beacon.sent_us + since.time_us,
            bound_us=since.bound_us + stamp_us + SIGMAS * self._master_sigma_us + beacon.late_us,
        )

    def _note(self, index: int, time: TimeEstimate, *, live: bool) -> None:
        truth_us = 1e6 * (self._measured_s[index] - _LINK_S)
        rounded_us = TIME_UNIT_US * round(time.time_us / TIME_UNIT_US)
        self.times.append(
            ReportedTime(
                self._measured_s[index], time.time_us - truth_us, rounded_us - truth_us, time.bound_us, live
            )
        )


def _local(s: BeaconScenario, rng: np.random.Generator) -> Callable[[Floats], Integers]:
    """Return the conversion of true times in s to ns of the station's clock."""
    grid_s = _GRID_S * np.arange(int(s.duration_s / _GRID_S) + 20)
    skew_ppm = s.drift_ppm + s.ramp_ppm_per_min * grid_s / 60
    skew_ppm += np.cumsum(rng.normal(0.0, s.wander_ppm * _GRID_S**0.5, len(grid_s)))
    for from_s, by_ppm in s.changes_ppm:
        skew_ppm += np.where(grid_s >= from_s, by_ppm, 0.0)
    gained_us = np.concatenate([[0.0], np.cumsum(skew_ppm[:-1] * _GRID_S)])
    start_ns = _EARLIEST_NS + int(rng.integers(10**12))

    def local_ns(true_s: Floats) -> Integers:
        ns: Integers = np.rint(1e9 * true_s + 1e3 * np.interp(true_s, grid_s, gained_us)).astype(np.int64)
        return ns + start_ns

    return local_ns
