"""Properties of all rotations, points and triangles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tsgt.geometry import (
    align,
    align_triplets,
    cartesian_to_polar,
    exp_so3,
    interpolate,
    invert,
    log_so3,
    polar_to_cartesian,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform_from,
    transform_points,
)

deterministic = settings(derandomize=True)


def vectors(limit: float, count: int | None = None) -> st.SearchStrategy[np.ndarray]:
    """3-vectors, or a number of them, with coordinates up to the limit."""
    return arrays(np.float64, (3,) if count is None else (count, 3), elements=st.floats(-limit, limit))


@deterministic
@given(vectors(10.0))
def test_exp_gives_proper_rotations(w: np.ndarray) -> None:
    """Every rotation vector gives an orthonormal, right-handed matrix."""
    R = exp_so3(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(R) > 0


@deterministic
@given(vectors(10.0))
def test_log_then_exp_is_the_same_rotation(w: np.ndarray) -> None:
    """The rotation vector has a length of at most pi and describes the same rotation."""
    R = exp_so3(w)
    found = log_so3(R)
    assert np.linalg.norm(found) <= np.pi + 1e-15
    np.testing.assert_allclose(exp_so3(found), R, atol=1e-13)


@deterministic
@given(vectors(10.0))
def test_quaternion_round_trip(w: np.ndarray) -> None:
    """Quaternions have unit length and w >= 0, and reproduce the rotation."""
    R = exp_so3(w)
    q = quaternion_from_rotation(R)
    assert q[3] >= 0
    assert abs(np.linalg.norm(q) - 1) < 1e-15
    np.testing.assert_allclose(rotation_from_quaternion(q), R, atol=1e-13)


@deterministic
@given(vectors(4.0), vectors(1e4), vectors(1e4, 5))
def test_inverse_transform_round_trip(w: np.ndarray, t: np.ndarray, points: np.ndarray) -> None:
    """Transform and inverse transform reproduce the points."""
    T = transform_from(exp_so3(w), t)
    np.testing.assert_allclose(transform_points(invert(T), transform_points(T, points)), points, atol=1e-10)


@deterministic
@given(vectors(1e4))
def test_polar_round_trip(point: np.ndarray) -> None:
    """Polar coordinates are in range and reproduce the point to rounding."""
    h, z, d = cartesian_to_polar(point)
    assert 0 <= h < 2 * np.pi
    assert 0 <= z <= np.pi
    np.testing.assert_allclose(polar_to_cartesian(h, z, d), point, atol=1e-11)


@deterministic
@given(vectors(1.0, 3), vectors(10.0, 3))
def test_closed_form_is_optimal(layout: np.ndarray, points: np.ndarray) -> None:
    """The squared residuals of the closed form are those of the SVD's optimum."""
    for triangle in (layout, points):
        area = np.linalg.norm(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0]))
        assume(area > 1e-3)
    found = align_triplets(layout, points[None])
    best = align(layout, points)
    assert not found.degenerate[0]
    np.testing.assert_allclose(
        (found.residuals_m**2).sum(), (best.residuals_m**2).sum(), rtol=1e-9, atol=1e-12
    )


@deterministic
@given(vectors(4.0), vectors(1e3), vectors(1.0, 3))
@pytest.mark.slow
def test_closed_form_is_equivariant(w: np.ndarray, t: np.ndarray, points: np.ndarray) -> None:
    """Transforming all measured points transforms the pose likewise."""
    layout = np.array([[0.4, 0.0, 0.0], [-0.3, 0.5, 0.1], [-0.2, -0.4, 0.3]])
    assume(np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0])) > 1e-2)
    R = exp_so3(w)
    before, after = align_triplets(layout, np.stack([points, points @ R.T + t])).rotation
    np.testing.assert_allclose(after, R @ before, atol=1e-8)


@deterministic
@given(
    st.lists(st.integers(0, 10**10), min_size=2, max_size=12, unique=True).map(sorted),
    st.lists(st.integers(-(10**9), 11 * 10**9), max_size=8),
    st.integers(1, 10**10),
)
def test_valid_epochs_lie_between_their_samples(times: list[int], epochs: list[int], limit_ns: int) -> None:
    """An epoch is valid exactly if neighbouring samples no further apart than the limit enclose it."""
    times_ns, epochs_ns = np.array(times), np.array(epochs, dtype=np.int64)
    found = interpolate(times_ns, np.column_stack([times_ns] * 3) * 1e-9, epochs_ns, limit_ns)
    for epoch_ns, valid, point in zip(epochs, found.valid, found.points, strict=True):
        pairs = pairwise(times)
        assert valid == any(a < epoch_ns <= b and b - a <= limit_ns for a, b in pairs)
        if valid:
            np.testing.assert_allclose(point, epoch_ns * 1e-9, atol=1e-12)
