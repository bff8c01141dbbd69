"""The reacquisition sequence and the detection of manual pointing, step by step."""

from __future__ import annotations

import math

import pytest

from tsgt.radio import Direction
from tsgt.station.leica.reacquisition import (
    DIRECTION_MAX_AGE_NS,
    PREDICTION_TIMEOUT_NS,
    ROUND_PAUSES_NS,
    Lock,
    ManualPointingDetector,
    Pointing,
    ReacquisitionSequence,
    SearchWindow,
    angular_distance_rad,
)

S = 1_000_000_000
HERE = Pointing(1.0, 1.5)
THERE = Direction(2.0, 1.5, 0.02)


def sequence(width_deg: float = 40.0) -> ReacquisitionSequence:
    """Return a sequence that was locked on before."""
    made = ReacquisitionSequence(width_rad=math.radians(width_deg), height_rad=math.radians(15.0))
    made.lock_acquired(HERE)
    return made


def round_of(searches: ReacquisitionSequence, now_ns: int) -> list[SearchWindow]:
    """Return the windows until it pauses."""
    windows = []
    while (window := searches.next(Lock.OUT, now_ns)) is not None:
        windows.append(window)
    return windows


def test_no_search_while_locked() -> None:
    """The target is tracked."""
    assert sequence().next(Lock.IN, 0) is None


def test_prediction_is_awaited_until_timeout() -> None:
    """The instrument may reacquire the target by itself."""
    searches = sequence()
    assert searches.next(Lock.PREDICTION, 0) is None
    assert searches.next(Lock.PREDICTION, PREDICTION_TIMEOUT_NS - 1) is None
    assert searches.next(Lock.PREDICTION, PREDICTION_TIMEOUT_NS) is not None


def test_windows_grow() -> None:
    """At the pointing, around the last direction, wide; then a pause."""
    windows = round_of(sequence(), 0)
    assert [
        (window.sweep, window.centre, round(math.degrees(window.width_rad), 1)) for window in windows
    ] == [
        (False, None, 3.0),
        (True, HERE, 4.0),
        (True, HERE, 40.0),
    ]


def test_full_circle_only_if_configured() -> None:
    """It turns the telescope past every reflective object."""
    assert not any(window.is_full_circle for window in round_of(sequence(350.0), 0))
    assert round_of(sequence(360.0), 0)[-1].is_full_circle


def test_pauses_grow_with_rounds() -> None:
    """Searching continues while the operator is called after each round."""
    searches = sequence()
    now_ns = 0
    for number in range(6):
        assert round_of(searches, now_ns)
        assert searches.rounds == number + 1
        pause_ns = ROUND_PAUSES_NS[min(number, len(ROUND_PAUSES_NS) - 1)]
        assert searches.next(Lock.OUT, now_ns + pause_ns - 1) is None
        now_ns += pause_ns
    searches.lock_acquired(HERE)
    assert searches.rounds == 0


def test_restart_ends_pause() -> None:
    """A command requests a search now."""
    searches = sequence()
    round_of(searches, 0)
    searches.restart(None, 1)
    assert searches.next(Lock.OUT, 1) is not None


def test_direction_from_master_is_searched_first() -> None:
    """Until it expires, also during the prediction."""
    searches = sequence()
    searches.restart(THERE, 0)
    window = searches.next(Lock.PREDICTION, 0)
    assert window is not None
    assert (window.sweep, window.centre) == (False, Pointing(2.0, 1.5))
    assert window.width_rad == pytest.approx(0.04)
    sweep = searches.next(Lock.OUT, 1)
    assert sweep is not None
    assert (sweep.sweep, sweep.centre) == (True, Pointing(2.0, 1.5))
    searches.restart(THERE, 0)
    stale = searches.next(Lock.OUT, DIRECTION_MAX_AGE_NS)
    assert stale is not None
    assert stale.centre != Pointing(2.0, 1.5)


def test_corrected_direction_does_not_restart_sequence() -> None:
    """Each interrupts a search; the next window follows, unless the direction is elsewhere."""
    searches = sequence()
    tried = []
    for number in range(4):
        searches.restart(Direction(2.0 + 0.01 * number, 1.5, 0.02), 5 * S * number)
        window = searches.next(Lock.OUT, 5 * S * number)
        assert window is not None
        tried.append((window.sweep, round(math.degrees(window.width_rad), 1)))
    assert [sweep for sweep, _ in tried] == [False, True, True, True]
    assert tried[-1][1] == 40.0
    assert not searches.restart(Direction(3.0, 1.5, 0.02), 20 * S)
    window = searches.next(Lock.OUT, 20 * S)
    assert window is not None
    assert not window.sweep


def test_direction_beyond_spread_restarts_sequence() -> None:
    """The prism may be where no search has been."""
    searches = sequence()
    searches.restart(Direction(2.0, 1.5, 0.02), 0)
    assert searches.next(Lock.OUT, 0) is not None
    assert not searches.restart(Direction(2.03, 1.5, 0.03), 5 * S)
    window = searches.next(Lock.OUT, 5 * S)
    assert window is not None
    assert (window.sweep, window.centre) == (False, Pointing(2.03, 1.5))


def test_moved_telescope_returns_first() -> None:
    """After single measurements it points at the last target."""
    searches = sequence()
    searches.telescope_moved()
    window = searches.next(Lock.OUT, 0)
    assert window is not None
    assert window.centre == HERE


def test_operator_may_point_after_failed_round() -> None:
    """The telescope is not turned back while the operator aims."""
    searches = sequence()
    searches.telescope_moved()
    assert round_of(searches, 0)[0].centre == HERE
    assert round_of(searches, 60 * S)[0].centre is None


def test_reset_forgets_last_direction() -> None:
    """It belongs to the old prism."""
    searches = sequence()
    searches.reset()
    assert {window.centre for window in round_of(searches, 0)} == {None}


def test_manual_pointing_is_a_turn_and_a_rest() -> None:
    """Neither a telescope that has not moved, nor one that still moves."""
    detector = ManualPointingDetector(HERE, 0)
    assert not any(detector.update(HERE, number * S) for number in range(10))
    turning = [Pointing(1.0 + 0.01 * number, 1.5) for number in range(5)]
    assert not any(detector.update(there, (10 + number) * S) for number, there in enumerate(turning))
    assert not detector.update(turning[-1], 15 * S)
    assert detector.update(turning[-1], 17 * S)


def test_angular_distance_wraps() -> None:
    """0 and 2 pi are equal; near the zenith horizontal angles count for little."""
    assert angular_distance_rad(Pointing(0.001, 1.5), Pointing(math.tau - 0.001, 1.5)) == pytest.approx(
        0.002, rel=0.01
    )
    assert angular_distance_rad(Pointing(0.0, 0.01), Pointing(1.0, 0.01)) < 0.011
