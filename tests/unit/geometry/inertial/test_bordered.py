"""Bordered block-tridiagonal systems against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.errors import GeometryError
from tsgt.geometry.inertial.bordered import BorderedCholesky, factorise_bordered

COUNT, SIZE, SHARED = 6, 4, 2


def example() -> tuple[np.ndarray, BorderedCholesky]:
    """Return a dense matrix and its factor."""
    rng = np.random.default_rng(0)
    factors = np.zeros((COUNT - 1, 2 * SIZE, COUNT * SIZE + SHARED))
    for step in range(COUNT - 1):
        factors[step, :, step * SIZE : (step + 2) * SIZE] = rng.normal(size=(2 * SIZE, 2 * SIZE))
        factors[step, :, -SHARED:] = rng.normal(size=(2 * SIZE, SHARED))
    dense = np.einsum("krc,krd->cd", factors, factors) + 0.1 * np.eye(COUNT * SIZE + SHARED)
    blocks = dense[:-SHARED, :-SHARED].reshape(COUNT, SIZE, COUNT, SIZE)
    diagonal = np.stack([blocks[k, :, k] for k in range(COUNT)])
    off_diagonal = np.stack([blocks[k, :, k + 1] for k in range(COUNT - 1)])
    border = dense[:-SHARED, -SHARED:].reshape(COUNT, SIZE, SHARED)
    return dense, factorise_bordered(diagonal, off_diagonal, border, dense[-SHARED:, -SHARED:])


def test_solution() -> None:
    """Solving equals the dense solution."""
    dense, factor = example()
    right = np.random.default_rng(1).normal(size=len(dense))
    states, shared = factor.solve(right[:-SHARED].reshape(COUNT, SIZE), right[-SHARED:])
    expected = np.linalg.solve(dense, right)
    np.testing.assert_allclose(np.append(states.ravel(), shared), expected, rtol=1e-9)


def test_marginals() -> None:
    """Covariances are blocks of the dense inverse."""
    dense, factor = example()
    inverse = np.linalg.inv(dense)
    blocks = inverse[:-SHARED, :-SHARED].reshape(COUNT, SIZE, COUNT, SIZE)
    diagonal, off_diagonal = factor.marginals()
    for k in range(COUNT):
        np.testing.assert_allclose(diagonal[k], blocks[k, :, k], rtol=1e-8, atol=1e-10)
    for k in range(COUNT - 1):
        np.testing.assert_allclose(off_diagonal[k], blocks[k, :, k + 1], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(factor.shared_covariance, inverse[-SHARED:, -SHARED:], rtol=1e-8)


def test_information_on_the_last_state() -> None:
    """What is left when all other states are eliminated is the inverse of the joint covariance."""
    dense, factor = example()
    kept = np.arange(len(dense) - SIZE - SHARED, len(dense))
    expected = np.linalg.inv(np.linalg.inv(dense)[np.ix_(kept, kept)])
    np.testing.assert_allclose(factor.last_information(), expected, rtol=1e-8, atol=1e-10)


def test_undetermined_shared_unknown() -> None:
    """An unknown that nothing determines is an error."""
    with pytest.raises(GeometryError, match="all states share"):
        factorise_bordered(
            np.tile(np.eye(3), (2, 1, 1)), np.zeros((1, 3, 3)), np.ones((2, 3, 1)), np.array([[6.0]])
        )
