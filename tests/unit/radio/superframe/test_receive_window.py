"""Received, recorded and outstanding measurements of a station."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.radio.superframe import receive_window
from tsgt.radio.superframe.receive_window import ReceiveWindow, SequenceSet
from tsgt.radio.superframe.wire import RESTART_SKIP, JoinRequest

if TYPE_CHECKING:
    from collections.abc import Iterable


def join_request(*, stream_id: int = 7, first_sequence: int = 0, oldest: int = 0) -> JoinRequest:
    """Return a join request."""
    return JoinRequest(nonce=1, stream_id=stream_id, first_sequence=first_sequence, oldest=oldest)


def window_with(numbers: Iterable[int]) -> ReceiveWindow:
    """Return a window that has received these numbers."""
    window = ReceiveWindow()
    window.join(join_request())
    for number in numbers:
        assert window.accept(number)
    return window


# --- Sequence set ---------------------------------------------------------------------------------------------

_STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(0, 60), st.integers(0, 12)),
        st.tuples(st.just("remove"), st.integers(0, 60), st.just(1)),
    ),
    max_size=40,
)


@given(_STEPS)
def test_sequence_set_equals_python_set(steps: list[tuple[str, int, int]]) -> None:
    """After any additions and removals."""
    numbers = SequenceSet()
    truth: set[int] = set()
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
        assert len(numbers._gaps) == len(missing - {number + 1 for number in missing})


def test_large_gaps_take_no_memory() -> None:
    """A station may send any number."""
    numbers = SequenceSet()
    numbers.add(range(2**32 - 1, 2**32))
    assert numbers.missing == 2**32 - 1
    numbers.add(range(2**31, 2**31 + 1))
    assert numbers.missing == 2**32 - 2
    assert numbers.cumulative == -1


# --- Receive window -------------------------------------------------------------------------------------------


def test_repeated_measurement_is_not_new() -> None:
    """In any order."""
    window = window_with([2, 0, 5])
    assert [window.accept(number) for number in (0, 1, 2, 5)] == [False, True, False, False]
    assert (window.outstanding, window.unwritten) == (2, 4)


def test_cumulative_stops_before_first_unrecorded() -> None:
    """However many later ones are recorded."""
    window = window_with([0, 1, 2])
    assert window.cumulative == -1
    window.mark_written([0, 2])
    assert window.cumulative == 0
    assert window.is_written([0, 2])
    assert not window.is_written([0, 1])
    window.mark_written([1])
    assert window.cumulative == 2


def test_lost_measurement_is_new_again() -> None:
    """A recorded one cannot be lost."""
    window = window_with([0, 1])
    window.mark_written([0])
    window.mark_lost([0, 1])
    assert [window.accept(0), window.accept(1)] == [False, True]


def test_skipped_numbers_of_restart_are_not_outstanding() -> None:
    """Unless they were received; earlier gaps stay outstanding."""
    window = window_with([0, 1, 3])
    window.mark_written([0, 1, 3])
    window.join(join_request(first_sequence=4 + RESTART_SKIP, oldest=2))
    assert (window.cumulative, window.outstanding) == (1, 1)
    assert window.accept(2)
    window.mark_written([2])
    assert window.cumulative == 3 + RESTART_SKIP
    assert window.accept(4 + RESTART_SKIP)


def test_pending_measurements_are_unrecorded_after_restart() -> None:
    """The station deletes what is acknowledged."""
    window = window_with(range(5))
    window.join(join_request(first_sequence=5 + RESTART_SKIP, oldest=1))
    assert window.cumulative == 0
    window.mark_written(range(5))
    assert window.cumulative == 4 + RESTART_SKIP


@pytest.mark.parametrize(("lost_from", "oldest"), [(2, 0), (2, 2), (5, 5)])
def test_numbers_below_oldest_count_as_recorded(lost_from: int, oldest: int) -> None:
    """So do the numbers that the restart skipped."""
    window = window_with(range(5))
    window.mark_written([0, 1])
    first_sequence = lost_from + RESTART_SKIP
    window.join(join_request(first_sequence=first_sequence, oldest=oldest))
    assert window.cumulative == first_sequence - 1


def test_lost_skipped_numbers_are_not_outstanding() -> None:
    """They were sent, but not journalled when the station was killed."""
    window = window_with(range(5))
    window.mark_written([0, 1])
    window.join(join_request(first_sequence=2 + RESTART_SKIP))
    window.mark_lost([2, 3, 4])
    assert (window.outstanding, window.cumulative, window.unwritten) == (0, 1 + RESTART_SKIP, 0)


def test_numbers_below_oldest_are_not_outstanding() -> None:
    """The station no longer has them."""
    window = window_with([9])
    window.mark_written([9])
    assert window.outstanding == 9
    window.join(join_request(oldest=7))
    assert (window.outstanding, window.cumulative) == (2, 6)


def test_another_stream_starts_empty() -> None:
    """The same numbers are other measurements."""
    window = window_with(range(100))
    window.join(join_request(stream_id=8))
    assert window.stream_id == 8
    assert window.accept(0)
    assert window.cumulative == -1


def test_returning_stream_is_remembered() -> None:
    """Received measurements are not new, and recordings completed meanwhile count."""
    window = window_with(range(5))
    window.mark_written(range(3))
    window.join(join_request(stream_id=8, first_sequence=700_000))
    assert window.accept(700_000)
    window.mark_written([3, 4])
    window.join(join_request(first_sequence=5 + RESTART_SKIP))
    assert not any(window.accept(number) for number in range(5))
    assert window.cumulative == 4 + RESTART_SKIP


def test_reused_numbers_are_accepted() -> None:
    """The journal lost more than a restart skips."""
    window = window_with(range(2 * RESTART_SKIP))
    window.join(join_request(first_sequence=3000, oldest=3000))
    assert window.accept(3000)


def test_numbers_below_reused_ones_stay_received() -> None:
    """The restarted station still has them, and sends them again."""
    window = window_with(range(3 * RESTART_SKIP))
    window.mark_written(range(90))
    window.join(join_request(first_sequence=100 + RESTART_SKIP))
    assert not any(window.accept(number) for number in range(100 + RESTART_SKIP))
    assert window.cumulative == 89  # the others are not written yet
    window.mark_written(range(90, 100))
    assert window.cumulative == 99 + RESTART_SKIP
    assert window.accept(100 + RESTART_SKIP)


def test_returning_stream_may_reuse_numbers() -> None:
    """As a restart without another stream in between."""
    window = window_with(range(3 * RESTART_SKIP))
    window.join(join_request(stream_id=8, first_sequence=700_000))
    window.join(join_request(first_sequence=100 + RESTART_SKIP))
    assert [window.accept(99), window.accept(100 + RESTART_SKIP)] == [False, True]


@pytest.mark.parametrize("old_is", ["written", "lost"])
def test_reused_number_is_recorded_when_its_new_measurement_is(old_is: str) -> None:
    """The old one still waits for the disk when the new one arrives."""
    first = 100 + RESTART_SKIP
    window = window_with(range(first + 5))
    window.join(join_request(first_sequence=first))
    assert window.accept(first)
    (window.mark_written if old_is == "written" else window.mark_lost)([first, first + 1])
    assert not window.is_written([first])
    assert [window.accept(first), window.accept(first + 1)] == [False, True]
    window.mark_written([first])
    assert window.is_written([first])
    assert not window.is_written([first + 1])


@given(st.data())
def test_each_measurement_is_accepted_once(data: st.DataObject) -> None:
    """Whatever a killed station had sent without journalling it, and whatever the master's disk does."""
    window, skip = ReceiveWindow(), 5
    run, first = 0, 0
    journal: list[tuple[int, int]] = []  # measurements by run and number
    waiting: list[tuple[int, int]] = []
    received: set[tuple[int, int]] = set()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(receive_window, "RESTART_SKIP", skip)
        for _ in range(data.draw(st.integers(1, 4), label="runs")):
            made = [(run, first + n) for n in range(data.draw(st.integers(0, 20), label="measurements"))]
            window.join(join_request(first_sequence=first))
            for measurement in data.draw(st.permutations(journal + made), label="received"):
                assert window.accept(measurement[1]) == (measurement not in received)
                waiting += [measurement] if measurement not in received else []
                received.add(measurement)
            for _ in range(data.draw(st.integers(0, len(waiting)), label="through the disk")):
                measurement = waiting.pop(0)
                if data.draw(st.booleans(), label="written"):
                    window.mark_written([measurement[1]])
                else:
                    window.mark_lost([measurement[1]])
                    received -= {measurement} & set(journal + made)
            assert not any(window.is_written([each[1]]) for each in (*journal, *made) if each in waiting)
            journal += made[: data.draw(st.integers(0, len(made)), label="journalled")]
            run, first = run + 1, max([first - 1, *(number for _, number in journal)]) + 1 + skip


def test_repeated_join_request_has_no_effect() -> None:
    """Every reply has it until it is confirmed."""
    window = window_with([0, 1])
    window.join(join_request(first_sequence=2 + RESTART_SKIP, oldest=0))
    assert window.accept(2 + RESTART_SKIP)
    window.join(join_request(first_sequence=2 + RESTART_SKIP, oldest=0))
    assert not window.accept(2 + RESTART_SKIP)
    assert window.unwritten == 3


@pytest.mark.parametrize("highest", [0, 100, 127, 128, 255, 256, 70_000])
@pytest.mark.parametrize("off", [-128, -1, 0, 1, 127])
def test_unwrap_returns_nearest_number(highest: int, off: int) -> None:
    """To the highest received one, never below zero."""
    window = window_with([highest])
    number = highest + off
    if number >= 0:
        assert window.unwrap(number % 256) == number
    else:
        assert window.unwrap(number % 256) >= 0


def test_unwrap_uses_numbers_of_join_request() -> None:
    """Numbers of another stream do not count."""
    window = window_with([70_000])
    assert window.unwrap(1, join_request(stream_id=8)) == 1
    assert window.unwrap(5005 % 256, join_request(stream_id=8, oldest=5000)) == 5005
    assert window.unwrap(71_001 % 256, join_request(first_sequence=71_000)) == 71_001
