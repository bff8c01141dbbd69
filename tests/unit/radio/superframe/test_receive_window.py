"""Which of a station's measurements have come, and which are written."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.radio.superframe.receive_window import ReceiveWindow, SequenceSet
from tsgt.radio.superframe.wire import RESTART_SKIP, JoinRequest

if TYPE_CHECKING:
    from collections.abc import Iterable


def join_request(*, stream_id: int = 7, first_sequence: int = 0, oldest: int = 0) -> JoinRequest:
    """Make an introduction."""
    return JoinRequest(nonce=1, stream_id=stream_id, first_sequence=first_sequence, oldest=oldest)


def window_with(numbers: Iterable[int]) -> ReceiveWindow:
    """Make an inbox into which these have come."""
    window = ReceiveWindow()
    window.join(join_request())
    for number in numbers:
        assert window.accept(number)
    return window


# --- Numbers --------------------------------------------------------------------------------------------------------

_STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(0, 60), st.integers(0, 12)),
        st.tuples(st.just("remove"), st.integers(0, 60), st.just(1)),
    ),
    max_size=40,
)


@given(st.integers(0, 20), _STEPS)
def test_numbers_are_a_set(first: int, steps: list[tuple[str, int, int]]) -> None:
    """As Python's own, with everything below the first number in it from the beginning."""
    numbers, truth = SequenceSet(first), set(range(first))
    for what, start, length in steps:
        if what == "add":
            numbers.add(range(start, start + length))
            truth |= set(range(start, start + length))
        else:
            numbers.remove(start)
            truth.discard(start)
        highest = numbers.highest
        assert highest >= max(truth, default=-1)
        assert {number for number in range(90) if number in numbers} == truth
        missing = set(range(highest + 1)) - truth
        assert numbers.missing == len(missing)
        assert numbers.cumulative == min(missing, default=highest + 1) - 1


def test_a_gap_takes_no_memory_however_long_it_is() -> None:
    """A station may say any number, and who has no key anything."""
    numbers = SequenceSet(0)
    numbers.add(range(2**32 - 1, 2**32))
    assert numbers.missing == 2**32 - 1
    numbers.add(range(2**31, 2**31 + 1))
    assert numbers.missing == 2**32 - 2
    assert numbers.cumulative == -1


# --- Inbox ----------------------------------------------------------------------------------------------------------


def test_what_came_is_not_new_again() -> None:
    """In any order."""
    window = window_with([2, 0, 5])
    assert [window.accept(number) for number in (0, 1, 2, 5)] == [False, True, False, False]
    assert (window.outstanding, window.unwritten) == (2, 4)


def test_only_what_is_written_counts_as_such() -> None:
    """The cumulative number stops before the first that is not."""
    window = window_with([0, 1, 2])
    assert window.cumulative == -1
    window.mark_written([0, 2])
    assert window.cumulative == 0
    assert window.is_written([0, 2])
    assert not window.is_written([0, 1])
    window.mark_written([1])
    assert window.cumulative == 2


def test_what_the_disk_lost_may_come_again() -> None:
    """It is new then; what is written cannot be lost any more."""
    window = window_with([0, 1])
    window.mark_written([0])
    window.mark_lost([0, 1])
    assert [window.accept(0), window.accept(1)] == [False, True]


def test_a_restart_leaves_numbers_out() -> None:
    """A thousand before its first are never given, unless they have come; what was missing before them still is."""
    window = window_with([0, 1, 3])
    window.mark_written([0, 1, 3])
    window.join(join_request(first_sequence=4 + RESTART_SKIP, oldest=2))
    assert (window.cumulative, window.outstanding) == (1, 1)
    assert window.accept(2)
    window.mark_written([2])
    assert window.cumulative == 3 + RESTART_SKIP
    assert window.accept(4 + RESTART_SKIP)


def test_what_a_station_still_has_is_to_be_written_after_a_restart() -> None:
    """It deletes what is acknowledged."""
    window = window_with(range(5))
    window.join(join_request(first_sequence=5 + RESTART_SKIP, oldest=1))
    assert window.cumulative == 0
    window.mark_written(range(5))
    assert window.cumulative == 4 + RESTART_SKIP


@pytest.mark.parametrize(("lost_from", "oldest"), [(2, 0), (2, 2), (5, 5)])
def test_what_a_station_has_no_more_does_not_wait_for_the_disk(lost_from: int, oldest: int) -> None:
    """It takes all below its oldest and all that its restart left out for settled, and reads the number accordingly."""
    window = window_with(range(5))
    window.mark_written([0, 1])
    first_sequence = lost_from + RESTART_SKIP
    window.join(join_request(first_sequence=first_sequence, oldest=oldest))
    assert window.cumulative == first_sequence - 1


def test_what_the_disk_lost_is_not_waited_for_if_the_station_has_it_no_more() -> None:
    """It was on the air, but not in the journal when the station was killed."""
    window = window_with(range(5))
    window.mark_written([0, 1])
    window.join(join_request(first_sequence=2 + RESTART_SKIP))
    window.mark_lost([2, 3, 4])
    assert (window.outstanding, window.cumulative, window.unwritten) == (0, 1 + RESTART_SKIP, 0)


def test_what_a_station_does_not_have_any_more_is_not_waited_for() -> None:
    """Everything below its oldest counts as settled."""
    window = window_with([9])
    window.mark_written([9])
    assert window.outstanding == 9
    window.join(join_request(oldest=7))
    assert (window.outstanding, window.cumulative) == (2, 6)


def test_another_lineage_begins_anew() -> None:
    """The same numbers are other measurements."""
    window = window_with(range(100))
    window.join(join_request(stream_id=8))
    assert window.stream_id == 8
    assert window.accept(0)
    assert window.cumulative == -1


def test_a_lineage_that_comes_back_is_known() -> None:
    """What has come of it is no news; what was on its way to the disk meanwhile counts as written."""
    window = window_with(range(5))
    window.mark_written(range(3))
    window.join(join_request(stream_id=8, first_sequence=700_000))
    assert window.accept(700_000)
    window.mark_written([3, 4])
    window.join(join_request(first_sequence=5 + RESTART_SKIP))
    assert not any(window.accept(number) for number in range(5))
    assert window.cumulative == 4 + RESTART_SKIP


def test_a_station_that_gives_numbers_again_is_believed() -> None:
    """Its journal lost more than a restart leaves out; what it measures now must not pass for what has come."""
    window = window_with(range(2 * RESTART_SKIP))
    window.join(join_request(first_sequence=3000, oldest=3000))
    assert window.accept(3000)


def test_an_introduction_that_is_repeated_changes_nothing() -> None:
    """Until it is confirmed each reply holds it."""
    window = window_with([0, 1])
    window.join(join_request(first_sequence=2 + RESTART_SKIP, oldest=0))
    assert window.accept(2 + RESTART_SKIP)
    window.join(join_request(first_sequence=2 + RESTART_SKIP, oldest=0))
    assert not window.accept(2 + RESTART_SKIP)
    assert window.unwritten == 3


@pytest.mark.parametrize("highest", [0, 100, 127, 128, 255, 256, 70_000])
@pytest.mark.parametrize("off", [-128, -1, 0, 1, 127])
def test_low_bits_stand_for_the_nearest_number(highest: int, off: int) -> None:
    """Next to the highest that has come; never below zero."""
    window = window_with([highest])
    number = highest + off
    if number >= 0:
        assert window.unwrap(number % 256) == number
    else:
        assert window.unwrap(number % 256) >= 0


def test_low_bits_in_an_introduction_stand_next_to_what_it_says() -> None:
    """Of another lineage the numbers so far mean nothing."""
    window = window_with([70_000])
    assert window.unwrap(1, join_request(stream_id=8)) == 1
    assert window.unwrap(5005 % 256, join_request(stream_id=8, oldest=5000)) == 5005
    assert window.unwrap(71_001 % 256, join_request(first_sequence=71_000)) == 71_001
