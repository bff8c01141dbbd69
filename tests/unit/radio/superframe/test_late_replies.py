"""Replies that come late, and what they say of the beacons before them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.radios import MS

from tsgt.radio.superframe.timing import BeaconDelayMonitor

if TYPE_CHECKING:
    from collections.abc import Collection


def by_ms(*late_ms: int | None, untimed: Collection[int] = ()) -> list[int]:
    """Return what is thought after each frame, by how late its reply came; None: there was none.

    Of some frames, by their index, the next beacon does not tell when theirs left.
    """
    held, found = BeaconDelayMonitor(), []
    for index, late in enumerate(late_ms):
        if late is not None:
            held.add(7 + index, late * MS, beacon_time_sent=index not in untimed)
        found.append(held.delay_ns // MS)
    return found


def test_replies_that_are_as_late_as_a_computer_makes_them_say_nothing() -> None:
    """Some ms, and more."""
    assert by_ms(0, 5, 29, 0) == [0, 0, 0, 0]


def test_the_longest_delay_counts_until_two_in_a_row_are_on_time() -> None:
    """The first of them answers a beacon of which the station has not been told yet when it left."""
    assert by_ms(0, 80, 120, 80, 0, 0) == [0, 80, 120, 120, 120, 0]


def test_two_that_are_not_in_a_row_do_not_count() -> None:
    """A beacon whose successor is lost tells no time."""
    assert by_ms(80, 0, None, 0, 80, 0, 0) == [80, 80, 80, 80, 80, 80, 0]


def test_the_first_one_on_time_counts_only_if_the_station_is_told_when_its_beacon_left() -> None:
    """Else it has nothing to compare."""
    assert by_ms(80, 0, 0, 0, untimed=[1]) == [80, 80, 80, 0]
    assert by_ms(80, 0, 0, untimed=[2]) == [80, 80, 0]
