from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tsgt.geometry import polar_to_cartesian
from tsgt.web import frames


def test_rotations_are_those_of_scipy() -> None:
    """Rotation of a vector, product, inverse."""
    a, b = Rotation.random(2, rng=np.random.default_rng(1))
    v = (1.0, -2.0, 0.5)
    qa, qb = ((float(x), float(y), float(z), float(w)) for x, y, z, w in (a.as_quat(), b.as_quat()))
    assert np.allclose(frames.rotate(qa, v), a.apply(v))
    assert np.allclose(frames.rotate(frames.product(qa, qb), v), (a * b).apply(v))
    assert np.allclose(frames.rotate(frames.inverse(qa), v), a.inv().apply(v))


def test_line_of_sight_is_that_of_the_geometry() -> None:
    """In both faces."""
    for horizontal, zenith in ((0.3, 1.2), (4.0, 1.7), (0.3 + np.pi, 2 * np.pi - 1.2)):
        assert np.allclose(frames.direction(horizontal, zenith), polar_to_cartesian(horizontal, zenith, 1.0))


def test_worst_sigma_is_the_largest_eigenvalue() -> None:
    """Of either block, also of one that is a multiple of the identity, or zero."""
    rng = np.random.default_rng(2)
    for matrix in (*(m @ m.T for m in rng.normal(size=(20, 6, 6))), np.eye(6) * 4.0, np.zeros((6, 6))):
        for first in (0, 3):
            expected = np.sqrt(np.linalg.eigvalsh(matrix[first : first + 3, first : first + 3])[-1])
            assert np.isclose(frames.worst_sigma(tuple(matrix.ravel()), first), expected, atol=1e-7)
