"""When an ambiguity of the state begins and ends."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.geometry.trajectory import Observations
from tsgt.geometry.trajectory.innovation_monitor import InnovationMonitor


def _observations(*prisms: int) -> Observations:
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
        np.zeros((3, 3)),
    )


def _is_ambiguous_after(text: str, *, alone: int | None = None) -> bool:
    """Follow measurements: ``a``, ``b`` and ``c`` are consistent ones of three prisms, capitals inconsistent ones."""
    monitor = InnovationMonitor(alone)
    prisms = ["abc".index(each.lower()) for each in text]
    for row, each in enumerate(text):
        held = _observations(*prisms[: row + 1])
        inconsistent = np.array([each.isupper()])
        outliers = np.array([other.isupper() for other in text[: row + 1]])
        monitor.update(held, np.arange(row + 1) == row, inconsistent, outliers)
    return bool(monitor.inconsistent_prisms)


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
