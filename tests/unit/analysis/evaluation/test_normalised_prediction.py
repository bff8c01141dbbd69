"""Prediction errors in sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.prior_motion import draw_motions, measure, sorted_by_time

from tsgt.analysis.evaluation import NormalisedErrorStatistics, near_loss, normalised_prediction_errors
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


def test_near_loss_is_a_second_on_either_side_of_a_gap_of_the_same_station() -> None:
    """Station 0 has a gap from 4 to 6 s, station 1 has none."""
    own_s = np.array([0.0, 1.0, 2.9, 3.5, 4.0, 6.0, 6.5, 7.1])
    regular_s = np.arange(0.0, 10.0, 0.5)
    time_s = np.concatenate([own_s[2:], regular_s])
    station = np.repeat([0, 1], [len(own_s) - 2, len(regular_s)])
    order = np.argsort(time_s, kind="stable")
    near = near_loss(time_s[order], station[order])
    assert time_s[order][near].tolist() == [3.5, 4.0, 6.0, 6.5]
    assert not near[station[order] == 1].any()


def test_gross_error_near_a_loss_is_no_surprise() -> None:
    """An error of 60 mm is 30 sigmas elsewhere and 2 to 3.3 near a loss; small errors are hardly affected."""
    measured = sorted_by_time(
        measure(draw_motions(PRIOR, count=1, duration_s=11.0, seed=3)[0], until_s=10.0, seed=1)
    )
    trajectory = fit_trajectory(measured, prior=PRIOR, noise_scale=1.0).trajectory
    points = measured.points_m.copy()
    points[30] *= 1.0 + 0.06 / np.linalg.norm(points[30])
    test = replace(measured, points_m=points)
    near = np.ones(len(test), dtype=bool)
    elsewhere, beside = (normalised_prediction_errors(trajectory, test, each) for each in (None, near))
    assert abs(elsewhere[30, 0]) > 15.0
    assert 2.0 < abs(beside[30, 0]) < 3.3
    assert np.sign(beside[30, 0]) == np.sign(elsewhere[30, 0])
    np.testing.assert_allclose(np.delete(beside, 30, axis=0), np.delete(elsewhere, 30, axis=0), atol=0.25)


def test_statistics_of_normal_errors_and_of_one_outlier() -> None:
    """One outlier in a hundred raises the rms, and hardly the robust figure."""
    errors = np.random.default_rng(1).normal(size=2000)
    good = NormalisedErrorStatistics.of(errors)
    assert [good.rms, good.robust] == pytest.approx([1.0, 1.0], abs=0.05)
    assert good.beyond < 0.004
    errors[::100] = 20.0
    bad = NormalisedErrorStatistics.of(errors)
    assert bad.rms > 2.0
    assert bad.robust == pytest.approx(good.robust, abs=0.05)
    assert bad.beyond == pytest.approx(0.01, abs=0.004)
