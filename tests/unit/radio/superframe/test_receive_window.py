"""Which of a station's measurements have come, and which are written."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.radio.superframe.receive_window import Inbox, Numbers
from tsgt.radio.superframe.wire import RESTART_SKIP, Introduction

if TYPE_CHECKING:
    from collections.abc import Iterable


def introduced(*, lineage: int = 7, run_start: int = 0, oldest: int = 0) -> Introduction:
    """Make an introduction."""
    return Introduction(nonce=1, lineage=lineage, run_start=run_start, oldest=oldest)


def inbox_with(numbers: Iterable[int]) -> Inbox:
    """Make an inbox into which these have come."""
    inbox = Inbox()
    inbox.introduced(introduced())
    for number in numbers:
        assert inbox.take(number)
    return inbox


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
    numbers, truth = Numbers(first), set(range(first))
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
    numbers = Numbers(0)
    numbers.add(range(2**32 - 1, 2**32))
    assert numbers.missing == 2**32 - 1
    numbers.add(range(2**31, 2**31 + 1))
    assert numbers.missing == 2**32 - 2
    assert numbers.cumulative == -1


# --- Inbox ----------------------------------------------------------------------------------------------------------


def test_what_came_is_not_new_again() -> None:
    """In any order."""
    inbox = inbox_with([2, 0, 5])
    assert [inbox.take(number) for number in (0, 1, 2, 5)] == [False, True, False, False]
    assert (inbox.missing, inbox.unwritten) == (2, 4)


def test_only_what_is_written_counts_as_such() -> None:
    """The cumulative number stops before the first that is not."""
    inbox = inbox_with([0, 1, 2])
    assert inbox.cumulative == -1
    inbox.written([0, 2])
    assert inbox.cumulative == 0
    assert inbox.is_written([0, 2])
    assert not inbox.is_written([0, 1])
    inbox.written([1])
    assert inbox.cumulative == 2


def test_what_the_disk_lost_may_come_again() -> None:
    """It is new then; what is written cannot be lost any more."""
    inbox = inbox_with([0, 1])
    inbox.written([0])
    inbox.lost([0, 1])
    assert [inbox.take(0), inbox.take(1)] == [False, True]


def test_a_restart_leaves_numbers_out() -> None:
    """A thousand before its first are never given, unless they have come; what was missing before them still is."""
    inbox = inbox_with([0, 1, 3])
    inbox.written([0, 1, 3])
    inbox.introduced(introduced(run_start=4 + RESTART_SKIP, oldest=2))
    assert (inbox.cumulative, inbox.missing) == (1, 1)
    assert inbox.take(2)
    inbox.written([2])
    assert inbox.cumulative == 3 + RESTART_SKIP
    assert inbox.take(4 + RESTART_SKIP)


def test_what_a_station_still_has_is_to_be_written_after_a_restart() -> None:
    """It deletes what is acknowledged."""
    inbox = inbox_with(range(5))
    inbox.introduced(introduced(run_start=5 + RESTART_SKIP, oldest=1))
    assert inbox.cumulative == 0
    inbox.written(range(5))
    assert inbox.cumulative == 4 + RESTART_SKIP


@pytest.mark.parametrize(("lost_from", "oldest"), [(2, 0), (2, 2), (5, 5)])
def test_what_a_station_has_no_more_does_not_wait_for_the_disk(lost_from: int, oldest: int) -> None:
    """It takes all below its oldest and all that its restart left out for settled, and reads the number accordingly."""
    inbox = inbox_with(range(5))
    inbox.written([0, 1])
    run_start = lost_from + RESTART_SKIP
    inbox.introduced(introduced(run_start=run_start, oldest=oldest))
    assert inbox.cumulative == run_start - 1


def test_what_the_disk_lost_is_not_waited_for_if_the_station_has_it_no_more() -> None:
    """It was on the air, but not in the journal when the station was killed."""
    inbox = inbox_with(range(5))
    inbox.written([0, 1])
    inbox.introduced(introduced(run_start=2 + RESTART_SKIP))
    inbox.lost([2, 3, 4])
    assert (inbox.missing, inbox.cumulative, inbox.unwritten) == (0, 1 + RESTART_SKIP, 0)


def test_what_a_station_does_not_have_any_more_is_not_waited_for() -> None:
    """Everything below its oldest counts as settled."""
    inbox = inbox_with([9])
    inbox.written([9])
    assert inbox.missing == 9
    inbox.introduced(introduced(oldest=7))
    assert (inbox.missing, inbox.cumulative) == (2, 6)


def test_another_lineage_begins_anew() -> None:
    """The same numbers are other measurements."""
    inbox = inbox_with(range(100))
    inbox.introduced(introduced(lineage=8))
    assert inbox.lineage == 8
    assert inbox.take(0)
    assert inbox.cumulative == -1


def test_a_lineage_that_comes_back_is_known() -> None:
    """What has come of it is no news; what was on its way to the disk meanwhile counts as written."""
    inbox = inbox_with(range(5))
    inbox.written(range(3))
    inbox.introduced(introduced(lineage=8, run_start=700_000))
    assert inbox.take(700_000)
    inbox.written([3, 4])
    inbox.introduced(introduced(run_start=5 + RESTART_SKIP))
    assert not any(inbox.take(number) for number in range(5))
    assert inbox.cumulative == 4 + RESTART_SKIP


def test_a_station_that_gives_numbers_again_is_believed() -> None:
    """Its journal lost more than a restart leaves out; what it measures now must not pass for what has come."""
    inbox = inbox_with(range(2 * RESTART_SKIP))
    inbox.introduced(introduced(run_start=3000, oldest=3000))
    assert inbox.take(3000)


def test_an_introduction_that_is_repeated_changes_nothing() -> None:
    """Until it is confirmed each reply holds it."""
    inbox = inbox_with([0, 1])
    inbox.introduced(introduced(run_start=2 + RESTART_SKIP, oldest=0))
    assert inbox.take(2 + RESTART_SKIP)
    inbox.introduced(introduced(run_start=2 + RESTART_SKIP, oldest=0))
    assert not inbox.take(2 + RESTART_SKIP)
    assert inbox.unwritten == 3


@pytest.mark.parametrize("highest", [0, 100, 127, 128, 255, 256, 70_000])
@pytest.mark.parametrize("off", [-128, -1, 0, 1, 127])
def test_low_bits_stand_for_the_nearest_number(highest: int, off: int) -> None:
    """Next to the highest that has come; never below zero."""
    inbox = inbox_with([highest])
    number = highest + off
    if number >= 0:
        assert inbox.unwrapped(number % 256) == number
    else:
        assert inbox.unwrapped(number % 256) >= 0


def test_low_bits_in_an_introduction_stand_next_to_what_it_says() -> None:
    """Of another lineage the numbers so far mean nothing."""
    inbox = inbox_with([70_000])
    assert inbox.unwrapped(1, introduced(lineage=8)) == 1
    assert inbox.unwrapped(5005 % 256, introduced(lineage=8, oldest=5000)) == 5005
    assert inbox.unwrapped(71_001 % 256, introduced(run_start=71_000)) == 71_001
