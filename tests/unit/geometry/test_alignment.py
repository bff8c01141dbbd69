"""align(): against brute force and Monte Carlo, and degenerate point sets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry import align, exp_so3, log_so3, transform_points

SOURCE = np.array([[0.0, 0.0, 0.0], [12.0, 1.0, 0.5], [3.0, 9.0, -1.0], [-6.0, 4.0, 2.0], [8.0, -7.0, 0.3]])
R_TRUE = Rotation.from_rotvec([0.3, -0.2, 2.5]).as_matrix()
T_TRUE = np.array([40.0, -12.0, 1.5])


def noisy_target(seed: int, sigma_m: float = 0.02) -> np.ndarray:
    """Transform the source by the true transform, with white noise."""
    moved: np.ndarray = SOURCE @ R_TRUE.T + T_TRUE
    return moved + np.random.default_rng(seed).normal(scale=sigma_m, size=SOURCE.shape)


@pytest.mark.parametrize("n", [3, 4, 5])
def test_exact_points_are_recovered(n: int) -> None:
    """Without noise the transform is exact, and residuals and estimated covariance vanish."""
    found = align(SOURCE[:n], noisy_target(0, 0.0)[:n])
    np.testing.assert_allclose(found.rotation, R_TRUE, atol=1e-14)
    np.testing.assert_allclose(found.translation_m, T_TRUE, atol=1e-13)
    assert found.rms_m < 1e-13
    assert np.abs(found.covariance).max() < 1e-26


@pytest.mark.parametrize("weights", [None, (1.0, 4.0, 0.3, 2.0, 9.0)])
def test_optimum_is_that_of_brute_force(weights: tuple[float, ...] | None) -> None:
    """A general minimiser converges to the same transform; weighted as well."""
    target = noisy_target(1, 0.3)
    root = np.sqrt(np.ones(5) if weights is None else weights)[:, None]

    def residuals(x: np.ndarray) -> np.ndarray:
        moved = Rotation.from_rotvec(x[3:]).apply(SOURCE) + x[:3]
        flat: np.ndarray = (root * (target - moved)).ravel()
        return flat

    brute = least_squares(residuals, [30.0, 0, 0, 0.2, 0.0, 2.0], xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    found = align(SOURCE, target, weights=weights)
    np.testing.assert_allclose(found.translation_m, brute[:3], atol=1e-6)
    np.testing.assert_allclose(log_so3(found.rotation), brute[3:], atol=1e-7)


def test_residuals_are_target_minus_transformed_source() -> None:
    """T, residuals and rms are consistent."""
    target = noisy_target(2)
    found = align(SOURCE, target, weights=[1, 2, 3, 4, 5])
    residuals = target - transform_points(found.T, SOURCE)
    np.testing.assert_allclose(found.residuals_m, residuals, atol=1e-14)
    assert found.rms_m == pytest.approx(np.sqrt(np.mean(np.linalg.norm(residuals, axis=1) ** 2)))


def test_only_ratios_of_weights_count() -> None:
    """Scaling all weights changes neither transform nor covariance."""
    weights = np.array([1.0, 4.0, 0.3, 2.0, 9.0])
    one, other = (align(SOURCE, noisy_target(3), weights=w) for w in (weights, 1000 * weights))
    np.testing.assert_allclose(one.T, other.T, atol=1e-13)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-9, atol=1e-18)


def test_mirrored_target_still_gives_a_proper_rotation() -> None:
    """A mirrored point set is fitted by a proper rotation with large residuals."""
    found = align(SOURCE, SOURCE * (1, 1, -1))
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.rms_m > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("weights", [None, (1.0, 4.0, 0.3, 2.0, 9.0)])
def test_covariance_matches_monte_carlo(weights: tuple[float, ...] | None) -> None:
    """Errors of 4000 fits with anisotropic noise have the propagated covariance, order and axes included."""
    rng = np.random.default_rng(4)
    factors = 0.005 * rng.normal(size=(5, 3, 3))
    covariances = factors @ np.swapaxes(factors, 1, 2)
    exact = noisy_target(0, 0.0)
    errors = np.empty((4000, 6))
    for row in errors:
        noise = (factors @ rng.normal(size=(5, 3, 1)))[:, :, 0]
        found = align(SOURCE, exact + noise, weights=weights, covariances=covariances)
        # T_true = [exp(dtheta) R | t + dt]
        row[:3] = T_TRUE - found.translation_m
        row[3:] = log_so3(R_TRUE @ found.rotation.T)
    predicted = align(SOURCE, exact, weights=weights, covariances=covariances).covariance
    # Whitened, the sample covariance is the identity; with 4000 draws its entries scatter by sqrt(2/4000) = 0.022.
    whitening = np.linalg.inv(np.linalg.cholesky(predicted))
    sample = whitening @ (errors.T @ errors / len(errors)) @ whitening.T
    np.testing.assert_allclose(sample, np.eye(6), atol=0.1)


@pytest.mark.slow
def test_covariance_from_residuals_is_unbiased() -> None:
    """Without covariances the noise is estimated from the residuals without bias, weights being inverse variances."""
    rng = np.random.default_rng(5)
    weights = np.array([1.0, 4.0, 0.5, 2.0, 9.0])
    sigma_m = 0.01 / np.sqrt(weights)
    exact = noisy_target(0, 0.0)
    known = align(
        SOURCE, exact, weights=weights, covariances=sigma_m[:, None, None] ** 2 * np.eye(3)
    ).covariance
    estimated = np.mean(
        [
            align(SOURCE, exact + sigma_m[:, None] * rng.normal(size=(5, 3)), weights=weights).covariance
            for _ in range(2000)
        ],
        axis=0,
    )
    # One estimate of the variance scatters by sqrt(2/9), the mean of 2000 by 0.011.
    np.testing.assert_allclose(np.diag(estimated), np.diag(known), rtol=0.05)


def test_covariance_far_from_the_origin_keeps_its_precision() -> None:
    """In map coordinates, 500 km from the origin, the rotation covariance is the same as at the origin."""
    covariances = np.broadcast_to(1e-6 * np.eye(3), (5, 3, 3))
    near = align(SOURCE, SOURCE, covariances=covariances).covariance
    far = align(SOURCE + 5e5, SOURCE, covariances=covariances).covariance
    np.testing.assert_allclose(far[3:, 3:], near[3:, 3:], rtol=1e-6)
    assert np.linalg.eigvalsh(far).min() > -1e-9 * np.linalg.eigvalsh(far).max()


def test_large_offset_keeps_the_rotation() -> None:
    """Points 1e6 m from the origin give the rotation to the rounding of their coordinates."""
    found = align(SOURCE + 1e6, (SOURCE @ R_TRUE.T) - 1e6)
    np.testing.assert_allclose(found.rotation, R_TRUE, atol=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, 1), (0.6, 0.8, 0)])
def test_rotation_by_pi_is_recovered(axis: tuple[float, ...]) -> None:
    """A rotation by pi is no special case."""
    R = exp_so3(np.pi * np.array(axis))
    np.testing.assert_allclose(align(SOURCE, SOURCE @ R.T).rotation, R, atol=1e-14)


LINE = np.outer([0.0, 1.0, 2.5, 7.0], [1.0, 2.0, -1.0]) + np.array([100.0, 0.0, 50.0])


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (SOURCE[:2], SOURCE[:2], "at least 3 source points, got 2"),
        (np.ones((4, 3)), SOURCE[:4], "4 source points coincide"),
        (SOURCE[:4], np.full((4, 3), 1 / 3), "4 target points coincide"),
        (LINE, SOURCE[:4], "source points lie in a line: .* ratio of .* expected more than 1e-06"),
        (SOURCE[:4], LINE, "target points lie in a line"),
    ],
)
def test_degenerate_points_are_rejected(source: np.ndarray, target: np.ndarray, message: str) -> None:
    """Too few, coincident and collinear points are rejected, with expected and got."""
    with pytest.raises(DegenerateGeometryError, match=message):
        align(source, target)


def test_nearly_collinear_points_are_still_aligned() -> None:
    """Nearly collinear points are aligned; the covariance about their line shows the uncertainty."""
    source = LINE + np.outer([0.0, 1e-4, -1e-4, 0.0], [0.0, 1.0, 2.0])
    along = np.array([1.0, 2.0, -1.0]) / np.sqrt(6)
    variances = np.linalg.eigh(align(source, source, covariances=[1e-6 * np.eye(3)] * 4).covariance[3:, 3:])
    assert np.sqrt(variances.eigenvalues[-1]) > 1.0
    np.testing.assert_allclose(np.abs(variances.eigenvectors[:, -1] @ along), 1.0, atol=1e-3)


def test_ambiguous_mirror_image_is_rejected() -> None:
    """A regular tetrahedron and its mirror image have no unique best rotation."""
    tetrahedron = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    with pytest.raises(DegenerateGeometryError, match="mirror image"):
        align(tetrahedron, -tetrahedron)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"source": np.ones((4, 2))}, "shape"),
        ({"target": SOURCE[:4]}, "got 4 and 5"),
        ({"target": SOURCE * np.nan}, "NaN"),
        ({"weights": [1, 1, 1, 1]}, "5 positive weights"),
        ({"weights": [1, 1, 1, 1, 0]}, "5 positive weights"),
        ({"weights": [1, 1, 1, 1, np.nan]}, "5 positive weights"),
        ({"covariances": np.eye(3)}, "5 finite 3x3 covariances"),
        ({"covariances": np.full((5, 3, 3), np.nan)}, "5 finite 3x3 covariances"),
    ],
)
def test_invalid_input_is_rejected(changed: dict[str, np.ndarray], message: str) -> None:
    """Shapes that do not match, NaN and weights that are not positive raise an error."""
    with pytest.raises(GeometryError, match=message):
        align(**{"source": SOURCE, "target": SOURCE, **changed})
