"""The clock filters: signs, fits, late timestamps, steps, bounds."""

from __future__ import annotations

import numpy as np
import pytest
from harness.clocks.clock_exchanges import SECOND, START_NS, WAY_NS, drifting, exchange, synchronisation

from tsgt.timesync.offset_regression import SkewPrior, fit_line, select_samples
from tsgt.timesync.two_way import ClockFilter, TimestampCheck, clock_filter

MS = 1_000_000
NAMES = ("regression", "paper")


def error_ns(found: ClockFilter, true_s: float, offset_ns: float) -> float:
    """Return the error of the filter's offset, evaluated at the station's time as the master does."""
    true_ns = round(true_s * SECOND)
    return found.at(START_NS + true_ns + round(offset_ns)).offset_ns - offset_ns


@pytest.mark.parametrize("name", NAMES)
def test_offset_is_positive_when_the_station_is_ahead(name: str) -> None:
    """A station whose clock is two seconds ahead has an offset of plus two seconds."""
    found = clock_filter(name)  # type: ignore[arg-type]
    found.update(synchronisation(0, drifting(2 * SECOND, 0)))
    assert found.at(START_NS).offset_ns == pytest.approx(2 * SECOND, abs=MS)


@pytest.mark.parametrize("name", NAMES)
def test_no_offset_before_the_first_synchronisation(name: str) -> None:
    """An offset before the first synchronisation, or after a reset, is an error."""
    found = clock_filter(name)  # type: ignore[arg-type]
    with pytest.raises(LookupError):
        found.at(START_NS)
    found.update(synchronisation(0, drifting(0, 0)))
    found.reset()
    with pytest.raises(LookupError):
        found.at(START_NS)


@pytest.mark.parametrize("name", NAMES)
def test_first_synchronisation_is_a_restart(name: str) -> None:
    """The first update reports a restart, the second does not, the first after a reset does."""
    found = clock_filter(name)  # type: ignore[arg-type]
    clock = drifting(0, 5)
    assert [found.update(synchronisation(start_s, clock)).restarted for start_s in (0, 300)] == [True, False]
    found.reset()
    assert found.update(synchronisation(600, clock)).restarted


@pytest.mark.parametrize("name", NAMES)
def test_single_exchange_suffices(name: str) -> None:
    """One exchange gives an offset, with a bound that covers its round trip and grows with time."""
    found = clock_filter(name)  # type: ignore[arg-type]
    found.update([exchange(0, drifting(7 * SECOND, 20), turnaround_ns=4 * MS)])
    for true_s in (0.0, 10.0, 300.0):
        offset_ns = 7 * SECOND + 20e3 * true_s
        estimate = found.at(START_NS + round(true_s * SECOND + offset_ns))
        assert abs(estimate.offset_ns - offset_ns) <= estimate.bound_ns
        assert estimate.sigma_ns <= estimate.bound_ns


@pytest.mark.parametrize("name", NAMES)
def test_large_offset_is_exact(name: str) -> None:
    """Offsets beyond the resolution of a float are as exact as small ones."""
    found = clock_filter(name)  # type: ignore[arg-type]
    years_ns = -1_600_000_000 * SECOND - 1
    found.update(synchronisation(0, lambda _: 0.0))
    small = found.at(START_NS + SECOND).offset_ns
    far = clock_filter(name)  # type: ignore[arg-type]
    samples = synchronisation(0, lambda _: 0.0)
    far.update(
        [
            type(s)(
                sent_ns=s.sent_ns,
                station_ns=s.station_ns + years_ns,
                received_ns=s.received_ns,
                forward_ns=s.forward_ns,
                back_ns=s.back_ns,
            )
            for s in samples
        ]
    )
    assert far.at(START_NS + years_ns + SECOND).offset_ns == small + years_ns


# --- paper


def test_paper_takes_the_midpoint_and_then_a_tenth() -> None:
    """The first mean counts whole; of the second one a tenth is taken (equation 1 with w = 0.1)."""
    found = clock_filter("paper")
    found.update(synchronisation(0, drifting(0, 0), turnaround_ns=3 * MS))
    # The station stamps before its turn-round, so the midpoint comes half a turn-round late.
    assert found.at(START_NS).offset_ns == -1.5 * MS
    found.update(synchronisation(300, drifting(10 * MS, 0), turnaround_ns=3 * MS))
    assert found.at(START_NS).offset_ns == pytest.approx(-0.5 * MS, abs=1)


def test_paper_has_no_skew() -> None:
    """Its offset is constant, and its bound grows by 100 ppm."""
    found = clock_filter("paper")
    found.update(synchronisation(0, drifting(0, 10)))
    early, late = found.at(START_NS + 2 * SECOND), found.at(START_NS + 102 * SECOND)
    assert early.offset_ns == late.offset_ns
    assert late.skew_ppm == 0.0
    assert late.bound_ns - early.bound_ns == pytest.approx(10 * MS, rel=1e-3)


# --- regression


@pytest.mark.parametrize("seed", range(20))
def test_line_equals_polyfit(seed: int) -> None:
    """With equal round trips and a diffuse prior, offset and skew are those of numpy.polyfit."""
    rng = np.random.default_rng(seed)
    ppm = rng.uniform(-80, 80)
    samples = [
        exchange(sent_ns, drifting(0, ppm), late_ns=round(rng.normal(0, 8000)), turnaround_ns=0)
        for sent_ns in sorted(rng.integers(0, 30 * SECOND, 40).tolist())
    ]
    # A late stamp delays the answer, too: taken off, so that all round trips are as long.
    samples = [
        type(s)(
            sent_ns=s.sent_ns,
            station_ns=s.station_ns,
            received_ns=s.sent_ns + 2 * WAY_NS + 5 * MS,
            forward_ns=WAY_NS,
            back_ns=WAY_NS,
        )
        for s in samples
    ]
    batch = select_samples(samples, 0.0, noise_ns=1e6)
    assert len(batch.station_ns) == 40
    line, _ = fit_line([batch], SkewPrior(0.0, 1e9), 0.0)
    t = (batch.station_ns - batch.station_ns[-1]) / 1e9
    (frequency, offset_ns), covariance = np.polyfit(t, batch.offset_ns - batch.offset_ns[-1], 1, cov=True)
    assert line.line.skew == pytest.approx(frequency, rel=1e-9)
    assert line.line.offset == pytest.approx(offset_ns, rel=1e-9, abs=1e-3)
    # The noise is drawn a little towards the usual one, by two in forty.
    assert line.line.offset_variance == pytest.approx(covariance[1, 1], rel=0.2)
    assert line.line.skew_variance == pytest.approx(covariance[0, 0], rel=0.2)
    assert line.line.covariance == pytest.approx(covariance[0, 1], rel=0.2)


def test_line_equals_lstsq_with_weights() -> None:
    """Slow round trips have less weight; checked with numpy's lstsq on scaled rows."""
    rng = np.random.default_rng(1)
    samples = [
        exchange(
            n * SECOND,
            drifting(0, 3),
            late_ns=int(rng.integers(0, 20_000)),
            turnaround_ns=int(rng.integers(MS, 8 * MS)),
        )
        for n in range(30)
    ]
    batch = select_samples(samples, 0.0, noise_ns=1e6)
    line, _ = fit_line([batch], SkewPrior(0.0, 1e9), 0.0)
    excess_ms = (batch.excess_ns - batch.excess_ns.min()) / MS
    root = np.sqrt(1 / (1 + (excess_ms / 2) ** 2))
    rows = np.stack([np.ones(30), (batch.station_ns - batch.station_ns[-1]) / 1e9], axis=1)
    expected, *_ = np.linalg.lstsq(
        rows * root[:, None], (batch.offset_ns - batch.offset_ns[-1]) * root, rcond=None
    )
    assert [line.line.offset, line.line.skew] == pytest.approx(expected.tolist(), rel=1e-6)


def test_skew_is_extrapolated_to_the_next_synchronisation() -> None:
    """After two synchronisations 300 s apart, 50 ppm are known well enough for the next 300 s."""
    found = clock_filter("regression")
    clock = drifting(0, 50)
    for start_s in (0, 300):
        found.update(synchronisation(start_s, clock))
    assert found.at(START_NS).skew_ppm == pytest.approx(50, abs=0.1)
    assert abs(error_ns(found, 600, 50e3 * 600)) < 0.05 * MS


def test_short_first_synchronisation_keeps_the_prior_skew() -> None:
    """Two timestamps that scatter by 40 us within a quarter of a second are 160 ppm; crystals are not."""
    found = clock_filter("regression")
    found.update(synchronisation(0, drifting(0, 0), cycles=2, late_ns=[0, 40_000]))
    assert abs(found.at(START_NS).skew_ppm) < 30


def test_late_timestamps_are_rejected() -> None:
    """Three of five timestamps, late by milliseconds, do not change the offset."""
    found = clock_filter("regression")
    clock = drifting(0, 10)
    found.update(synchronisation(0, clock, cycles=50))
    updated = found.update(synchronisation(300, clock, late_ns=[2 * MS, 5 * MS, 9 * MS]))
    assert (updated.rejected, updated.restarted) == (3, False)
    assert abs(error_ns(found, 301, 10e3 * 301)) < 0.02 * MS


LATE_NS = [n * MS for n in (5, 1, 3, 2, 4)]
"""Five stamps, all late, none of which another one confirms."""


def test_unconfirmed_timestamp_has_little_weight() -> None:
    """It may be late by its whole excess, so it does not bend a line of those that agree."""
    found = clock_filter("regression")
    clock = drifting(0, 10)
    for start_s in (0, 300, 600):
        found.update(synchronisation(start_s, clock, cycles=20))
    assert found.update(synchronisation(900, clock, late_ns=LATE_NS)).rejected == 4
    assert abs(error_ns(found, 901, 10e3 * 901)) < 0.05 * MS


def test_timestamps_that_never_agree_are_used() -> None:
    """A station whose timestamps are always late is followed as well as they allow."""
    found = clock_filter("regression")
    clock = drifting(0, 40)
    for start_s in range(0, 3901, 300):
        found.update(synchronisation(start_s, clock, late_ns=LATE_NS))
    assert 1 * MS < error_ns(found, 3910, 40e3 * 3910) < 3 * MS
    assert 3 * MS < found.at(START_NS + 3910 * SECOND).bound_ns < 10 * MS


def test_impossible_exchange_is_rejected() -> None:
    """A reply earlier than possible has a wrong timestamp."""
    found = clock_filter("regression")
    samples = synchronisation(0, drifting(0, 0))
    samples[2] = exchange(samples[2].sent_ns - START_NS, drifting(3 * MS, 0), turnaround_ns=-6 * MS)
    assert found.update(samples).rejected == 1
    assert abs(error_ns(found, 1, 0)) < 0.02 * MS


def test_skew_change_drops_old_synchronisations() -> None:
    """A skew that changes by 3 ppm is followed from the second synchronisation after that."""
    found = clock_filter("regression")

    def clock(true_ns: int) -> float:
        return 10e-6 * true_ns + 3e-6 * max(0, true_ns - 3000 * SECOND)

    for start_s in range(0, 3901, 300):
        found.update(synchronisation(start_s, clock))
    assert found.at(START_NS).skew_ppm == pytest.approx(13, abs=0.1)
    assert abs(error_ns(found, 4200, clock(4200 * SECOND))) < 0.05 * MS


@pytest.mark.parametrize("step_ms", [20, -20, 200, -200, 10_000_000])
def test_step_between_synchronisations_resets_the_offset(step_ms: int) -> None:
    """A step above the bound is detected; the skew is kept, the offset is not."""
    found = clock_filter("regression")

    def clock(true_ns: int) -> float:
        return 10e-6 * true_ns + (step_ms * MS if true_ns > 700 * SECOND else 0)

    for start_s in (0, 300, 600):
        assert found.update(synchronisation(start_s, clock)).restarted == (start_s == 0)
    assert found.update(synchronisation(900, clock)).restarted
    assert abs(error_ns(found, 901, clock(901 * SECOND))) < 0.05 * MS
    assert found.at(START_NS).skew_ppm == pytest.approx(10, abs=1)


@pytest.mark.parametrize("step_ms", [50, -50])
@pytest.mark.parametrize("after", [1, 3, 4])
def test_step_within_a_synchronisation_rejects_earlier_exchanges(step_ms: int, after: int) -> None:
    """Only exchanges after the step count."""
    found = clock_filter("regression")
    old = synchronisation(0, drifting(0, 0))
    new = synchronisation(0, drifting(step_ms * MS, 0))
    updated = found.update([*old[:after], *new[after:]])
    assert updated.rejected == after
    assert abs(error_ns(found, 2, step_ms * MS)) < 0.02 * MS


def test_skew_survives_a_reset() -> None:
    """After a restart five exchanges suffice, because the crystal is the same."""
    found = clock_filter("regression")
    clock = drifting(0, 40)
    for start_s in (0, 300, 600):
        found.update(synchronisation(start_s, clock))
    found.reset()
    found.update(synchronisation(700, drifting(-3600 * SECOND, 40)))
    assert abs(error_ns(found, 1000, -3600 * SECOND + 40e3 * 1000)) < 0.1 * MS


@pytest.mark.parametrize("step_ms", [1.4, -1.4, 0.3])
def test_skew_that_may_be_a_small_step_does_not_survive_a_reset(step_ms: float) -> None:
    """A step below the bound looks like another skew, which the next restart may end."""
    found = clock_filter("regression")
    found.update(synchronisation(0, drifting(0, -20), cycles=8, turnaround_ns=3 * MS))
    found.update(synchronisation(14, drifting(step_ms * MS, -20), turnaround_ns=3 * MS))
    assert abs(found.at(START_NS + 15 * SECOND).skew_ppm + 20) > 10
    clock = drifting(-3600 * SECOND, -20)
    assert found.update(synchronisation(30, clock)).restarted
    for true_s in (31, 40, 60, 120):
        stamped_ns = START_NS + true_s * SECOND + round(clock(true_s * SECOND))
        ways_ns = exchange(0, clock).excess_ns  # what all stamps share is not what this is about
        assert abs(error_ns(found, true_s, clock(true_s * SECOND))) < found.at(stamped_ns).bound_ns - ways_ns


def test_long_synchronisation_overrides_the_prior_skew() -> None:
    """An exchanged station computer has another crystal."""
    found = clock_filter("regression")
    for start_s in (0, 300, 600):
        found.update(synchronisation(start_s, drifting(0, 40)))
    found.reset()
    found.update(synchronisation(700, drifting(0, -10), cycles=50))
    assert found.at(START_NS).skew_ppm == pytest.approx(-10, abs=1.5)


def test_bound_covers_a_common_delay() -> None:
    """Timestamps that are all 3 ms late look punctual, but the round trip bounds the delay."""
    found = clock_filter("regression")
    found.update(synchronisation(0, drifting(0, 0), late_ns=[3 * MS] * 5))
    assert error_ns(found, 1, 0) == pytest.approx(3 * MS, abs=1000)
    assert 3 * MS < found.at(START_NS + SECOND).bound_ns < 6 * MS


def test_bound_grows_with_age() -> None:
    """The bound grows with the time since the last synchronisation, and sigma stays below it."""
    found = clock_filter("regression")
    for start_s in (0, 300, 600):
        found.update(synchronisation(start_s, drifting(0, 1)))
    estimates = [found.at(START_NS + at_s * SECOND) for at_s in (601, 900, 1800, 7200, 10**9)]
    bounds_ns = [estimate.bound_ns for estimate in estimates]
    assert bounds_ns == sorted(bounds_ns)
    assert all(0 < estimate.sigma_ns < estimate.bound_ns for estimate in estimates)
    assert bounds_ns[1] < 3 * MS


# --- arrivals


def polls(
    check: TimestampCheck, *, count: int, first_s: float = 0.0, step_s: float = 0.0, seed: int = 0
) -> list[bool]:
    """Poll every 0.58 s a clock that is wrong by the step; measurements are 0 to 0.45 s old when sent."""
    rng = np.random.default_rng(seed)
    found = []
    for requested_s in first_s + 0.58 * np.arange(count):
        sent_s = requested_s + 0.06
        stamp_s = sent_s - rng.uniform(0, 0.45) + step_s
        found.append(
            check.check(
                START_NS + round(stamp_s * SECOND),
                requested_ns=START_NS + round(requested_s * SECOND),
                received_ns=START_NS + round((sent_s + 0.14) * SECOND),
                bound_ns=2 * MS,
            )
        )
    return found


def test_check_passes_hours_without_a_step() -> None:
    """Four hours of polls without a step are all plausible."""
    assert all(polls(TimestampCheck(), count=25_000))


def test_check_passes_gaps() -> None:
    """Measurements after minutes without one are plausible."""
    check = TimestampCheck()
    assert all(polls(check, count=10))
    assert all(polls(check, count=10, first_s=7.5))
    for requested_s in range(15, 300):
        check.no_new_measurement(START_NS + requested_s * SECOND)
    assert all(polls(check, count=10, first_s=300.0))


def test_check_passes_an_old_first_measurement() -> None:
    """A station that lost its target an hour ago replies to the first request with its last measurement."""
    assert polls(TimestampCheck(), count=1, step_s=-3600) == [True]


@pytest.mark.parametrize("step_s", [1.0, 3600.0, -1.0, -3600.0])
def test_check_detects_a_step_at_once(step_s: float) -> None:
    """Measurements from the future, or from before the previous one, come from another clock."""
    check = TimestampCheck()
    polls(check, count=5)
    assert polls(check, count=1, first_s=5 * 0.58, step_s=step_s) == [False]


@pytest.mark.parametrize("step_s", [0.3, -0.4])
def test_check_detects_a_small_step_within_a_minute(step_s: float) -> None:
    """Steps just beyond the reply timeout show within a minute of polls."""
    check = TimestampCheck()
    polls(check, count=5)
    assert not all(polls(check, count=100, first_s=5 * 0.58, step_s=step_s))


def test_check_detects_a_restart_without_new_measurements() -> None:
    """After a reply without a new measurement the next one cannot be older than that reply."""
    check = TimestampCheck()
    polls(check, count=5)
    check.no_new_measurement(START_NS + 100 * SECOND)
    assert polls(check, count=1, first_s=100.58, step_s=-30.0) == [False]


def test_check_tolerates_the_bound() -> None:
    """After a long outage the offset itself may be off by its bound, which is no step."""
    check = TimestampCheck()
    assert check.check(START_NS, requested_ns=START_NS, received_ns=START_NS, bound_ns=0)
    late = {"requested_ns": START_NS + SECOND, "received_ns": START_NS + SECOND}
    assert check.check(START_NS + 3 * SECOND, bound_ns=2 * SECOND, **late)
