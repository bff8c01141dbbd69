"""The loss sequence and the handover of another prism, step by step."""

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
    """Return one that has seen the prism."""
    made = ReacquisitionSequence(width_rad=math.radians(width_deg), height_rad=math.radians(15.0))
    made.lock_acquired(HERE)
    return made


def round_of(searches: ReacquisitionSequence, now_ns: int) -> list[SearchWindow]:
    """Return the searches until it pauses."""
    windows = []
    while (look := searches.next(Lock.OUT, now_ns)) is not None:
        windows.append(look)
    return windows


def test_a_lock_needs_nothing() -> None:
    """Nothing is searched for that is there."""
    assert sequence().next(Lock.IN, 0) is None


def test_prediction_is_waited_for_but_not_for_ever() -> None:
    """The instrument may find it by itself."""
    searches = sequence()
    assert searches.next(Lock.PREDICTION, 0) is None
    assert searches.next(Lock.PREDICTION, PREDICTION_TIMEOUT_NS - 1) is None
    assert searches.next(Lock.PREDICTION, PREDICTION_TIMEOUT_NS) is not None


def test_the_order_of_the_searches() -> None:
    """Where it points, around the last direction, wide; then a pause."""
    windows = round_of(sequence(), 0)
    assert [(look.sweep, look.centre, round(math.degrees(look.width_rad), 1)) for look in windows] == [
        (False, None, 3.0),
        (True, HERE, 4.0),
        (True, HERE, 40.0),
    ]


def test_the_whole_circle_only_where_it_is_allowed() -> None:
    """It takes the telescope past everything that shines."""
    assert not any(look.is_full_circle for look in round_of(sequence(350.0), 0))
    assert round_of(sequence(360.0), 0)[-1].is_full_circle


def test_pauses_grow_and_rounds_are_counted() -> None:
    """After each round it is a person who has to help; it goes on all the same."""
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


def test_an_order_ends_a_pause() -> None:
    """Somebody wants it to look now."""
    searches = sequence()
    round_of(searches, 0)
    searches.restart(None, 1)
    assert searches.next(Lock.OUT, 1) is not None


def test_where_the_master_says_comes_first() -> None:
    """As long as that is fresh, and also while the instrument predicts."""
    searches = sequence()
    searches.restart(THERE, 0)
    look = searches.next(Lock.PREDICTION, 0)
    assert look is not None
    assert (look.sweep, look.centre) == (False, Pointing(2.0, 1.5))
    assert look.width_rad == pytest.approx(0.04)
    sweep = searches.next(Lock.OUT, 1)
    assert sweep is not None
    assert (sweep.sweep, sweep.centre) == (True, Pointing(2.0, 1.5))
    searches.restart(THERE, 0)
    stale = searches.next(Lock.OUT, DIRECTION_MAX_AGE_NS)
    assert stale is not None
    assert stale.centre != Pointing(2.0, 1.5)


def test_repeated_orders_do_not_begin_again() -> None:
    """Each interrupts a search; the next one begins with the next search, unless it points elsewhere."""
    searches = sequence()
    seen = []
    for number in range(4):
        searches.restart(Direction(2.0 + 0.01 * number, 1.5, 0.02), 5 * S * number)
        look = searches.next(Lock.OUT, 5 * S * number)
        assert look is not None
        seen.append((look.sweep, round(math.degrees(look.width_rad), 1)))
    assert [sweep for sweep, _ in seen] == [False, True, True, True]
    assert seen[-1][1] == 40.0
    assert not searches.restart(Direction(3.0, 1.5, 0.02), 20 * S)
    look = searches.next(Lock.OUT, 20 * S)
    assert look is not None
    assert not look.sweep


def test_an_order_that_follows_a_robot_begins_again() -> None:
    """The prism may be where nobody has looked: beyond what the order before left open."""
    searches = sequence()
    searches.restart(Direction(2.0, 1.5, 0.02), 0)
    assert searches.next(Lock.OUT, 0) is not None
    assert not searches.restart(Direction(2.03, 1.5, 0.03), 5 * S)
    look = searches.next(Lock.OUT, 5 * S)
    assert look is not None
    assert (look.sweep, look.centre) == (False, Pointing(2.03, 1.5))


def test_a_telescope_that_was_turned_away_goes_back_first() -> None:
    """After single measurements it points at the last target."""
    searches = sequence()
    searches.telescope_moved()
    look = searches.next(Lock.OUT, 0)
    assert look is not None
    assert look.centre == HERE


def test_a_person_may_turn_the_telescope_after_a_round_in_vain() -> None:
    """Who was asked to point it at the prism must not see it turned away again."""
    searches = sequence()
    searches.telescope_moved()
    assert round_of(searches, 0)[0].centre == HERE
    assert round_of(searches, 60 * S)[0].centre is None


def test_another_prism_has_no_last_direction() -> None:
    """What was known of the old one is of no use."""
    searches = sequence()
    searches.reset()
    assert {look.centre for look in round_of(searches, 0)} == {None}


def test_a_handover_is_a_turn_and_a_rest() -> None:
    """Neither a telescope that was not touched, nor one that still moves."""
    detector = ManualPointingDetector(HERE, 0)
    assert not any(detector.update(HERE, number * S) for number in range(10))
    turning = [Pointing(1.0 + 0.01 * number, 1.5) for number in range(5)]
    assert not any(detector.update(there, (10 + number) * S) for number, there in enumerate(turning))
    assert not detector.update(turning[-1], 15 * S)
    assert detector.update(turning[-1], 17 * S)


def test_directions_are_compared_round_the_circle() -> None:
    """0 and 2 pi are one; near the zenith horizontal angles count for little."""
    assert angular_distance_rad(Pointing(0.001, 1.5), Pointing(math.tau - 0.001, 1.5)) == pytest.approx(
        0.002, rel=0.01
    )
    assert angular_distance_rad(Pointing(0.0, 0.01), Pointing(1.0, 0.01)) < 0.011
