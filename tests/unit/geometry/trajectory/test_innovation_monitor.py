"""When an ambiguity of the state begins and ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tsgt.geometry.trajectory import Observations
from tsgt.geometry.trajectory.innovation_monitor import AMBIGUITY_MARGIN_S, InnovationMonitor

BY_CHANCE, IN_RAIN, NOT_BY_CHANCE = 20.0, 38.0, 60.0  # NIS of inconsistent measurements
OWN_PRISM_M, WRONG_PRISM_M = 0.02, 0.5  # Residuals


def _observations(*prisms: int, layout: int = 3) -> Observations:
    """One measurement of each of these prisms in turn, a tenth of a second apart."""
    count = len(prisms)
    return Observations(
        np.arange(count) / 10,
        np.zeros(count),
        np.zeros((count, 3)),
        np.ones((count, 3)),
        np.ones(count, np.bool_),
        np.zeros(count, np.intp),
        np.array(prisms, np.intp),
        np.eye(4)[None],
        np.zeros((layout, 3)),
    )


def _monitor_after(
    text: str,
    *,
    alone: int | None = None,
    followed: bool = False,
    first_followed: bool = True,
    window: int = 99,
    first_nis: float = NOT_BY_CHANCE,
    layout: int = 3,
    residual_m: float = 0.0,
    certain: bool = True,
) -> InnovationMonitor:
    """Follow measurements after a start: ``a``, ``b`` and ``c`` are consistent ones of three prisms, capitals inconsistent ones.

    ``first_nis``: of the first inconsistent one; the others are inconsistent by what chance gives. ``layout``: its prisms.
    ``residual_m``: of inconsistent ones. ``first_followed``: whether the first one is, where the others are. ``certain``: the rotation.
    """
    monitor = InnovationMonitor(alone)
    start = [0, 1] if layout > 1 else [0, 0]
    prisms = [*start, *("abc".index(each.lower()) for each in text)]
    wrong = np.array([False, False, *(each.isupper() for each in text)])
    nis = BY_CHANCE * wrong
    nis[wrong.argmax()] *= first_nis / BY_CHANCE
    outlier = wrong & (not followed)
    outlier[wrong.argmax()] |= not first_followed
    residuals_m = np.outer(residual_m * wrong, [1.0, 0.0, 0.0])
    monitor.reset(_observations(*start, layout=layout))
    monitor.set_start(0.1)
    for row in range(len(start), len(prisms)):
        rows = slice(max(0, row + 1 - window), row + 1)
        held = _observations(*prisms[: row + 1], layout=layout).select(rows)
        is_new = np.arange(len(held)) == len(held) - 1
        monitor.update(
            held, is_new, nis[row : row + 1], outlier[rows], residuals_m[rows], certain=np.array([certain])
        )
        monitor.select(np.arange(len(held)) > len(held) - window)
    return monitor


def _is_ambiguous_after(text: str, *, alone: int | None = None) -> bool:
    return bool(_monitor_after(text, alone=alone).inconsistent_prisms)


@pytest.mark.parametrize("text", ["A", "Aaaaa", "Ab", "ABc", "AbC", "AbCc", "ABcccc"])
def test_one_consistent_prism_resolves_nothing(text: str) -> None:
    """It may be the one whose wrong measurement bent the trajectory, or that is on a wrong prism."""
    assert _is_ambiguous_after(text)


@pytest.mark.parametrize("text", ["Abc", "Aab", "Abab", "ABca", "ABCab", "AbCab"])
def test_two_consistent_prisms_resolve(text: str) -> None:
    """After the last inconsistent measurement, in any order."""
    assert not _is_ambiguous_after(text)


@pytest.mark.parametrize(("text", "ambiguous"), [("Aaa", True), ("Aaaa", False)])
def test_single_prism_resolves_by_its_succession(text: str, *, ambiguous: bool) -> None:
    """Where there is no other prism."""
    assert _is_ambiguous_after(text, alone=3) is ambiguous


@pytest.mark.parametrize(
    ("text", "followed", "for_s"),
    [
        ("Abc", True, 0.0),
        ("AaAbc", True, 0.2),
        ("AaAb", True, 0.0),
        ("AaAbc", False, 0.0),
        ("AaAbcAbc", True, 0.0),
        ("aAbc", True, 0.0),
        ("ABab", True, 0.0),
        ("ABaAcb", True, 0.3),
    ],
)
def test_time_over_which_inconsistent_measurements_are_followed(
    text: str, for_s: float, *, followed: bool
) -> None:
    """In the newest ambiguity, once it is resolved; one of each prism, or some that are rejected, are none, however early."""
    assert _monitor_after(text, followed=followed).followed_for_s == pytest.approx(for_s)


@pytest.mark.parametrize("window", [99, 4])
@pytest.mark.parametrize(("first_nis", "for_s"), [(BY_CHANCE, 0.0), (IN_RAIN, 0.0), (NOT_BY_CHANCE, 0.2)])
def test_measurements_inconsistent_by_chance_are_not_followed(
    first_nis: float, for_s: float, window: int
) -> None:
    """Those of one prism share the error of one prediction: one of them must be beyond what chance gives."""
    monitor = _monitor_after("AAAaaaaa", alone=5, followed=True, first_nis=first_nis, window=window)
    assert monitor.followed_for_s == pytest.approx(for_s)


def test_innovations_after_an_uncertain_rotation_tell_of_no_station() -> None:
    """A linear prediction far from the true rotation says nothing of what chance gives."""
    monitor = _monitor_after("AAAaaaaa", alone=5, followed=True, certain=False)
    assert monitor.followed_for_s == 0.0
    assert _monitor_after("A", certain=False).inconsistent_prisms


@pytest.mark.parametrize("window", [99, 4])
@pytest.mark.parametrize(
    ("layout", "residual_m", "text", "for_s"),
    [
        (1, OWN_PRISM_M, "AAAaaaaa", 0.2),
        (1, OWN_PRISM_M, "Aaaaaaaa", 0.0),
        (1, WRONG_PRISM_M, "AAAaaaaa", 0.0),
        (3, OWN_PRISM_M, "AAAaaaaa", 0.0),
    ],
)
def test_only_prism_is_followed_though_what_was_inconsistent_stays_so(
    layout: int, residual_m: float, text: str, for_s: float, window: int
) -> None:
    """A tripod was moved by 20 mm, and the trajectory moved there within two seconds; another prism would not have followed."""
    monitor = _monitor_after(text, alone=5, layout=layout, residual_m=residual_m, window=window)
    assert not monitor.inconsistent_prisms
    assert monitor.followed_for_s == pytest.approx(for_s)


@pytest.mark.parametrize("window", [99, 4])
@pytest.mark.parametrize(("first_nis", "for_s"), [(BY_CHANCE, 0.0), (NOT_BY_CHANCE, 0.1)])
def test_first_measurement_counts_though_only_later_ones_are_followed(
    first_nis: float, for_s: float, window: int
) -> None:
    """It is rejected, and may have left the window, before the trajectory follows a station that has moved."""
    monitor = _monitor_after(
        "AAAaaaaa", alone=5, followed=True, first_followed=False, first_nis=first_nis, window=window
    )
    assert monitor.followed_for_s == pytest.approx(for_s)


@pytest.mark.parametrize(("followed", "for_s"), [(True, 0.2), (False, 0.0)])
def test_followed_measurements_that_have_left_the_window_count(for_s: float, *, followed: bool) -> None:
    """A single prism resolves an ambiguity when the window has moved on."""
    monitor = _monitor_after("AAAaaaaa", alone=5, followed=followed, window=4)
    assert not monitor.inconsistent_prisms
    assert monitor.followed_for_s == pytest.approx(for_s)


@pytest.mark.parametrize(
    ("text", "needs_two", "ambiguous"),
    [
        ("a", True, True),
        ("aaaaaa", True, True),
        ("aaAaaaaaa", True, True),
        ("ab", True, False),
        ("aaB", True, True),
        ("aa", False, True),
        ("aaa", False, False),
    ],
)
def test_measurements_after_an_outage_are_unproven(text: str, *, needs_two: bool, ambiguous: bool) -> None:
    """Until another prism agrees; where there is none, until a few agree."""
    monitor = _monitor_after("ab", alone=3)
    assert not monitor.inconsistent_prisms
    monitor.set_unproven(5.0, frozenset({0}), needs_two_prisms=needs_two)
    assert monitor.ambiguous_from_s == 5.0 - AMBIGUITY_MARGIN_S
    for each in text:
        wrong = np.array([each.isupper()])
        monitor.select(np.zeros(len(monitor._time_s), np.bool_))
        monitor.update(
            _observations("abc".index(each.lower())),
            np.ones(1, np.bool_),
            BY_CHANCE * wrong,
            wrong,
            np.zeros((1, 3)),
        )
    assert bool(monitor.inconsistent_prisms) is ambiguous


@pytest.mark.parametrize("unproven", [True, False])
@pytest.mark.parametrize(("time_s", "from_s"), [(5.0, 2.0), (6.4, 2.0), (6.6, 6.6)])
def test_states_of_an_outage_are_ambiguous_with_the_measurement_after_it(
    time_s: float, from_s: float, *, unproven: bool
) -> None:
    """They rest on it; also if it agrees, and if it is one soon after."""
    monitor = _monitor_after("ab")
    monitor.set_outage(2.0, 5.0)
    if unproven:
        monitor.set_unproven(time_s, frozenset({0}), needs_two_prisms=True)
    else:
        inconsistent = np.array([True])
        monitor.select(np.zeros(4, np.bool_))
        new = replace(_observations(0), time_s=np.array([time_s]))
        monitor.update(new, inconsistent, BY_CHANCE * inconsistent, inconsistent, np.zeros((1, 3)))
    assert monitor.ambiguous_from_s == from_s - AMBIGUITY_MARGIN_S


def test_ambiguity_before_an_outage_is_not_resolved_after_it() -> None:
    """What is right agrees with a wrong trajectory then, because that is uncertain."""
    monitor = _monitor_after("ab")
    monitor.set_unproven(5.0, frozenset({0}), needs_two_prisms=True)
    monitor.set_outage(5.0, 11.0)
    monitor.set_unproven(11.0, frozenset({0}), needs_two_prisms=True)
    consistent = np.zeros(2, np.bool_)
    monitor.select(np.zeros(4, np.bool_))
    monitor.update(
        replace(_observations(0, 1), time_s=np.array([11.0, 11.2])),
        ~consistent,
        np.zeros(2),
        consistent,
        np.zeros((2, 3)),
    )
    assert not monitor.inconsistent_prisms
    assert monitor.ambiguous_at(np.array([3.4, 3.6, 8.0, 11.0, 11.1])).tolist() == [
        False,
        True,
        True,
        True,
        False,
    ]


def test_ambiguity_without_inconsistent_measurements_follows_none() -> None:
    """What was followed in an earlier one is over."""
    monitor = _monitor_after("AaAbc", followed=True)
    assert monitor.followed_for_s > 0.0
    monitor.set_unproven(5.0, frozenset({0}), needs_two_prisms=True)
    assert monitor.followed_for_s == 0.0


@pytest.mark.parametrize(
    ("text", "first_nis", "after_s"),
    [
        ("aaA", NOT_BY_CHANCE, 0.0),
        ("aAAb", NOT_BY_CHANCE, 0.1),
        ("AAA", BY_CHANCE, 0.0),
        ("AAAaaaaa", NOT_BY_CHANCE, 0.0),
    ],
)
def test_time_of_a_contradiction_in_which_the_trajectory_was_lost(
    text: str, first_nis: float, after_s: float
) -> None:
    """Whether it was followed or not; until a consistent trajectory is found, however often that is tried."""
    monitor = _monitor_after(text, alone=5, first_nis=first_nis)
    for _ in range(2):
        monitor.reset(_observations(0))
        assert monitor.lost_after_s == pytest.approx(after_s)
    held = _observations(0, 0, 0, 0, 0, 0)
    for row in range(1, 6):
        rows = slice(row, row + 1)
        monitor.select(np.zeros(len(monitor._time_s), np.bool_))
        monitor.update(
            held.select(rows), np.ones(1, np.bool_), np.zeros(1), np.zeros(1, np.bool_), np.zeros((1, 3))
        )
    assert monitor.lost_after_s == 0.0
