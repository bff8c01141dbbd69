"""The verdict of a calibration from motion: whether the held-out prediction error has grown."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.analysis.calibration import HeldOutComparison
from tsgt.analysis.evaluation import HeldOutErrors


def compared(before_mm: list[float], after_mm: list[float], at_gap: list[bool]) -> HeldOutComparison:
    """Compare errors of the same measurements."""
    before, after = (
        HeldOutErrors(np.array(each) / 1e3, np.array(at_gap, np.bool_)) for each in (before_mm, after_mm)
    )
    return HeldOutComparison(before, before, after)


@pytest.mark.parametrize(
    ("after_mm", "at_gap", "grown"),
    [
        ([4, 4, 4, 90], [False, False, False, True], False),
        ([6, 6, 6, 1], [False, False, False, True], True),
        # Most are at gaps, as with one measurement in two seconds: a single other one decides nothing.
        ([6, 4, 4, 4], [False, True, True, True], False),
        ([4, 6, 6, 6], [False, True, True, True], True),
        ([9, 9, 9, 9], [True, True, True, True], True),
        ([np.nan, 4, 4, 4], [False, False, False, False], None),
    ],
)
def test_most_of_the_measurements_decide(
    after_mm: list[float], at_gap: list[bool], *, grown: bool | None
) -> None:
    """Without those at gaps, unless they are the most; a mean that is unknown decides nothing."""
    assert compared([5, 5, 5, 5], after_mm, at_gap).grown is grown


def test_nothing_held_out_is_not_judged() -> None:
    """Neither grown nor not."""
    assert compared([], [], []).grown is None
