"""Validity of the poses of a trajectory."""

from __future__ import annotations

import numpy as np
import pytest
from harness.drives.scene import SECOND, START, at_rest, stationary_scene

from tsgt.estimation import ContinuousPoseOutput, MeasurementHistory, Reason
from tsgt.geometry import exp_so3
from tsgt.geometry.trajectory import States

NONE = np.empty(0, np.int64)
SEEN = MeasurementHistory(NONE, NONE, NONE.astype(np.intp), np.empty(0), [NONE] * 3)


def test_negative_variance_is_not_valid() -> None:
    """However well the rotation is known."""
    parameters = stationary_scene().with_limits(estimator="continuous").parameters
    rotation, position = at_rest(0.0)
    still = np.zeros((2, 3))
    states = States(
        np.array([0.0, 1.0]), np.array([position] * 2), np.array([rotation] * 2), still, still, still, still
    )
    covariance = np.array([np.diag([1e-6] * 3 + [1e-4] * 3), np.diag([-1e-3] * 3 + [1e-4] * 3)])
    stamp_ns = np.array([START, START + SECOND])
    poses = ContinuousPoseOutput(parameters).smoothed(stamp_ns, SEEN, states, covariance)
    assert poses.valid.tolist() == [True, False]
    assert poses.reason[1] == Reason.OUTAGE


@pytest.mark.parametrize("known", [True, False])
def test_few_poses_are_judged_as_many(*, known: bool) -> None:
    """Live, without arrays, as in a batch: ages, residuals, outages, failed measurements, and validity with or without states."""
    parameters = stationary_scene().with_limits(estimator="continuous", tilt_limit_rad=1.0).parameters
    rng = np.random.default_rng(3)
    times_ns = START + np.sort(rng.integers(0, 60 * SECOND, 90)) // 10**8 * 10**8
    prisms = rng.integers(0, 3, 90).astype(np.intp)
    residuals_m = np.where(rng.random(90) < 0.1, np.nan, rng.choice([0.001, 0.03, 0.3], 90))
    unusable_ns = [np.array([START + 5 * SECOND]), NONE, START + np.arange(0, 60, 7) * SECOND]
    history = MeasurementHistory(times_ns, 4 + prisms, prisms, residuals_m, unusable_ns)
    stamp_ns = START + np.arange(-10, 500) * SECOND // 10
    count = len(stamp_ns)
    now_ns = int(times_ns[-1]) + 1000 * SECOND  # so late that nothing can come any more
    output = ContinuousPoseOutput(parameters)
    states, covariance = None, np.empty((0, 6, 6))
    if known:
        still = np.zeros((count, 3))
        rotation = exp_so3(rng.choice([0.1, 1.2], (count, 1)) * [1.0, 0.0, 0.0])
        states = States(stamp_ns / 1e9, rng.normal(size=(count, 3)), rotation, still, still, still, still)
        sigmas = np.repeat(rng.choice([0.001, 0.012, 0.028, 0.2, 2.0, np.nan], (count, 2)), 3, axis=1)
        covariance = np.where(np.isnan(sigmas), -1e-3, sigmas**2)[:, :, None] * np.eye(6)
    converged, ambiguous = rng.random((2, count)) < [[0.9], [0.1]]
    many = output.smoothed(stamp_ns, history, states, covariance, converged=converged, ambiguous=ambiguous)
    few = output.due(
        stamp_ns.tolist(),
        [SECOND] * count,
        now_ns,
        history,
        None if states is None else output.numbers(states, covariance),
        converged=converged.tolist(),
        ambiguous=ambiguous.tolist(),
    )
    for name in ("station", "age_s", "prism_residual_m", "prism_reason", "reason", "degraded", "position_m"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name), err_msg=name)
    np.testing.assert_allclose(few.residual_m, many.residual_m)
    assert set(np.unique(many.prism_reason)) == {Reason.VALID, Reason.OUTAGE, Reason.STATION_STATUS}
    assert not known or (len(np.unique(many.reason)), len(np.unique(many.degraded))) == (6, 10)
