"""Rows that say what of a set-up may be wrong."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from tsgt.analysis.refinement import refinement_rows, refinement_text
from tsgt.config import ScenarioConfig, scenario_parameters
from tsgt.geometry.motion_calibration import Hypothesis, HypothesisEvidence, RefinedSetup


def _evidence(
    hypothesis: Hypothesis, log_bayes_factor: float, *, selected: bool = False
) -> HypothesisEvidence:
    size = len(hypothesis.components)
    return HypothesisEvidence(
        hypothesis,
        log_bayes_factor,
        selected,
        np.full(size, 2e-4),
        np.full(size, 1e-4),
    )


def test_rows_state_what_may_be_wrong() -> None:
    """Estimates with one sigma in the units of the field, the most likely first."""
    index = Hypothesis("vertical_index", 1, np.zeros((3, 1)), np.ones(1), ("",))
    prism = Hypothesis("prism", 0, np.zeros((3, 3)), np.ones(3), ("x", "y", "z"))
    scale = replace(index, kind="range_scale", row=0)
    evidence = (_evidence(prism, 1.0), _evidence(index, 30.0, selected=True), _evidence(scale, -1.0))
    refined = cast("RefinedSetup", SimpleNamespace(evidence=evidence, used=True))
    assert refinement_rows(refined, scenario_parameters(ScenarioConfig())) == (
        ("vertical index, station 2", "0.200 ± 0.100 mrad", "30.0", "yes"),
        ("prism, prism 1", "x 0.2 ± 0.1 mm, y 0.2 ± 0.1 mm, z 0.2 ± 0.1 mm", "1.0", "no"),
        ("range scale, station 1", "200.0 ± 100.0 ppm", "-1.0", "no"),
    )


def test_nothing_compared_gives_no_rows() -> None:
    """The refinement is switched off."""
    assert refinement_rows(None, scenario_parameters(ScenarioConfig())) == ()


@pytest.mark.parametrize(
    ("log_bayes_factor", "p_value", "said"),
    [
        (-3.0, 0.4, "the measurements do not contradict it"),
        (19.67, 0.0066, "below the limit of its use, log Bayes factor 19.7 of 20 (p-value 0.0066)"),
        (12.0, 0.3, "below the limit of its use, log Bayes factor 12.0 of 20 (p-value 0.3)"),
        (2.0, 0.002, "below the limit of its use, log Bayes factor 2.0 of 20 (p-value 0.002)"),
    ],
)
def test_set_up_that_is_not_refined_is_not_called_right(
    log_bayes_factor: float, p_value: float, said: str
) -> None:
    """Measurements may contradict it by less than a refinement needs."""
    found = SimpleNamespace(evidence=(), used=False, log_bayes_factor=log_bayes_factor, p_value=p_value)
    text = refinement_text(cast("RefinedSetup", found), scenario_parameters(ScenarioConfig()))
    assert said in text
