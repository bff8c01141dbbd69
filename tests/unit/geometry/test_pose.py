"""Poses from prisms: residuals, covariance by Monte Carlo and by derivatives, twists, degenerate layouts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry import align, check_layout, exp_so3, log_so3, pose_covariance, poses_from_prisms, twists

LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])
FOUR = np.vstack([LAYOUT, [0.1, -0.3, 0.2]])
R_TRUE = Rotation.from_rotvec([0.2, -0.1, 2.0]).as_matrix()
T_TRUE = np.array([60.0, 45.0, -1.0])
rotated_layouts = pytest.mark.parametrize("layout", [LAYOUT, FOUR], ids=["three", "four"])


@rotated_layouts
def test_pose_is_recovered(layout: np.ndarray) -> None:
    """Exact prisms reproduce the pose, with residuals of rounding."""
    found = poses_from_prisms(layout, (layout @ R_TRUE.T + T_TRUE)[None])
    np.testing.assert_allclose(found.rotation[0], R_TRUE, atol=1e-13)
    np.testing.assert_allclose(found.translation_m[0], T_TRUE, atol=1e-13)
    assert found.rms_m[0] < 1e-13


@rotated_layouts
def test_residuals_agree_with_align(layout: np.ndarray) -> None:
    """Residual lengths and rms are those of align for the same prisms."""
    points = layout @ R_TRUE.T + T_TRUE + np.random.default_rng(1).normal(scale=0.02, size=layout.shape)
    found, expected = poses_from_prisms(layout, points[None]), align(layout, points)
    np.testing.assert_allclose(found.residuals_m[0], np.linalg.norm(expected.residuals_m, axis=1), atol=1e-13)
    assert found.rms_m[0] == pytest.approx(expected.rms_m, abs=1e-13)


def test_coincident_prisms_are_degenerate() -> None:
    """Prisms measured at one place give a degenerate pose with finite numbers."""
    found = poses_from_prisms(LAYOUT, np.zeros((1, 3, 3)))
    assert found.degenerate.tolist() == [True]
    assert np.isfinite(found.rms_m).all()


@rotated_layouts
def test_covariance_matches_monte_carlo(layout: np.ndarray) -> None:
    """Errors of 20000 noisy fits have the stated covariance, about the robot's origin and the world's axes."""
    rng = np.random.default_rng(2)
    draws, prisms = 20_000, len(layout)
    factors = 0.001 * rng.normal(size=(prisms, 3, 3))
    noise = (factors @ rng.normal(size=(draws, prisms, 3, 1)))[..., 0]
    found = poses_from_prisms(layout, layout @ R_TRUE.T + T_TRUE + noise)
    errors = np.concatenate(
        [T_TRUE - found.translation_m, log_so3(R_TRUE @ np.swapaxes(found.rotation, 1, 2))], axis=1
    )
    predicted = pose_covariance(layout, R_TRUE[None], (factors @ np.swapaxes(factors, 1, 2))[None])[0]
    # Whitened, the sample covariance is the identity; with 20000 draws its entries scatter by sqrt(2/20000) = 0.01.
    whitening = np.linalg.inv(np.linalg.cholesky(predicted))
    np.testing.assert_allclose(whitening @ (errors.T @ errors / draws) @ whitening.T, np.eye(6), atol=0.05)


def test_covariance_agrees_with_numerical_derivatives() -> None:
    """Propagating through central differences of the fit gives the same matrix."""
    rng = np.random.default_rng(3)
    factors = 0.002 * rng.normal(size=(3, 3, 3))
    covariances = factors @ np.swapaxes(factors, 1, 2)
    exact = LAYOUT @ R_TRUE.T + T_TRUE
    step_m = 1e-5
    J = np.empty((6, 9))
    for k in range(9):
        shift = step_m * np.eye(9)[k].reshape(3, 3)
        fit = poses_from_prisms(LAYOUT, np.stack([exact + shift, exact - shift]))
        J[:3, k] = (fit.translation_m[0] - fit.translation_m[1]) / (2 * step_m)
        J[3:, k] = log_so3(fit.rotation[0] @ fit.rotation[1].T) / (2 * step_m)
    joint = np.zeros((9, 9))
    for i in range(3):
        joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = covariances[i]
    found = pose_covariance(LAYOUT, R_TRUE[None], covariances[None])[0]
    np.testing.assert_allclose(found, J @ joint @ J.T, rtol=1e-6, atol=1e-12)


def test_covariance_is_symmetric_to_the_bit() -> None:
    """The matrix equals its transpose exactly."""
    covariances = np.broadcast_to(np.diag([1e-6, 2e-6, 3e-6]), (1, 3, 3, 3))
    found = pose_covariance(LAYOUT, R_TRUE[None], covariances)[0]
    np.testing.assert_array_equal(found, found.T)


@rotated_layouts
def test_twist_of_a_rigid_motion(layout: np.ndarray) -> None:
    """Prism velocities of a rigid motion give its velocity in the world and angular velocity in the robot frame."""
    velocity_mps, turning_radps = np.array([1.0, -0.4, 0.1]), np.array([0.05, -0.1, 0.5])
    prism_velocities = velocity_mps + np.cross(turning_radps, layout) @ R_TRUE.T
    found_velocity, found_turning = twists(layout, R_TRUE[None], prism_velocities[None])
    np.testing.assert_allclose(found_velocity[0], velocity_mps, atol=1e-14)
    np.testing.assert_allclose(found_turning[0], turning_radps, atol=1e-14)


def test_twist_is_the_derivative_of_the_pose() -> None:
    """The difference of two poses a millisecond apart gives the twist."""
    step_s, turning_radps = 1e-3, np.array([0.1, 0.2, -0.6])
    R = np.stack(
        [R_TRUE @ exp_so3(-turning_radps * step_s / 2), R_TRUE @ exp_so3(turning_radps * step_s / 2)]
    )
    prisms = LAYOUT @ np.swapaxes(R, 1, 2)
    _, found = twists(LAYOUT, R_TRUE[None], ((prisms[1] - prisms[0]) / step_s)[None])
    np.testing.assert_allclose(found[0], turning_radps, atol=1e-7)


def test_good_layouts_pass() -> None:
    """The layouts of the field data and of the reference scenario are accepted."""
    check_layout(LAYOUT)
    check_layout(FOUR)


@pytest.mark.parametrize(
    ("layout", "names", "message"),
    [
        (LAYOUT[[0, 0, 2]], None, r"prisms 1 and 2 are 0\.0 mm apart"),
        (LAYOUT[[0, 1, 1]], [4, 7, 9], r"prisms 7 and 9 are 0\.0 mm apart"),
        (np.outer([0, 0.5, 1.2], [1, 1, 0]) + 0.003, None, "prisms 1, 2 and 3 lie nearly in a line"),
        ([[0, 0, 0], [1, 0, 0], [0.5, 0.005, 0]], None, r"they spread 2\.4 mm across it over 408\.2 mm"),
        (LAYOUT[:2], None, "at least 3 prisms on the robot, or an IMU and one: the layout has 2"),
    ],
)
def test_degenerate_layout_names_the_prisms(
    layout: np.ndarray, names: list[int] | None, message: str
) -> None:
    """Coincident, collinear and too few prisms are rejected by name, with the measure."""
    with pytest.raises(DegenerateGeometryError, match=message):
        check_layout(layout, names)


def test_imu_lets_few_prisms_suffice() -> None:
    """One, two, or three in a line; but not none, and not two at the same place."""
    for layout in (LAYOUT[:1], LAYOUT[:2], np.outer([0, 0.5, 1.2], [1, 1, 0])):
        check_layout(layout, imu=True)
    for layout, message in ((LAYOUT[:0], "the layout has 0"), (LAYOUT[[0, 0]], "prisms 1 and 2 are 0.0 mm")):
        with pytest.raises(DegenerateGeometryError, match=message):
            check_layout(layout, imu=True)


@pytest.mark.parametrize(
    ("layout", "message"), [(np.eye(3)[:, :2], "shape"), (np.full((3, 3), np.inf), "finite")]
)
def test_invalid_layout_is_rejected(layout: np.ndarray, message: str) -> None:
    """A layout of the wrong shape or with NaN or infinity raises an error."""
    with pytest.raises(GeometryError, match=message):
        check_layout(layout)
