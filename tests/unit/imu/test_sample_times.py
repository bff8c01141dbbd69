"""Durations and gaps by the device's counter and clock."""

from __future__ import annotations

import pytest

from tsgt.imu.sample_times import SampleTime, SampleTimes

MS = 1_000_000


def pushed(*samples: tuple[int | None, int | None], rate_hz: float = 200.0) -> list[SampleTime | None]:
    """Return what follows the first sample."""
    times = SampleTimes(rate_hz)
    return [times.push(*sample) for sample in samples][1:]


def test_clock_gives_durations() -> None:
    """Also where they differ from the nominal period."""
    found = pushed((None, 0), (None, 5_100_000), (None, 10_000_000))
    assert found == [SampleTime(5_100_000, 5_100_000, 0, False), SampleTime(10_000_000, 4_900_000, 0, False)]


def test_counter_gives_durations_in_nominal_periods() -> None:
    """The device clock corrects the period."""
    assert pushed((7, None), (8, None)) == [SampleTime(40 * MS, 5 * MS, 0, False)]


@pytest.mark.parametrize(
    "samples", [((1, None), (4, None)), ((None, 5 * MS), (None, 20 * MS)), ((1, 5 * MS), (4, 20 * MS))]
)
def test_lost_samples_are_counted(samples: tuple[tuple[int | None, int | None], ...]) -> None:
    """The sample after a gap lasts no longer than any other."""
    assert pushed(*samples) == [SampleTime(20 * MS, 5 * MS, 2, False)]


@pytest.mark.parametrize(
    "samples",
    [
        ((None, 5 * MS), (None, 4 * MS)),
        ((9, None), (3, None)),
        ((9, 100 * MS), (10, 5 * MS)),
        ((9, 100 * MS), (10, 150 * MS)),
        ((9, None), (None, 100 * MS)),
        ((9, None), (10**12, None)),
    ],
    ids=[
        "clock back",
        "counter back",
        "clock set back",
        "clock set ahead",
        "other source",
        "counter far ahead",
    ],
)
def test_steps_are_restarts(samples: tuple[tuple[int | None, int | None], ...]) -> None:
    """Earlier times have another origin then."""
    (found,) = pushed(*samples)
    assert found is not None
    assert found.restarted
    assert found.duration_ns == 5 * MS


@pytest.mark.parametrize(("step_ns", "restarted"), [(0, False), (-1_500 * MS, True), (20 * MS, True)])
def test_clock_set_in_a_gap(step_ns: int, restarted: bool) -> None:  # noqa: FBT001 (a parameter of the test)
    """A step in a gap of 14 s shows against the counter, whose period is 1 % off the nominal one."""
    period_ns = 5_050_000
    times = SampleTimes(200.0)
    for counter in range(1500):
        times.push(counter, counter * period_ns)
    found = times.push(4300, 4300 * period_ns + step_ns)
    assert found is not None
    assert found.restarted == restarted
    assert found.lost == (0 if restarted else 2800)


@pytest.mark.parametrize(
    ("samples", "step_ns", "restarted"),
    [(700, 0, False), (700, -1_980 * MS, True), (50, 0, False), (50, -1_980 * MS, True), (5, 0, False)],
)
def test_clock_set_in_a_gap_soon_after_the_start(samples: int, step_ns: int, *, restarted: bool) -> None:
    """Few samples tell their period well enough for a large step, with times in whole milliseconds too."""
    times = SampleTimes(200.0)
    for counter in range(samples):
        times.push(counter, counter * 5_050_000 // MS * MS)
    after = samples + 1700
    found = times.push(after, (after * 5_050_000 + step_ns) // MS * MS)
    assert found is not None
    assert found.restarted == restarted


def test_repeated_sample_is_none() -> None:
    """The same counter and time."""
    assert pushed((1, 5 * MS), (1, 5 * MS)) == [None]


def test_line_printed_again_is_no_restart() -> None:
    """The samples after it follow those before."""
    line = [(counter, counter * 5 * MS) for counter in range(20)]
    found = pushed(*line, *line[10:], (20, 100 * MS))
    assert found[-1] == SampleTime(100 * MS, 5 * MS, 0, False)


@pytest.mark.parametrize("length", [1, 10])
def test_device_that_prints_everything_twice_has_not_restarted(length: int) -> None:
    """From its first sample or line on; a device that is asked twice as often as it measures does."""
    lines = [range(first, first + length) for first in range(0, 100, length)]
    samples = [(None, counter * 5 * MS) for line in lines for counter in [*line, *line]]
    found = [each for each in pushed(*samples) if each is not None]
    assert len(found) == 99
    assert not any(each.restarted for each in found)


@pytest.mark.parametrize("count", [60, 400])
def test_device_that_begins_again_soon_has_restarted(count: int) -> None:
    """Its samples have the numbers and times of those before, in the same order; the next one is not the successor of those."""
    first = [(counter, counter * 5 * MS) for counter in range(count)]
    *again, found = pushed(*first, *first, (count, count * 5 * MS))[count - 1 :]
    assert again == [None] * count
    assert found == SampleTime(count * 5 * MS, 5 * MS, 0, True)
