"""How long a reply is granted."""

from __future__ import annotations

import pytest
from harness.frames import TIMING
from harness.radios import PAPER

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


def test_a_grant_holds_what_is_wanted_and_little_more() -> None:
    """The shortest that is long enough."""
    for count in range(1, 14):
        for extended in (False, True):
            demand = Demand(count, extended=extended)
            longest = granted(demand)
            assert longest >= demand_bytes(demand)
            assert GRANT_BYTES[GRANT_BYTES.index(longest) - 1] < demand_bytes(demand)
    assert granted(Demand(1)) == 17


def test_a_grant_is_not_longer_than_the_cap() -> None:
    """Nor, for one that may be gone, than what is granted to an unknown station."""
    assert granted(Demand(1000), cap=GRANT_BYTES.index(71)) == 71
    assert granted(Demand(1000), silent_frames=6) == GRANT_BYTES[DEFAULT_GRANT]
    assert granted(Demand(1), silent_frames=6) == 17


@pytest.mark.parametrize(
    ("newest_us", "count"), [(390_000, 1), (250_000, 1), (1000, 1), (-5000, 2), (-100_000, 2)]
)
def test_the_beat_says_how_many_there_are(newest_us: int, count: int) -> None:
    """Counted from the newest that has come to when the reply is composed; at least one."""
    assert expected_measurements(BEAT, newest_us=newest_us, replied_us=400_000, slot_us=800_000) == count


def test_no_room_is_kept_for_what_cannot_be_read_yet() -> None:
    """A second measurement was made 90 ms before the slot; an instrument that needs 120 ms has one to send."""
    slot_us = 890_000
    assert expected_measurements(BEAT, newest_us=0, replied_us=400_000, slot_us=slot_us) == 2
    assert (
        expected_measurements(BEAT, newest_us=0, replied_us=400_000, slot_us=slot_us, ready_us=120_000) == 1
    )


def test_after_a_pause_measurements_may_begin_again() -> None:
    """As many as there can be since the last reply."""
    assert expected_measurements(BEAT, newest_us=0, replied_us=10_000_000, slot_us=10_400_000) == 1
    assert expected_measurements(BEAT, newest_us=0, replied_us=10_000_000, slot_us=10_900_000) == 3


def test_all_grants_together_fit_into_a_frame() -> None:
    """With many stations, and with a slow modem; an introduction fits always."""
    for stations in range(1, 17):
        slot_ns = TIMING.airtime_ns(GRANT_BYTES[max_grant(TIMING, stations)]) + TIMING.guard_ns
        assert stations * slot_ns <= 5_000_000_000
    slow = FrameTiming(
        PAPER.__class__(frequency_hz=905_000_000, spreading_factor=12, bandwidth_hz=125_000, coding_rate=5),
        guard_ns=TIMING.guard_ns,
        turnaround_ns=TIMING.turnaround_ns,
    )
    assert max_grant(slow, 3) == DEFAULT_GRANT


def test_where_many_share_the_channel_the_unheard_are_asked_again() -> None:
    """After a frame for all, and once: the frame after that is for all again."""
    silent_frames = dict.fromkeys(range(8), 0) | {2: 1, 5: 4}
    assert retry_stations(silent_frames, [2] * 8) == {2, 5}
    assert retry_stations(silent_frames, [0, 0, 4, 0, 0, 4, 0, 0]) == set()


def test_one_that_was_missed_once_is_not_asked_again() -> None:
    """It may just have been late, and a frame for it alone costs all others a third of theirs."""
    silent_frames = dict.fromkeys(range(8), 0)
    assert retry_stations(silent_frames | {2: 1}, [2] * 8) == set()
    assert retry_stations(silent_frames | {2: 2}, [2] * 8) == {2}


def test_few_stations_are_not_asked_again() -> None:
    """Their next slot comes soon; nor are more than half of many, for then the channel is gone."""
    assert retry_stations({0: 0, 1: 1, 2: 0}, [2, 2, 2]) == set()
    assert retry_stations(dict.fromkeys(range(8), 1), [2] * 8) == set()


def test_who_has_been_gone_for_long_keeps_nobody_from_being_asked_again() -> None:
    """It has no slot in most frames, and gets none of its own."""
    silent_frames = dict.fromkeys(range(9), 0) | {2: 2, 8: 30}
    assert retry_stations(silent_frames, [2] * 8 + [0]) == {2}
