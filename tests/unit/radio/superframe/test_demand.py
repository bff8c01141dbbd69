"""Demand and grants."""

from __future__ import annotations

import pytest
from harness.hardware.radios import PAPER
from harness.radio.scripted_stations import TIMING

from tsgt.radio.superframe import FrameTiming
from tsgt.radio.superframe.demand import (
    DEFAULT_GRANT,
    Demand,
    demand_bytes,
    expected_measurements,
    grant,
    max_grant,
    retry_stations,
)
from tsgt.radio.superframe.wire import GRANT_BYTES
from tsgt.timesync import Period

BEAT = Period(period_us=400_000, phase_us=0, jitter_us=0)


def granted(demand: Demand, *, cap: int = len(GRANT_BYTES) - 1, silent_frames: int = 0) -> int:
    """Return a grant in bytes."""
    return GRANT_BYTES[grant(demand, cap=cap, silent_frames=silent_frames)]


def test_grant_is_smallest_sufficient() -> None:
    """For any number of measurements."""
    for count in range(1, 14):
        for extended in (False, True):
            demand = Demand(count, extended=extended)
            longest = granted(demand)
            assert longest >= demand_bytes(demand)
            assert GRANT_BYTES[GRANT_BYTES.index(longest) - 1] < demand_bytes(demand)
    assert granted(Demand(1)) == 17


def test_grant_is_capped() -> None:
    """By the default grant for a station that may be absent."""
    assert granted(Demand(1000), cap=GRANT_BYTES.index(71)) == 71
    assert granted(Demand(1000), silent_frames=6) == GRANT_BYTES[DEFAULT_GRANT]
    assert granted(Demand(1), silent_frames=6) == 17


@pytest.mark.parametrize(
    ("newest_us", "count"), [(390_000, 1), (250_000, 1), (1000, 1), (-5000, 2), (-100_000, 2)]
)
def test_expected_measurements_follow_period(newest_us: int, count: int) -> None:
    """From the newest received one to the composed reply, at least one."""
    assert expected_measurements(BEAT, newest_us=newest_us, replied_us=400_000, slot_us=800_000) == count


def test_unready_measurement_is_not_expected() -> None:
    """Made 90 ms before the slot by an instrument with a latency of 120 ms."""
    slot_us = 890_000
    assert expected_measurements(BEAT, newest_us=0, replied_us=400_000, slot_us=slot_us) == 2
    assert (
        expected_measurements(BEAT, newest_us=0, replied_us=400_000, slot_us=slot_us, ready_us=120_000) == 1
    )


def test_measurements_may_resume_after_pause() -> None:
    """At most as many as fit since the last reply."""
    assert expected_measurements(BEAT, newest_us=0, replied_us=10_000_000, slot_us=10_400_000) == 1
    assert expected_measurements(BEAT, newest_us=0, replied_us=10_000_000, slot_us=10_900_000) == 3


def test_max_grants_fit_frame() -> None:
    """With many stations and a slow modem; the default grant always fits."""
    for stations in range(1, 17):
        slot_ns = TIMING.airtime_ns(GRANT_BYTES[max_grant(TIMING, stations)]) + TIMING.guard_ns
        assert stations * slot_ns <= 5_000_000_000
    slow = FrameTiming(
        PAPER.__class__(frequency_hz=905_000_000, spreading_factor=12, bandwidth_hz=125_000, coding_rate=5),
        guard_ns=TIMING.guard_ns,
        turnaround_ns=TIMING.turnaround_ns,
    )
    assert max_grant(slow, 3) == DEFAULT_GRANT


def test_retry_frame_repeats_silent_stations() -> None:
    """After a frame for all, and once."""
    silent_frames = dict.fromkeys(range(8), 0) | {2: 1, 5: 4}
    assert retry_stations(silent_frames, [2] * 8) == {2, 5}
    assert retry_stations(silent_frames, [0, 0, 4, 0, 0, 4, 0, 0]) == set()


def test_single_loss_is_not_retried() -> None:
    """A frame for one station costs the others a third of theirs."""
    silent_frames = dict.fromkeys(range(8), 0)
    assert retry_stations(silent_frames | {2: 1}, [2] * 8) == set()
    assert retry_stations(silent_frames | {2: 2}, [2] * 8) == {2}


def test_no_retry_frame_for_few_stations() -> None:
    """Nor for more than half of many."""
    assert retry_stations({0: 0, 1: 1, 2: 0}, [2, 2, 2]) == set()
    assert retry_stations(dict.fromkeys(range(8), 1), [2] * 8) == set()


def test_absent_station_does_not_prevent_retry() -> None:
    """It has no slot in most frames."""
    silent_frames = dict.fromkeys(range(9), 0) | {2: 2, 8: 30}
    assert retry_stations(silent_frames, [2] * 8 + [0]) == {2}
