"""Scale of the covariance of predictions by the errors of earlier ones."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.geometry.trajectory.prediction_errors import MIN_SCALE, PredictionErrorMonitor
from tsgt.geometry.trajectory.states import States

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

VARIANCES = np.array([4e-4] * 3 + [1e-4] * 3)
ERROR = np.sqrt(VARIANCES)


class StillTrajectory:
    """A trajectory at the origin without uncertainty."""

    def at(self, time_s: FloatArray, *, dim: int) -> tuple[States, FloatArray]:
        """Return its states."""
        n, zero = len(time_s), np.zeros((len(time_s), 3))
        states = States(time_s, zero, np.tile(np.eye(3), (n, 1, 1)), zero, zero, zero, zero)
        return states, np.zeros((n, dim, dim))


def predicted(time_s: float, error: FloatArray, speed_mps: float) -> States:
    """Return a state that is off by an error, (6,)."""
    (state, _) = StillTrajectory().at(np.array([time_s]), dim=6)
    return replace(
        state.retract(np.concatenate([error, np.zeros(12)])[None]), velocity=np.array([[speed_mps, 0, 0]])
    )


def scales(share: float, *, predictions: int, speed_mps: float = 1.0) -> FloatArray:
    """Variances of the next prediction relative to the prior's, after errors of this share of its sigmas."""
    monitor, rng = PredictionErrorMonitor(), np.random.default_rng(1)
    for number in range(predictions):
        error = share * ERROR * rng.normal(size=6)
        monitor.record(predicted(0.1 * number + 1e-3, error, speed_mps), np.diag(VARIANCES)[None])
    monitor.compare_before(np.inf, StillTrajectory())  # type: ignore[arg-type]
    found: FloatArray = np.diagonal(monitor.scaled(np.diag(VARIANCES)[None])[0]) / VARIANCES
    return found


def test_small_errors_shrink_the_axes_of_the_ground() -> None:
    """Vertical, roll and pitch to what they are; the operator's axes keep the covariance of the prior."""
    found = scales(0.7, predictions=3000)
    assert found[[0, 1, 5]] == pytest.approx(1.0)
    assert found[[2, 3, 4]] == pytest.approx(0.49, rel=0.25)


def test_scale_starts_at_the_prior() -> None:
    """A few seconds of smooth ground are no evidence."""
    assert scales(0.1, predictions=20)[[2, 3, 4]] == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("share", "limit"), [(0.01, MIN_SCALE), (2.0, 1.0)])
def test_scale_has_limits(share: float, limit: float) -> None:
    """Rough ground may follow; the prior is an upper limit."""
    assert scales(share, predictions=3000)[[2, 3, 4]] == pytest.approx(limit)


def test_rest_is_no_evidence() -> None:
    """A robot that waits for minutes drives off on ground that is as rough as ever."""
    assert scales(0.01, predictions=1000, speed_mps=0.0) == pytest.approx(1.0)


def test_rough_ground_is_learnt_within_seconds() -> None:
    """After minutes on smooth ground."""
    monitor, rng = PredictionErrorMonitor(), np.random.default_rng(2)
    for number in range(1000):
        error = (0.1 if number < 900 else 1.0) * ERROR * rng.normal(size=6)
        monitor.record(predicted(0.1 * number + 1e-3, error, 1.0), np.diag(VARIANCES)[None])
    monitor.compare_before(90.0, StillTrajectory())  # type: ignore[arg-type]
    before = monitor.scaled(np.diag(VARIANCES)[None])[0, 2, 2]
    monitor.compare_before(np.inf, StillTrajectory())  # type: ignore[arg-type]
    assert before == pytest.approx(MIN_SCALE * VARIANCES[2])
    assert monitor.scaled(np.diag(VARIANCES)[None])[0, 2, 2] > 2 * before
