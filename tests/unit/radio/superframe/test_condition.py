"""The condition of an instrument over the radio: values, words, and their order."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.radio.superframe import UNKNOWN_CONDITION, InstrumentCondition
from tsgt.radio.superframe.condition import (
    ACTIVITIES,
    PROBLEMS,
    ConditionKind,
    ConditionReporter,
    condition_items,
    updated_condition,
)
from tsgt.radio.superframe.wire import ConditionItem

if TYPE_CHECKING:
    from collections.abc import Iterable

PAGE = (Path(__file__).parents[4] / "docs" / "reference" / "radio-protocol.md").read_text()

CONDITION = InstrumentCondition(
    battery_percent=85, atmospheric_ppm=8.5, activity="tracking prism 3", problem=""
)


def received(condition: InstrumentCondition) -> InstrumentCondition:
    """Return what the master knows when it has all items."""
    known = UNKNOWN_CONDITION
    for kind, value in condition_items(condition).items():
        known = updated_condition(known, ConditionItem(kind, value))
    return known


conditions = st.builds(
    InstrumentCondition,
    battery_percent=st.none() | st.integers(0, 100),
    atmospheric_ppm=st.none() | st.floats(-200, 200) | st.floats(allow_nan=False, allow_infinity=False),
    activity=st.none() | st.sampled_from([words for words, _ in ACTIVITIES]) | st.text(),
    problem=st.none() | st.sampled_from([words for words, _ in PROBLEMS]) | st.text(),
)


@given(conditions)
def test_condition_arrives_within_its_resolution(condition: InstrumentCondition) -> None:
    """Every value has a code of nine bits; a problem without a word is not hidden, and what arrived arrives again."""
    assert all(0 <= value < 512 for value in condition_items(condition).values())
    known = received(condition)
    assert known.battery_percent == condition.battery_percent
    ppm = condition.atmospheric_ppm
    if ppm is None:
        assert known.atmospheric_ppm is None
    else:
        assert known.atmospheric_ppm == pytest.approx(min(max(ppm, -127.5), 127.5), abs=0.25)
    assert bool(known.problem) == bool(condition.problem)
    assert received(known) == known


@given(st.integers(0, 3), st.integers(0, 511))
def test_any_item_is_understood_or_ignored(kind: int, value: int) -> None:
    """Also those that no version has assigned yet."""
    known = updated_condition(CONDITION, ConditionItem(kind, value))
    if kind == 3 or (kind == ConditionKind.BATTERY and value > 101):
        assert known == CONDITION
    else:
        assert condition_items(known)[ConditionKind(kind)] == value


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        ("it is not level", "it is not level"),
        (
            "not level; its battery lasts for some 30 minutes more; change it",
            "it is not level; change its battery",
        ),
        ("point the telescope at prism 3, it is not found", "point the telescope at the prism"),
        ("reflector 360 cannot be set: GRC_IVPARAM", "a setting is not as required"),
        ("the laser is on fire", "see `tsgt status` there"),
        ("", ""),
    ],
)
def test_problems_become_words(problem: str, words: str) -> None:
    """Several at once; one that has no word sends the operator to the station's computer."""
    assert received(replace(CONDITION, problem=problem)).problem == words


@pytest.mark.parametrize(
    ("activity", "words"),
    [
        ("tracking prism 3", "tracking"),
        ("recognising the target at the current pointing", "searching for the prism"),
        ("searching the widest window", "searching for the prism"),
        ("waiting for the prism to come back", "waiting for the prism to come back"),
        (
            "waiting for the telescope to be pointed at prism 2",
            "waiting for the telescope to be pointed at the prism",
        ),
        ("waiting for the program", ""),
    ],
)
def test_activities_become_words(activity: str, words: str) -> None:
    """By their beginning."""
    assert received(replace(CONDITION, activity=activity)).activity == words


def sent(
    reporter: ConditionReporter, conditions: Iterable[InstrumentCondition], *, lost: bool = False
) -> list[int]:
    """Send a report with each condition; return the kinds."""
    kinds = []
    for condition in conditions:
        item = reporter.next(condition)
        assert reporter.next(condition) == item  # a report that is not sent changes nothing
        reporter.sent(item)
        if not lost:
            reporter.acknowledged(item)
        kinds.append(item.kind)
    return kinds


def test_items_take_turns() -> None:
    """All are known after three reports; then they are repeated."""
    assert sent(ConditionReporter(), [CONDITION] * 7) == [0, 1, 2, 0, 1, 2, 0]


def test_changed_item_comes_first() -> None:
    """Lost ones are sent again; one that changes all the time delays no other one for longer than a turn."""
    reporter = ConditionReporter()
    sent(reporter, [CONDITION] * 3)
    low = replace(CONDITION, battery_percent=12)
    assert sent(reporter, [CONDITION, replace(CONDITION, problem="it is not level")]) == [0, 2]
    assert sent(reporter, [low] * 2, lost=True) == [0, 2]  # the problem is over
    assert sent(reporter, [low] * 2) == [0, 2]
    flapping = [replace(low, problem=text) for text in ("it is not level", "", "it is not level")]
    assert sent(reporter, [replace(each, battery_percent=11) for each in flapping]) == [0, 1, 2]


def test_words_stand_on_the_page() -> None:
    """Activities by code, problems by flag."""
    section = PAGE[PAGE.index("#### Condition of the instrument") : PAGE.index("#### A measurement in full")]
    rows = re.findall(r"^\| (\d+) \| ([^|]*) \| ([^|]*?) ?\|$", section, re.MULTILINE)
    activities = [row for row in rows if row[1].strip() and row[0] in "01234567"]
    for code, (words, begins) in enumerate(ACTIVITIES):
        if words:
            assert (str(code), words, ", ".join(begins)) in activities
    for bit, (words, parts) in enumerate(PROBLEMS):
        other = bit == len(PROBLEMS) - 1
        assert (str(1 << bit), words, "none of these" if other else ", ".join(parts)) in rows
