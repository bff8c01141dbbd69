"""Ten scenarios of a station's clock, and the errors of the master's clock filters in each.

Only the clock is simulated: synchronisations of the protocol ``classic`` at the paper's modem settings, on the master's
schedule (50 cycles at the start, then 5 cycles after 30, 90, 270 s, and from then on every 300 s; with the paper's filter
every 300 s from the start), and in between a measurement at each poll. The filter converts its timestamp to the master's
clock, which is the true time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from tsgt.master.classic.scheduler import SynchronisationSchedule
from tsgt.model import ClockSample
from tsgt.radio import airtime_us, symbol_time_ns
from tsgt.timesync.two_way import ClockEstimate, TimestampCheck, clock_filter

if TYPE_CHECKING:
    from collections.abc import Sequence

Floats = NDArray[np.float64]
FilterName = Literal["paper", "regression"]

HOUR_S = 3600.0

# The paper's modem settings; RxDone comes 0.76 symbols after the end of a packet.
_WAY_NS = airtime_us(2, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6) * 1000 + round(
    0.76 * symbol_time_ns(9, 250_000)
)
_MEASUREMENT_WAY_S = (
    airtime_us(34, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6) / 1e6
    + 0.76 * symbol_time_ns(9, 250_000) / 1e9
)
_CYCLE_S = 0.24
_REPLY_TIMEOUT_S = 0.25
_REGRESSION_SCHEDULE = SynchronisationSchedule(
    initial_cycles=50, resync_cycles=5, interval_ns=300_000_000_000
)
_SCHEDULES: dict[FilterName, SynchronisationSchedule] = {
    "regression": _REGRESSION_SCHEDULE,
    "paper": replace(_REGRESSION_SCHEDULE, first_interval_ns=_REGRESSION_SCHEDULE.interval_ns),
}
_MAX_TIMEOUTS = 3

# Three stations at 1.72 Hz. The instrument measures asynchronously at about 2.2 Hz.
_POLL_S = 0.58
_MAX_MEASUREMENT_AGE_S = 0.45

_EDGE_SIGMA_S = 5e-6
_TURNAROUND_S = (0.001, 0.008)

# Initial clock offset of a computer without a battery clock: years behind.
_OFFSET_AT_START_S = -3.2e7


@dataclass(frozen=True, slots=True)
class Step:
    """A step of the station's clock."""

    at_s: float
    by_s: float
    """Positive: forward."""
    away_s: float = 0.0
    """Silence before the step, as in a restart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockScenario:
    """A station's clock; times are counted from the start.

    Attributes
    ----------
    drift_ppm
        Skew of the station's clock; positive: it runs fast.
    warming_ppm, warming_s
        Change of the skew, evenly over this time from a quarter of the duration on.
    late_share, late_mean_s
        Share of the timestamps that are late, and the mean of their exponentially distributed delay.
    late_always_s
        Delay of all timestamps.
    loss
        Share of cycles and polls without a reply.
    outage_s
        Start and end of an outage. The station continues to measure; those measurements reach the master with the
        station's journal and are evaluated like the others.
    """

    name: str
    summary: str
    drift_ppm: float = 10.0
    warming_ppm: float = 0.0
    warming_s: float = HOUR_S
    late_share: float = 0.0
    late_mean_s: float = 0.0
    late_always_s: float = 0.0
    loss: float = 0.0
    step: Step | None = None
    outage_s: tuple[float, float] | None = None
    duration_s: float = 4 * HOUR_S


SCENARIOS: tuple[ClockScenario, ...] = (
    ClockScenario(name="drift-1ppm", summary="constant drift of 1 ppm", drift_ppm=1.0),
    ClockScenario(name="drift-10ppm", summary="constant drift of 10 ppm"),
    ClockScenario(name="drift-50ppm", summary="constant drift of 50 ppm", drift_ppm=50.0),
    ClockScenario(
        name="temperature", summary="10 ppm, and 8 ppm more within an hour of morning sun", warming_ppm=8.0
    ),
    ClockScenario(
        name="jitter",
        summary="30 % of the stamps late, by 3 ms on average",
        late_share=0.3,
        late_mean_s=0.003,
    ),
    ClockScenario(name="asymmetry", summary="every stamp 5 ms late", late_always_s=0.005),
    ClockScenario(name="loss", summary="one exchange in five lost", loss=0.2),
    ClockScenario(
        name="step",
        summary="the clock is set forward by 0.15 s after two hours",
        step=Step(2 * HOUR_S + 100, 0.15),
    ),
    ClockScenario(
        name="restart",
        summary="away for 40 s after two hours, clock 37 minutes behind",
        step=Step(2 * HOUR_S + 100, -37 * 60.0, away_s=40.0),
    ),
    ClockScenario(
        name="outage",
        summary="out of reach for 90 minutes, and 3 ppm more meanwhile",
        warming_ppm=3.0,
        outage_s=(HOUR_S + 50, 2.5 * HOUR_S + 50),
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockOutcome:
    """Errors of a filter in a scenario.

    Attributes
    ----------
    measurements
        Number of timestamps.
    p50_ns, p99_ns, max_ns
        Of their absolute error.
    final_ns
        Mean error over the last half hour; negative: the timestamps are early.
    bound_held
        Share of the timestamps within the stated bound.
    bound_p50_ns
        Median of that bound.
    unobservable
        Number of measurements between an undetectable step and the next synchronisation; not in the figures above.
    withheld
        Number of implausible timestamps.
    restarts
        How often the filter or the timestamp check detected a restart.
    """

    scenario: str
    filter: str
    measurements: int
    p50_ns: float
    p99_ns: float
    max_ns: float
    final_ns: float
    bound_held: float
    bound_p50_ns: float
    unobservable: int
    withheld: int
    restarts: int


class _StationClock:
    """The station's clock."""

    def __init__(self, scenario: ClockScenario) -> None:
        self._scenario = scenario

    def ns(self, true_ns: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
        """Return its time at true times in ns from the start."""
        s = self._scenario
        true_ns = np.asarray(true_ns, dtype=np.int64)
        t = true_ns / 1e9
        # The skew is constant, then a ramp, then constant; the offset is its integral.
        warm_s = np.clip(t - s.duration_s / 4, 0.0, s.warming_s)
        after_s = np.clip(t - s.duration_s / 4 - s.warming_s, 0.0, None)
        gained_s = 1e-6 * (s.drift_ppm * t + s.warming_ppm * (warm_s**2 / (2 * s.warming_s) + after_s))
        if s.step is not None:
            gained_s = gained_s + np.where(t >= s.step.at_s, s.step.by_s, 0.0)
        return true_ns + round(_OFFSET_AT_START_S * 1e9) + np.rint(gained_s * 1e9).astype(np.int64)


# Avoids negative times, even on a clock that is years behind.
_START_NS = 1_700_000_000_000_000_000


class _Run:
    """One scenario with one filter."""

    def __init__(self, scenario: ClockScenario, name: FilterName, seed: int) -> None:
        self._scenario = scenario
        self._clock = _StationClock(scenario)
        self._filter = clock_filter(name)
        self._schedule = _SCHEDULES[name]
        self._check = TimestampCheck()
        self._rng = np.random.default_rng(seed)
        self._unknown = True
        self._synchronisations = 0
        self._due_s = 0.0
        self._synchronised_s = -math.inf
        self._errors_ns: list[int] = []
        self._bounds_ns: list[int] = []
        self._times_s: list[float] = []
        self._unobservable = self._withheld = 0
        self._restarts = -1  # the first synchronisation is no restart

    def outcome(self) -> ClockOutcome:
        """Run the scenario."""
        s = self._scenario
        now_s = 0.0
        while now_s < s.duration_s:
            if self._unknown or (now_s >= self._due_s and self._reachable(now_s)):
                now_s = self._synchronise(now_s)
            else:
                now_s = self._poll(now_s, min(max(self._due_s, now_s + 10.0), s.duration_s))
        errors_ns, times_s = np.array(self._errors_ns), np.array(self._times_s)
        p50_ns, p99_ns, max_ns = np.quantile(np.abs(errors_ns), [0.5, 0.99, 1.0])
        return ClockOutcome(
            scenario=s.name,
            filter=self._filter.name,
            measurements=len(errors_ns),
            p50_ns=float(p50_ns),
            p99_ns=float(p99_ns),
            max_ns=float(max_ns),
            final_ns=float(errors_ns[times_s > s.duration_s - HOUR_S / 2].mean()),
            bound_held=float((np.abs(errors_ns) <= np.array(self._bounds_ns)).mean()),
            bound_p50_ns=float(np.median(self._bounds_ns)),
            unobservable=self._unobservable,
            withheld=self._withheld,
            restarts=self._restarts,
        )

    def _reachable(self, at_s: float) -> bool:
        s = self._scenario
        silent = s.outage_s is not None and s.outage_s[0] <= at_s < s.outage_s[1]
        return not silent and not self._away(at_s)

    def _away(self, at_s: float) -> bool:
        step = self._scenario.step
        return step is not None and step.at_s - step.away_s <= at_s < step.at_s

    def _synchronise(self, start_s: float) -> float:
        """Synchronise, and return the time of its end."""
        cycles = self._schedule.resync_cycles if self._synchronisations else self._schedule.initial_cycles
        samples = list[ClockSample]()
        now_s, timeouts = start_s, 0
        for _ in range(cycles):
            if timeouts == _MAX_TIMEOUTS:
                break
            if not self._reachable(now_s) or self._rng.random() < self._scenario.loss:
                timeouts += 1
                now_s += _REPLY_TIMEOUT_S
                continue
            timeouts = 0
            samples.append(self._exchange(now_s))
            now_s += _CYCLE_S
        if samples:
            self._restarts += self._filter.update(samples).restarted
            self._synchronised_s = start_s
            self._unknown = False
        following_ns = self._schedule.next_interval_ns(self._synchronisations)
        interval_ns = following_ns if samples else self._schedule.first_interval_ns
        self._due_s = now_s + interval_ns / 1e9
        self._synchronisations += bool(samples)
        return now_s

    def _exchange(self, at_s: float) -> ClockSample:
        s = self._scenario
        late_s = s.late_always_s
        if self._rng.random() < s.late_share:
            late_s += self._rng.exponential(s.late_mean_s)
        edges_s = self._rng.normal(0.0, _EDGE_SIGMA_S, 2)
        sent_ns = round(at_s * 1e9)
        stamped_ns = sent_ns + _WAY_NS + round((late_s + edges_s[0]) * 1e9)
        back_s = late_s + self._rng.uniform(*_TURNAROUND_S) + edges_s[1]
        return ClockSample(
            sent_ns=_START_NS + sent_ns,
            station_ns=_START_NS + int(self._clock.ns([stamped_ns])[0]),
            received_ns=_START_NS + sent_ns + 2 * _WAY_NS + round(back_s * 1e9),
            forward_ns=_WAY_NS,
            back_ns=_WAY_NS,
        )

    def _poll(self, start_s: float, until_s: float) -> float:
        """Poll until ``until_s`` or an implausible measurement; return the time of the end."""
        s = self._scenario
        polls_s = np.arange(start_s, until_s, _POLL_S)
        sending_s = polls_s + _WAY_NS / 1e9 + self._rng.uniform(*_TURNAROUND_S, len(polls_s))
        true_s = sending_s - self._rng.uniform(0.0, _MAX_MEASUREMENT_AGE_S, len(polls_s))
        lost = self._rng.random(len(polls_s)) < s.loss
        true_ns = np.rint(true_s * 1e9).astype(np.int64)
        stamps_ns = self._clock.ns(true_ns)
        for poll_s, sent_s, taken_ns, stamp_ns, lost_reply in zip(
            polls_s.tolist(),
            sending_s.tolist(),
            true_ns.tolist(),
            stamps_ns.tolist(),
            lost.tolist(),
            strict=True,
        ):
            if lost_reply or taken_ns < 0:
                continue
            if self._away(poll_s) or self._away(taken_ns / 1e9):
                continue
            estimate = self._filter.at(_START_NS + stamp_ns)
            assigned_ns = stamp_ns - estimate.offset_ns
            plausible = not self._reachable(poll_s) or self._check.check(
                _START_NS + assigned_ns,
                requested_ns=_START_NS + round(poll_s * 1e9),
                received_ns=_START_NS + round((sent_s + _MEASUREMENT_WAY_S) * 1e9),
                bound_ns=estimate.bound_ns,
            )
            if not plausible:
                self._withheld += 1
                self._filter.reset()
                self._unknown = True
                self._synchronisations = 1  # the clock is another one; the station is the same
                return float(poll_s) + _POLL_S
            self._note(taken_ns, assigned_ns, estimate)
        return until_s

    def _note(self, taken_ns: int, assigned_ns: int, estimate: ClockEstimate) -> None:
        step = self._scenario.step
        if (
            step is not None
            and abs(step.by_s) < _REPLY_TIMEOUT_S
            and self._synchronised_s < step.at_s <= taken_ns / 1e9
        ):
            self._unobservable += 1
            return
        self._errors_ns.append(assigned_ns - taken_ns)
        self._bounds_ns.append(estimate.bound_ns)
        self._times_s.append(taken_ns / 1e9)


def run_clock_scenario(scenario: ClockScenario, name: FilterName, *, seed: int = 0) -> ClockOutcome:
    """Run a scenario with a filter, and compare every timestamp with the truth.

    Both filters get the same exchanges from the same seed, as long as they synchronise at the same times.
    """
    return _Run(scenario, name, seed).outcome()
