from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tsgt.analysis.evaluation import (
    cross_validate,
    folds,
    interpolation_errors,
    training_rows,
    trajectory_errors,
)
from tsgt.analysis.evaluation.held_out import PredictionErrorStatistics
from tsgt.geometry import Observations
from tsgt.geometry.trajectory import States, Trajectory
from tsgt.model import MotionPrior

LAYOUT = np.array([[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, 0.5, 1.5]])


def observations(count: int = 60, *, step_s: float = 0.1) -> Observations:
    """Three prisms in turn, a robot that goes along x at 1 m/s without turning."""
    prism = np.arange(count) % 3
    time_s = np.arange(count, dtype=np.float64) * step_s
    points = LAYOUT[prism] + np.stack([time_s, np.zeros(count), np.zeros(count)], axis=1)
    return Observations(
        time_s=time_s,
        time_sigma_s=np.zeros(count),
        points_m=points,
        sigmas_m=np.full((count, 3), 1e-3),
        polar=np.zeros(count, np.bool_),
        station=np.zeros(count, np.intp),
        prism=prism,
        frames=np.eye(4)[None],
        layout=LAYOUT,
    )


def test_each_measurement_but_the_outer_five_is_left_out_once() -> None:
    """Five folds for each prism; what a fold leaves out and what it keeps make up all measurements."""
    some = observations()
    parts = folds(some)
    assert [part.number for part in parts] == sorted([0, 1, 2, 3, 4] * 3)
    left_out = np.sort(np.concatenate([part.test for part in parts]))
    np.testing.assert_array_equal(left_out, np.arange(15, 45))
    for part in parts:
        assert len(set(some.prism[part.test])) == 1
        np.testing.assert_array_equal(np.sort(np.concatenate([part.test, part.training])), np.arange(60))


def test_a_fold_leaves_every_fifth_out() -> None:
    """So the neighbours of what is left out stay."""
    part = next(part for part in folds(observations(150)) if part.number == 2)
    assert np.diff(part.test).tolist() == [15] * (len(part.test) - 1)


def test_prisms_with_few_measurements_are_never_left_out() -> None:
    """Ten of a prism are all outer ones."""
    assert folds(observations(30)) == []
    assert cross_validate([], lambda part: np.empty(len(part.test))).statistics.n == 0


def test_what_serves_all_folds_of_a_number_has_seen_none_of_them() -> None:
    """A prior may be tuned once for the three folds of a number."""
    some = observations()
    for part in folds(some):
        assert not set(training_rows(some, part.number)) & set(part.test)


def test_gaps_count_apart() -> None:
    """Where the remaining neighbours are more than a second apart, a straight line is not what is asked for."""
    some = observations()
    late = some.time_s + np.where(np.arange(60) >= 30, 0.5, 0.0)
    gapped = replace(some, time_s=late)
    parts = folds(gapped)
    found = cross_validate(parts, lambda part: interpolation_errors(gapped, part))
    assert found.gaps.n == 6  # the last before and the first after, of each prism
    assert found.statistics.n == 24
    assert found.statistics.mean == pytest.approx(0.0, abs=1e-9)
    # The robot did not move while nothing was measured, as a straight line has it do.
    assert found.gaps.mean > 100.0
    standing = cross_validate(folds(some), lambda part: interpolation_errors(some, part))
    assert standing.gaps.n == 0


def test_lines_join_the_remaining_measurements() -> None:
    """Oracle: the middle of the neighbours; a bend is cut off."""
    some = observations()
    bent = some.points_m.copy()
    bent[:, 1] += some.time_s**2
    curved = replace(some, points_m=bent)
    part = folds(curved)[0]
    expected = [
        np.linalg.norm((curved.points_m[row - 3] + curved.points_m[row + 3]) / 2 - curved.points_m[row])
        for row in part.test
    ]
    np.testing.assert_allclose(interpolation_errors(curved, part), expected)


def test_a_trajectory_is_asked_where_the_prism_is() -> None:
    """One that is 3 mm and 4 mm off misses each measurement by 5 mm."""
    some = observations()
    time_s = np.array([0.0, 6.0])
    zero = np.zeros((2, 3))
    knots = States(
        time_s,
        np.array([[0.003, 0.004, 0.0], [6.003, 0.004, 0.0]]),
        np.broadcast_to(np.eye(3), (2, 3, 3)),
        np.array([[1.0, 0.0, 0.0]] * 2),
        *(zero, zero, zero),
    )
    trajectory = Trajectory(knots, MotionPrior(), np.zeros((2, 18, 18)), np.zeros((1, 18, 18)))
    np.testing.assert_allclose(trajectory_errors(trajectory, some), 0.005, rtol=1e-6)


def test_figures_are_in_mm() -> None:
    """Mean, median and 95th percentile; NaN and a count of 0 without any."""
    found = PredictionErrorStatistics.of(np.array([0.001, 0.002, 0.006]))
    assert found.n == 3
    assert [found.mean, found.median, found.p95] == pytest.approx([3.0, 2.0, 5.6])
    assert PredictionErrorStatistics.of(np.empty(0)).n == 0
