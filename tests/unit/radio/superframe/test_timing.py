"""Delay of beacons, detected from late replies."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.hardware.radios import MS

from tsgt.radio.superframe.timing import BeaconDelayMonitor

if TYPE_CHECKING:
    from collections.abc import Collection


def by_ms(*late_ms: int | None, untimed: Collection[int] = ()) -> list[int]:
    """Return the detected delay after each frame, by the lateness of its reply; None: no reply.

    The beacons after the frames with the indices ``untimed`` do not carry the time of their beacon.
    """
    monitor, found = BeaconDelayMonitor(), []
    for index, late in enumerate(late_ms):
        if late is not None:
            monitor.add(7 + index, late * MS, beacon_time_sent=index not in untimed)
        found.append(monitor.delay_ns // MS)
    return found


def test_usual_lateness_is_ignored() -> None:
    """Up to 30 ms."""
    assert by_ms(0, 5, 29, 0) == [0, 0, 0, 0]


def test_max_delay_holds_until_two_consecutive_replies_on_time() -> None:
    """The station knows the beacon's time one frame later."""
    assert by_ms(0, 80, 120, 80, 0, 0) == [0, 80, 120, 120, 120, 0]


def test_replies_on_time_must_be_consecutive() -> None:
    """A beacon whose successor is lost has no time."""
    assert by_ms(80, 0, None, 0, 80, 0, 0) == [80, 80, 80, 80, 80, 80, 0]


def test_reply_on_time_needs_beacon_time() -> None:
    """The station has nothing to compare otherwise."""
    assert by_ms(80, 0, 0, 0, untimed=[1]) == [80, 80, 80, 0]
    assert by_ms(80, 0, 0, untimed=[2]) == [80, 80, 0]
