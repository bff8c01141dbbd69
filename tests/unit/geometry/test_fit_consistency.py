"""Residuals of rigid fits against the covariances of the prisms."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.stats import chi2

from tsgt.geometry import covariance_scale, exp_so3, poses_from_prisms, skew, squared_misfit

if TYPE_CHECKING:
    from numpy.typing import NDArray

LAYOUT = np.array([[0.4, 0.0, 0.8], [-0.3, 0.35, 0.9], [-0.3, -0.35, 1.0], [0.1, 0.2, 1.4], [0.0, -0.3, 1.2]])
SIGMA_M = 0.003
NO_COMMON_ERRORS = np.zeros((1, 1, 3, 0))


def _measured(
    count: int, prisms: int, *, shared_m: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return true rotations, and points with noise and an error along x that the first two prisms share."""
    rng = np.random.default_rng(prisms)
    rotation = exp_so3(rng.normal(size=(count, 3)))
    points = rng.normal(size=(count, 1, 3)) * 20 + LAYOUT[:prisms] @ rotation.swapaxes(1, 2)
    points += rng.normal(scale=SIGMA_M, size=points.shape)
    points[:, :2, 0] += rng.normal(scale=shared_m, size=(count, 1))
    return rotation, points


def _misfit(
    points: NDArray[np.float64], common_errors: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int]:
    count, prisms = points.shape[:2]
    layout = LAYOUT[:prisms]
    poses = poses_from_prisms(layout, points)
    covariances = np.tile(SIGMA_M**2 * np.eye(3), (count, prisms, 1, 1))
    errors = np.broadcast_to(common_errors, (count, prisms, 3, common_errors.shape[-1]))
    return squared_misfit(layout, poses.rotation, poses.translation_m, points, covariances, errors)


@pytest.mark.parametrize(("prisms", "freedom"), [(3, 3), (4, 6), (5, 9)])
def test_noise_as_stated_has_the_distribution_of_chi_squares(prisms: int, freedom: int) -> None:
    """Mean, and shares above two quantiles, of 20,000 fits."""
    squared, found = _misfit(_measured(20_000, prisms)[1], NO_COMMON_ERRORS)
    assert found == freedom
    assert np.mean(squared) == pytest.approx(freedom, rel=0.03)
    for share in (0.5, 0.99):
        assert np.mean(squared < chi2.ppf(share, freedom)) == pytest.approx(share, abs=0.01)


def test_errors_that_prisms_share_are_allowed_for() -> None:
    """20 mm of the first two along x: far beyond their noise, and as stated when it is stated."""
    _, points = _measured(5000, 3, shared_m=0.02)
    common_errors = np.zeros((1, 3, 3, 1))
    common_errors[0, :2, 0, 0] = 0.02
    assert np.mean(_misfit(points, NO_COMMON_ERRORS)[0]) > 15
    assert np.mean(_misfit(points, common_errors)[0]) == pytest.approx(3, rel=0.05)


def test_motions_of_the_robot_leave_no_misfit() -> None:
    """Errors that move all prisms like a rigid body change nothing."""
    rotation, points = _measured(100, 3)
    moved = points + 0.01 + (rotation @ (skew(np.array([0.0, 0.0, 0.01])) @ LAYOUT[:3].T)).swapaxes(1, 2)
    assert _misfit(moved, NO_COMMON_ERRORS)[0] == pytest.approx(_misfit(points, NO_COMMON_ERRORS)[0], rel=0.1)


def test_scale_never_shrinks_and_follows_large_misfits() -> None:
    """Residuals that are a hundred times as large as stated, squared, make covariances nearly so; small ones nothing smaller."""
    assert covariance_scale(np.array([0.0, 3.0, 300.0, 30_000.0]), 3) == pytest.approx(
        [1.0, 1.0, 310 / 13, 30_010 / 13]
    )
