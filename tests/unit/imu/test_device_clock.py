"""The device's clock on the host's, from samples that are late at random."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from tsgt.imu.device_clock import DeviceClock

MS = 1_000_000
PERIOD_NS = 5 * MS
START_NS = 10**12
FASTEST_NS = 300_000


def stamps(
    clock: DeviceClock, true_ns: list[float], device_ns: list[int], delays_ns: np.ndarray
) -> list[tuple[float, float]]:
    """Return instant and error of each stamp against the fastest possible arrival, in ns."""
    errors = []
    for true, device, delay in zip(true_ns, device_ns, delays_ns, strict=True):
        clock.add(device, int(true + FASTEST_NS + delay))
        if clock.initialised:
            errors.append((true, clock.stamp(device) - true - FASTEST_NS))
    return errors


def regular(count: int, skew: float, *, seed: int = 0) -> tuple[list[float], list[int], np.ndarray]:
    """Return instants, device times, and random delays with a mean of 1 ms."""
    true_ns = [START_NS + i * PERIOD_NS * (1 + skew) for i in range(count)]
    device_ns = [777 + i * PERIOD_NS for i in range(count)]
    return true_ns, device_ns, np.random.default_rng(seed).exponential(MS, count)


@pytest.mark.parametrize(("counter", "skew"), [(False, 30e-6), (False, -150e-6), (True, 0.012)])
def test_stamps_are_exact_despite_jitter(skew: float, *, counter: bool) -> None:
    """Delays of 1 ms leave some microseconds, also with a counter whose rate is off by a percent."""
    clock = DeviceClock(counter=counter)
    errors = [error for _, error in stamps(clock, *regular(4000, skew))]
    assert max(map(abs, errors[:200])) < 500_000
    assert max(map(abs, errors[2000:])) < 20_000
    assert clock.skew_ppm == pytest.approx(1e6 * skew, abs=2.0)


def test_corrections_do_not_tear_samples_apart() -> None:
    """Stamps of samples that follow each other differ by their duration to 0.2 percent."""
    clock = DeviceClock()
    found = stamps(clock, *regular(3000, 20e-6))
    steps = [(b_true - a_true, b - a) for (a_true, a), (b_true, b) in pairwise(found)]
    assert max(abs(error) for _, error in steps) < 0.002 * PERIOD_NS


def test_late_burst_is_harmless() -> None:
    """A stall of 3 s, whose samples arrive at once, changes nothing."""
    true_ns, device_ns, delays_ns = regular(4000, 20e-6)
    stalled = slice(2000, 2600)
    end_ns = true_ns[2600]
    delays_ns[stalled] = [end_ns - true for true in true_ns[stalled]]
    clock = DeviceClock()
    errors = [error for true, error in stamps(clock, true_ns, device_ns, delays_ns) if true > true_ns[1000]]
    assert max(map(abs, errors)) < 20_000
    assert clock.steps == 0


@pytest.mark.parametrize(
    ("shift_ms", "ppm", "largest_ms", "steps"),
    [(20.0, 1e6, 20.1, 1), (8.0, 1e6, 8.1, 1), (30.0, 500.0, 8.0, 1), (100.0, 83_000.0, 100.1, 1)],
    ids=["device set back by 20 ms", "by 8 ms", "host slewed by 500 ppm", "and by chrony"],
)
def test_samples_late_for_seconds_are_not_delayed(
    shift_ms: float, ppm: float, largest_ms: float, steps: int
) -> None:
    """Stamps follow within ten seconds, fifteen of a slow slew, and are as exact as before."""
    true_ns, device_ns, delays_ns = regular(30_000, 20e-6)
    for i in range(10_000, 30_000):
        true_ns[i] += min((i - 10_000) * PERIOD_NS * ppm * 1e-6, shift_ms * MS)
    clock = DeviceClock()
    found = stamps(clock, true_ns, device_ns, delays_ns)
    later_ns = true_ns[10_000] + (15e9 if ppm < 1e4 else 11.5e9)
    assert max(abs(error) for _, error in found[1000:]) < largest_ms * MS
    assert max(abs(error) for true, error in found if true > later_ns) < 200_000
    assert clock.steps == steps


@pytest.mark.parametrize("period_ns", [5 * MS, 50 * MS, 100 * MS])
def test_busy_computer_is_harmless(period_ns: int) -> None:
    """No sample comes within 4 ms for six seconds."""
    count, skew = round(60e9 / period_ns), 20e-6
    true_ns = [START_NS + i * period_ns * (1 + skew) for i in range(count)]
    rng = np.random.default_rng(2)
    delays_ns = rng.exponential(MS, count)
    busy = slice(count // 2, count // 2 + round(6e9 / period_ns))
    delays_ns[busy] += rng.uniform(4 * MS, 20 * MS, len(delays_ns[busy]))
    clock = DeviceClock()
    found = stamps(clock, true_ns, [i * period_ns for i in range(count)], delays_ns)
    assert max(abs(error) for true, error in found if true > true_ns[count // 3]) < 200_000
    assert clock.steps == 0


@pytest.mark.parametrize("caught_up_s", [1.0, 10.0])
def test_backlog_that_is_caught_up_is_harmless(caught_up_s: float) -> None:
    """Samples come faster than they are made after a stall of a second, for some time."""
    true_ns, device_ns, delays_ns = regular(8000, 20e-6)
    for i in range(4000, 8000):
        behind_ns = 1e9 - (true_ns[i] - true_ns[4000]) / caught_up_s
        delays_ns[i] += max(behind_ns, 0.0)
    clock = DeviceClock()
    errors = [error for true, error in stamps(clock, true_ns, device_ns, delays_ns) if true > true_ns[1000]]
    assert max(map(abs, errors)) < 20_000
    assert clock.steps == 0


def test_stale_samples_in_a_buffer_are_harmless() -> None:
    """The first second of samples arrives at once when the port is opened."""
    true_ns, device_ns, delays_ns = regular(2000, 0.0)
    delays_ns[:200] = [true_ns[200] - true for true in true_ns[:200]]
    found = stamps(DeviceClock(), true_ns, device_ns, delays_ns)
    assert max(abs(error) for _, error in found) < 500_000


def test_device_clock_set_ahead_is_fitted_anew() -> None:
    """Samples that arrive before they were made mean a step, and stamps are exact again after 0.5 s."""
    true_ns, device_ns, delays_ns = regular(2000, 0.0)
    device_ns[1000:] = [time + 50 * MS for time in device_ns[1000:]]
    clock = DeviceClock()
    found = stamps(clock, true_ns, device_ns, delays_ns)
    assert clock.steps == 1
    after = [error for true, error in found if true > true_ns[1102]]
    assert len(after) > 800
    assert max(map(abs, after)) < 500_000


def test_one_early_sample_is_not_used() -> None:
    """A corrupted time changes nothing."""
    true_ns, device_ns, delays_ns = regular(1000, 0.0)
    clock = DeviceClock()
    stamps(clock, true_ns[:500], device_ns[:500], delays_ns[:500])
    assert not clock.add(device_ns[500] + 10**10, int(true_ns[500]))
    found = stamps(clock, true_ns[501:], device_ns[501:], delays_ns[501:])
    assert max(abs(error) for _, error in found) < 300_000


@pytest.mark.parametrize("skew", [0.0012, -0.0012, 0.0015, -0.0015, 0.003, -0.003, 0.005, -0.005, 0.03])
def test_clock_of_a_ceramic_resonator(skew: float) -> None:
    """A clock off by more than a crystal's has stamps as exact as another."""
    clock = DeviceClock()
    errors = [error for _, error in stamps(clock, *regular(6000, skew))]
    assert len(errors) > 5000
    assert max(map(abs, errors)) < 2_000_000
    assert max(map(abs, errors[2000:])) < 50_000
    assert clock.skew_ppm == pytest.approx(1e6 * skew, abs=5.0)
    assert clock.steps == 0


@pytest.mark.parametrize("skew", [0.0011, -0.0011, 0.0013, 0.002])
def test_skew_that_the_first_samples_hide(skew: float) -> None:
    """Ten a second show it late: until then stamps are off by a few milliseconds at most."""
    true_ns = [START_NS + 20 * i * PERIOD_NS * (1 + skew) for i in range(1200)]
    device_ns = [777 + 20 * i * PERIOD_NS for i in range(1200)]
    delays_ns = np.random.default_rng(0).exponential(MS, 1200)
    errors = [error for _, error in stamps(DeviceClock(), true_ns, device_ns, delays_ns)]
    assert max(map(abs, errors)) < 8_000_000
    assert max(map(abs, errors[300:])) < 300_000


@pytest.mark.parametrize(("counter", "skew"), [(False, 0.07), (False, -0.07), (True, 0.08)])
def test_clock_that_is_none_gives_no_times(skew: float, *, counter: bool) -> None:
    """Rather than wrong ones."""
    clock = DeviceClock(counter=counter)
    assert stamps(clock, *regular(6000, skew)) == []
    assert clock.started


def test_stall_after_the_first_samples_shows_no_skew() -> None:
    """Samples of 6 s arrive at once, or are caught up in the next 6 s: the prior keeps stamps near."""
    for lateness_ns in (PERIOD_NS * np.arange(1200, 0, -1), 0.5 * PERIOD_NS * np.arange(1200, 0, -1)):
        true_ns, device_ns, delays_ns = regular(4000, 20e-6)
        delays_ns[200:1400] += lateness_ns
        clock = DeviceClock()
        errors = [error for _, error in stamps(clock, true_ns, device_ns, delays_ns)]
        assert max(map(abs, errors)) < 8_000_000
        assert max(map(abs, errors[1500:])) < 100_000
        assert clock.skew_ppm == pytest.approx(20.0, abs=5.0)
