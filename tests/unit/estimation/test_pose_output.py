"""Validity of the poses of a trajectory."""

from __future__ import annotations

import numpy as np
from harness.scene import SECOND, START, at_rest, stationary_scene

from tsgt.estimation import ContinuousPoseOutput, MeasurementHistory, Reason
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


def test_few_poses_are_described_as_many() -> None:
    """Live, without arrays, as in a batch: ages, residuals, outages and failed measurements of each prism."""
    parameters = stationary_scene().with_limits(estimator="continuous").parameters
    rng = np.random.default_rng(3)
    times_ns = START + np.sort(rng.integers(0, 60 * SECOND, 90)) // 10**8 * 10**8
    prisms = rng.integers(0, 3, 90).astype(np.intp)
    residuals_m = np.where(rng.random(90) < 0.1, np.nan, rng.random(90))
    unusable_ns = [np.array([START + 5 * SECOND]), NONE, START + np.arange(0, 60, 7) * SECOND]
    history = MeasurementHistory(times_ns, 4 + prisms, prisms, residuals_m, unusable_ns)
    stamp_ns = START + np.arange(-10, 500) * SECOND // 10
    sent_ns = np.maximum(stamp_ns, times_ns[-1]) + 100 * SECOND  # so late that nothing can come any more
    output = ContinuousPoseOutput(parameters)
    none = np.empty((0, 6, 6))
    many = output.smoothed(stamp_ns, history, None, none)
    delays_ns = sent_ns - stamp_ns
    few = output.due(stamp_ns.tolist(), delays_ns.tolist(), sent_ns.tolist(), history, None, none)
    for name in ("station", "age_s", "prism_residual_m", "prism_reason", "reason"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name), err_msg=name)
    assert set(np.unique(many.prism_reason)) == {Reason.VALID, Reason.OUTAGE, Reason.STATION_STATUS}
