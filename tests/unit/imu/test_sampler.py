"""Lines become records with times on the master's Unix clock."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from harness.inertial.imu import HELLO, PERIOD_NS, samples

from tsgt.imu.lines import HelloLine, SamplesLine
from tsgt.imu.sampler import Sampler
from tsgt.recording import decode

if TYPE_CHECKING:
    from tsgt.model import ImuSamples

UNIX_AT_ZERO_NS = 10**18
START_NS = 5 * 10**9
DELAY_NS = 400_000
READY = 110  # samples after which the clock is fitted


def started() -> Sampler:
    """Return a sampler of a program that has sent its hello."""
    sampler = Sampler(UNIX_AT_ZERO_NS)
    sampler.program_started(decode(HelloLine, json.dumps(HELLO).encode()))
    return sampler


def push(
    sampler: Sampler, first: int, count: int = 10, *, late_ns: int = 0, **changes: Any
) -> list[ImuSamples]:
    """Push a line; sample n is read a constant delay after instant n * 5 ms."""
    read_ns = START_NS + first * PERIOD_NS + DELAY_NS + late_ns
    line = decode(SamplesLine, json.dumps(samples(first, count, read_ns, **changes)).encode())
    return sampler.push(line, read_ns + count * PERIOD_NS)


def pushed(sampler: Sampler, first: int, count: int) -> list[ImuSamples]:
    """Push several lines."""
    return [record for number in range(first, first + count, 10) for record in push(sampler, number)]


def test_samples_wait_for_the_clock() -> None:
    """The first 0.5 s become one record; none is lost, and every stamp is that of its sample."""
    (first, *others) = pushed(started(), 0, 200)
    assert first.sequence == 0
    stamps = [stamp for record in (first, *others) for stamp in record.stamp_ns]
    expected = [UNIX_AT_ZERO_NS + START_NS + DELAY_NS + n * PERIOD_NS for n in range(200)]
    assert stamps == pytest.approx(expected, abs=5_000, rel=0)
    assert {duration for record in others for duration in record.duration_ns} == {PERIOD_NS}
    assert others[0].sequence == len(first.stamp_ns)
    assert others[0].received_ns > others[0].stamp_ns[-1]


def test_increments_are_divided_by_the_duration() -> None:
    """Delta angle and delta velocity become mean rate and specific force."""
    sampler = started()
    pushed(sampler, 0, READY)
    (record,) = push(
        sampler,
        READY,
        1,
        angular_rate_radps=None,
        delta_angle_rad=[[0.001, 0.0, -0.002]],
        specific_force_mps2=None,
        delta_velocity_mps=[[0.0, 0.05, 0.0]],
    )
    assert record.angular_rate_radps[0] == pytest.approx((0.2, 0.0, -0.4))
    assert record.specific_force_mps2[0] == pytest.approx((0.0, 10.0, 0.0))


def test_gap_begins_a_record_and_is_counted() -> None:
    """Also within a line; the samples after it last no longer."""
    sampler = started()
    before = pushed(sampler, 0, READY)[-1]
    numbers = [READY, READY + 1, READY + 5]
    times = {
        "counter": numbers,
        "instrument_time_ns": [7 * 10**9 + n * PERIOD_NS for n in numbers],
        "host_time_ns": [START_NS + n * PERIOD_NS + DELAY_NS for n in numbers],
    }
    first, second = push(sampler, READY, 3, late_ns=10 * PERIOD_NS, **times)
    assert first.sequence == before.sequence + len(before.stamp_ns)
    assert second.sequence == first.sequence + 2 + 3
    assert second.stamp_ns[0] - first.stamp_ns[1] == pytest.approx(4 * PERIOD_NS, abs=100)
    assert second.duration_ns == (PERIOD_NS,)


def test_restarted_device_is_fitted_anew() -> None:
    """Its time begins again: no sample until the new fit, then stamps as before, and the gap is counted."""
    sampler = started()
    before = pushed(sampler, 0, 200)[-1]
    reset = [
        record
        for number in range(200, 400, 10)
        for record in push(
            sampler, number, instrument_time_ns=[(n - 100) * PERIOD_NS for n in range(number, number + 10)]
        )
    ]
    assert sampler.clock_steps == 1
    assert reset[0].sequence == before.sequence + 10
    assert reset[-1].sequence + 10 == 400
    assert reset[-1].stamp_ns[-1] - UNIX_AT_ZERO_NS == pytest.approx(
        START_NS + DELAY_NS + 399 * PERIOD_NS, abs=5_000, rel=0
    )


def test_new_run_of_the_program_continues_the_sequence() -> None:
    """What was lost between is counted by the times."""
    sampler = started()
    pushed(sampler, 0, 200)
    sampler.program_started(decode(HelloLine, json.dumps(HELLO).encode()))
    again = pushed(sampler, 300, 200)
    assert again[0].sequence == 300
    assert sampler.clock_steps == 0


@pytest.mark.parametrize(
    ("late_ns", "reason"), [(-(10**9), "ahead of the line's arrival"), (10**10, "before the line's arrival")]
)
def test_host_time_of_another_clock_is_rejected(late_ns: int, reason: str) -> None:
    """With the reason."""
    line = decode(SamplesLine, json.dumps(samples(0, 10, START_NS)).encode())
    with pytest.raises(ValueError, match=reason):
        started().push(line, START_NS + 10 * PERIOD_NS + late_ns)


def test_repeated_samples_are_dropped() -> None:
    """A program that polls too often."""
    sampler = started()
    pushed(sampler, 0, 200)
    assert push(sampler, 190) == []
    assert sampler.dropped == 10


def test_device_whose_time_stands_still_is_dropped() -> None:
    """Its clock cannot be fitted, and the memory stays bounded."""
    sampler = started()
    for number in range(0, 4000, 10):
        times = [7 * 10**9 + n for n in range(number, number + 10)]
        assert push(sampler, number, counter=None, instrument_time_ns=times) == []
    assert sampler.dropped == 2000


def test_device_whose_clock_is_none_is_dropped_with_the_reason() -> None:
    """A tenth too slow is no clock of a device: a wrong time would be worse than none."""
    sampler = started()
    for number in range(0, 8000, 10):
        times = [7 * 10**9 + round(0.9 * n * PERIOD_NS) for n in range(number, number + 10)]
        assert push(sampler, number, counter=None, instrument_time_ns=times) == []
    assert sampler.dropped > 1000
    assert "does not run like that of this computer" in sampler.problem
