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
from tsgt.geometry.trajectory import Observations, States, Trajectory
from tsgt.model import MotionPrior

LAYOUT = np.array([[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, 0.5, 1.5]])


def observations(count: int = 60, *, step_s: float = 0.1) -> Observations:
    """Return three prisms in turn on a robot that moves along x at 1 m/s without rotation."""
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


def test_each_measurement_but_the_outer_five_is_held_out_once() -> None:
    """Five folds per prism; test and training rows of a fold make up all measurements."""
    some = observations()
    splits = folds(some)
    assert [part.number for part in splits] == sorted([0, 1, 2, 3, 4] * 3)
    held_out = np.sort(np.concatenate([part.test for part in splits]))
    np.testing.assert_array_equal(held_out, np.arange(15, 45))
    for part in splits:
        assert len(set(some.prism[part.test])) == 1
        np.testing.assert_array_equal(np.sort(np.concatenate([part.test, part.training])), np.arange(60))


def test_fold_holds_out_every_fifth_measurement() -> None:
    """So that their neighbours remain."""
    part = next(part for part in folds(observations(150)) if part.number == 2)
    assert np.diff(part.test).tolist() == [15] * (len(part.test) - 1)


def test_prisms_with_few_measurements_are_never_held_out() -> None:
    """Ten of a prism are all outer ones."""
    assert folds(observations(30)) == []
    assert cross_validate([], lambda part: np.empty(len(part.test))).statistics.n == 0


def test_training_rows_are_disjoint_from_the_test_rows_of_their_number() -> None:
    """A prior may be tuned once for the three folds of a number."""
    some = observations()
    for part in folds(some):
        assert not set(training_rows(some, part.number)) & set(part.test)


def test_long_recordings_are_held_out_in_evenly_spread_spans() -> None:
    """Six spans of 30 s of an hour; hyperparameters of one number come from what is outside of all of them."""
    some = observations(10_800, step_s=1 / 3)
    splits = folds(some)
    assert {part.number for part in splits} == {0}
    tests = np.concatenate([part.test for part in splits])
    assert len(set(tests.tolist())) == len(tests)
    expected = [each for middle in range(300, 3600, 600) for each in range(middle - 15, middle + 16)]
    assert sorted(set(some.time_s[tests].round().astype(int).tolist())) == pytest.approx(expected, abs=2)
    assert not set(training_rows(some, 0)) & set(tests)
    assert len(training_rows(some, 0)) == len(some) - len(tests)


def test_fold_of_a_long_recording_is_predicted_from_its_neighbourhood() -> None:
    """All other measurements up to five seconds on either side of the span."""
    some = observations(10_800, step_s=1 / 3)
    for part in folds(some):
        near = np.sort(np.concatenate([part.test, part.training]))
        np.testing.assert_array_equal(near, np.arange(near[0], near[-1] + 1))
        assert np.ptp(some.time_s[near]) == pytest.approx(40.0, abs=1.0)


def test_span_without_a_prism_is_not_held_out() -> None:
    """There no trajectory of the rest may be determined."""
    some = observations(10_800, step_s=1 / 3)
    outage = (np.abs(some.time_s - 300.0) < 60.0) & (some.prism == 0)
    assert min(float(some.time_s[part.test[0]]) for part in folds(some.select(~outage))) > 600.0


def test_gaps_are_counted_separately() -> None:
    """Measurements whose remaining neighbours are more than a second apart."""
    some = observations()
    late = some.time_s + np.where(np.arange(60) >= 30, 0.5, 0.0)
    gapped = replace(some, time_s=late)
    splits = folds(gapped)
    found = cross_validate(splits, lambda part: interpolation_errors(gapped, part))
    assert found.gaps.n == 6  # the last before and the first after, of each prism
    assert found.statistics.n == 24
    assert found.statistics.mean == pytest.approx(0.0, abs=1e-9)
    # The robot did not move during the gap, but the straight line does.
    assert found.gaps.mean > 100.0
    regular = cross_validate(folds(some), lambda part: interpolation_errors(some, part))
    assert regular.gaps.n == 0


def test_interpolation_errors() -> None:
    """Oracle: the mean of the neighbours; a curve is cut off."""
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


def test_trajectory_errors() -> None:
    """A trajectory that is 3 mm and 4 mm off has an error of 5 mm at each measurement."""
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


def test_statistics_are_in_mm() -> None:
    """Mean, median and 95th percentile; NaN and a count of 0 without any."""
    found = PredictionErrorStatistics.of(np.array([0.001, 0.002, 0.006]))
    assert found.n == 3
    assert [found.mean, found.median, found.p95] == pytest.approx([3.0, 2.0, 5.6])
    assert PredictionErrorStatistics.of(np.empty(0)).n == 0
