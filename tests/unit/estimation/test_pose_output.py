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
