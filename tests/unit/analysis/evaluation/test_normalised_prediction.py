"""Prediction errors in sigmas."""

from __future__ import annotations

import numpy as np
import pytest
from harness.drives.prior_motion import draw_motions, measure, sorted_by_time

from tsgt.analysis.evaluation import (
    HeldOutErrors,
    NormalisedErrors,
    NormalisedErrorStatistics,
    normalised_prediction_errors,
)
from tsgt.geometry.batch import fit_trajectory, scale_noise
from tsgt.model import MotionPrior

PRIOR = MotionPrior()


def test_errors_of_a_right_model_have_unit_variance() -> None:
    """A robot that moves as the prior says, measured with the stated noise; twice the stated noise halves the errors."""
    squares, halved = [], []
    for seed, motion in enumerate(draw_motions(PRIOR, count=4, duration_s=21.0, seed=3)):
        measured = sorted_by_time(measure(motion, until_s=20.0, seed=seed))
        rows = np.arange(len(measured))
        test = (rows % 7 == 3) & (rows > 20) & (rows < len(rows) - 20)
        found = fit_trajectory(measured.select(~test), prior=PRIOR, noise_scale=1.0)
        held_out = measured.select(test)
        squares.append(normalised_prediction_errors(found.trajectory, held_out) ** 2)
        halved.append(normalised_prediction_errors(found.trajectory, scale_noise(held_out, 100.0)) ** 2)
    assert np.mean(np.concatenate(squares)) == pytest.approx(1.0, abs=0.25)
    assert np.mean(np.concatenate(halved)) < 0.01


def test_statistics_of_normal_errors_and_of_one_outlier() -> None:
    """One outlier in a hundred raises the rms, and hardly the robust figure."""
    errors = np.random.default_rng(1).normal(size=2000)
    good = NormalisedErrorStatistics.of(errors)
    assert [good.rms, good.robust] == pytest.approx([1.0, 1.0], abs=0.05)
    assert good.beyond_3_29_sigma < 0.004
    errors[::100] = 20.0
    bad = NormalisedErrorStatistics.of(errors)
    assert bad.rms > 2.0
    assert bad.robust == pytest.approx(good.robust, abs=0.05)
    assert bad.beyond_3_29_sigma == pytest.approx(0.01, abs=0.004)


def test_parts_and_components_are_apart() -> None:
    """Moving, stationary and at gaps; points have other components than polar measurements."""
    sigmas = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0], [4.0, 4.0, 4.0]])
    polar = np.array([True, True, True, False])
    stationary, at_gap = np.array([False, True, False, True]), np.array([False, False, True, False])
    errors = HeldOutErrors(np.zeros(4), at_gap, NormalisedErrors(sigmas, np.arange(4), polar, stationary))
    found = {
        part: {name: each.rms for name, each in components.items()}
        for part, components in errors.normalised_statistics().items()
    }
    points = {"x": 4.0, "y": 4.0, "z": 4.0}
    polar_axes = ("range", "horizontal_angle", "zenith_angle")
    assert found["moving"] == dict(zip(polar_axes, (1.0, 2.0, 3.0), strict=True))
    assert found["stationary"] == dict(zip(polar_axes, (4.0, 5.0, 6.0), strict=True)) | points
    assert found["gaps"] == dict(zip(polar_axes, (7.0, 8.0, 9.0), strict=True))
    assert set(found["all"]) == {*polar_axes, *points}
