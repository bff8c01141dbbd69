"""Closed form for triplets and batched SVD: against each other, against align(), and degenerate sets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry import BatchAlignment, align, align_many, align_triplets, exp_so3

LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])
R_TRUE = Rotation.random(2000, random_state=1).as_matrix()


def triplets(
    layout: np.ndarray, *, noise_m: float, offset_m: float, R: np.ndarray = R_TRUE, seed: int = 2
) -> np.ndarray:
    """Measure the layout at random poses."""
    rng = np.random.default_rng(seed)
    moved: np.ndarray = layout @ np.swapaxes(R, 1, 2) + offset_m * rng.normal(size=(len(R), 1, 3))
    return moved + rng.normal(scale=noise_m, size=moved.shape)


def assert_same(
    one: BatchAlignment, other: BatchAlignment, rotation_atol: float, position_atol_m: float
) -> None:
    """Both give the same transforms, none degenerate."""
    assert not one.degenerate.any()
    assert not other.degenerate.any()
    np.testing.assert_allclose(one.rotation, other.rotation, rtol=0, atol=rotation_atol)
    np.testing.assert_allclose(one.translation_m, other.translation_m, rtol=0, atol=position_atol_m)
    np.testing.assert_allclose(one.residuals_m, other.residuals_m, rtol=0, atol=position_atol_m)


@pytest.mark.parametrize("noise_m", [0.0, 0.003, 0.1])
def test_closed_form_agrees_with_svd(noise_m: float) -> None:
    """For three points the closed form is the SVD optimum to rounding, at any noise."""
    points = triplets(LAYOUT, noise_m=noise_m, offset_m=50)
    # Coordinates of 100 m are rounded to 1e-14 m; the layout is about 1 m wide.
    assert_same(align_triplets(LAYOUT, points), align_many(LAYOUT, points), 1e-12, 1e-12)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_closed_form_at_any_scale(scale: float) -> None:
    """A layout of micrometres or of a thousand kilometres is solved with the same relative precision."""
    points = scale * triplets(LAYOUT, noise_m=0.1, offset_m=1)
    one, other = align_triplets(scale * LAYOUT, points), align_many(scale * LAYOUT, points)
    assert_same(one, other, 1e-12, 1e-12 * scale)


def test_closed_form_far_from_the_origin() -> None:
    """In map coordinates of thousands of kilometres, rotations are good to the rounding of the coordinates."""
    points = triplets(LAYOUT, noise_m=0.01, offset_m=1e6)
    assert_same(align_triplets(LAYOUT, points), align_many(LAYOUT, points), 1e-8, 1e-8)


def test_closed_form_of_rotations_by_pi() -> None:
    """Rotations by pi about random axes, and the identity, are no special cases."""
    axes = np.concatenate(
        [np.eye(3), Rotation.random(50, random_state=3).as_matrix()[:, 0], np.zeros((1, 3))]
    )
    R = exp_so3(np.pi * axes)
    found = align_triplets(LAYOUT, triplets(LAYOUT, noise_m=0.0, offset_m=3, R=R))
    np.testing.assert_allclose(found.rotation, R, rtol=0, atol=1e-13)


def test_closed_form_of_unrelated_triangles() -> None:
    """Triangles unrelated to the layout get the least-squares rotation of the SVD."""
    points = np.random.default_rng(4).normal(size=(2000, 3, 3))
    # A sliver of a random triangle conditions its rotation badly; hence the wider tolerance.
    assert_same(align_triplets(LAYOUT, points), align_many(LAYOUT, points), 1e-8, 1e-8)


@pytest.mark.parametrize("count", [3, 4, 7])
def test_align_many_agrees_with_align(count: int) -> None:
    """align_many gives, set by set, the result of align for any number of points."""
    layout = np.random.default_rng(5).normal(size=(count, 3))
    points = triplets(layout, noise_m=0.05, offset_m=5)[:40]
    found = align_many(layout, points)
    for i in range(40):
        single = align(layout, points[i])
        np.testing.assert_allclose(found.rotation[i], single.rotation, atol=1e-12)
        np.testing.assert_allclose(found.translation_m[i], single.translation_m, atol=1e-12)
        np.testing.assert_allclose(found.residuals_m[i], single.residuals_m, atol=1e-12)


def test_align_many_never_mirrors() -> None:
    """Mirror images of a solid layout are fitted by proper rotations with large residuals."""
    layout = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.7, 0.0], [0.1, 0.2, 0.5]])
    found = align_many(layout, triplets(layout * (1, 1, -1), noise_m=0.0, offset_m=1))
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1.0, atol=1e-12)
    assert np.linalg.norm(found.residuals_m, axis=2).max(axis=1).min() > 0.1


def test_mirrored_triplet_is_rotated() -> None:
    """Three points are planar: a mirrored triangle fits without residual, upside down."""
    mirrored = LAYOUT * (1, -1, 1)
    found = align_triplets(LAYOUT, mirrored[None])
    np.testing.assert_allclose(found.residuals_m, 0, atol=1e-15)
    assert np.linalg.det(found.rotation[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("solve", [align_triplets, align_many])
@pytest.mark.parametrize(
    "measured",
    [
        np.zeros((3, 3)),
        np.full((3, 3), 1 / 3) + 40.0,
        np.outer([-1.0, 0.3, 2.0], [1.0, 1.0, -2.0]) + 40.0,
        np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]),
    ],
    ids=["origin", "coincident", "collinear", "two-at-one-place"],
)
def test_degenerate_set_is_marked(solve: object, measured: np.ndarray) -> None:
    """A degenerate set is marked, has the identity as rotation and finite numbers, and leaves its neighbours unchanged."""
    assert callable(solve)
    good = triplets(LAYOUT, noise_m=0.001, offset_m=10)[:2]
    found = solve(LAYOUT, np.stack([good[0], measured, good[1]]))
    assert found.degenerate.tolist() == [False, True, False]
    np.testing.assert_allclose(found.rotation[1], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(
        found.residuals_m[1], measured - LAYOUT - (measured - LAYOUT).mean(axis=0), atol=1e-13
    )
    np.testing.assert_array_equal(found.rotation[[0, 2]], solve(LAYOUT, good).rotation)


@pytest.mark.parametrize("solve", [align_triplets, align_many])
def test_empty_batch_gives_empty_arrays(solve: object) -> None:
    """An empty batch gives empty arrays of the right shapes."""
    assert callable(solve)
    found = solve(LAYOUT, np.empty((0, 3, 3)))
    assert found.rotation.shape == (0, 3, 3)
    assert found.translation_m.shape == (0, 3)
    assert found.residuals_m.shape == (0, 3, 3)
    assert found.degenerate.shape == (0,)


@pytest.mark.parametrize("solve", [align_triplets, align_many])
@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (np.ones((3, 3)), "layout points coincide"),
        (np.outer([0, 1, 3], [1, 2, 3]), "layout points lie in a line"),
        (LAYOUT[:2], "at least 3 layout points, got 2"),
    ],
)
def test_degenerate_layout_is_rejected(solve: object, layout: np.ndarray, message: str) -> None:
    """A layout without a plane raises an error, no batch of degenerate results."""
    assert callable(solve)
    with pytest.raises(DegenerateGeometryError, match=message):
        solve(layout, np.zeros((4, len(layout), 3)))


def test_closed_form_rejects_four_points() -> None:
    """The closed form is for three points only."""
    with pytest.raises(GeometryError, match="3 points, the layout has 4"):
        align_triplets(np.vstack([LAYOUT, [0, 0, 0]]), np.zeros((1, 4, 3)))


@pytest.mark.parametrize("solve", [align_triplets, align_many])
@pytest.mark.parametrize(
    ("points", "message"),
    [
        (LAYOUT, r"\(N, 3, 3\) .* got \(3, 3\)"),
        (np.zeros((5, 4, 3)), r"\(N, 3, 3\) .* got \(5, 4, 3\)"),
        (np.full((1, 3, 3), np.nan), "NaN"),
    ],
)
def test_invalid_points_are_rejected(solve: object, points: np.ndarray, message: str) -> None:
    """Points of the wrong shape or with NaN raise an error with the expected shape."""
    assert callable(solve)
    with pytest.raises(GeometryError, match=message):
        solve(LAYOUT, points)
