"""Block-tridiagonal systems against dense ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.errors import GeometryError
from tsgt.geometry.trajectory.block_tridiagonal import factorise

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray


def random_system(count: int, size: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Random positive definite matrix: blocks on and right of its diagonal, and dense."""
    rng = np.random.default_rng(count)
    root = np.zeros((count * size, count * size))
    for k in range(count):
        here = slice(k * size, (k + 1) * size)
        root[here, here] = rng.normal(size=(size, size)) / size + 2 * np.eye(size)
        if k:
            root[here, (k - 1) * size : k * size] = rng.normal(size=(size, size)) / size
    whole = root @ root.T
    blocks = whole.reshape(count, size, count, size).transpose(0, 2, 1, 3)
    rows = np.arange(count)
    return blocks[rows, rows], blocks[rows[:-1], rows[1:]], whole


SHAPES = [(1, 1), (1, 4), (2, 3), (7, 5), (30, 18)]


@pytest.mark.parametrize(("count", "size"), SHAPES)
def test_solve_agrees_with_dense(count: int, size: int) -> None:
    """One and several right-hand sides."""
    diagonal, off_diagonal, whole = random_system(count, size)
    factor = factorise(diagonal, off_diagonal)
    right = np.random.default_rng(0).normal(size=(count, size, 3))
    expected = np.linalg.solve(whole, right.reshape(-1, 3)).reshape(right.shape)
    np.testing.assert_allclose(factor.solve(right), expected, atol=1e-12)
    np.testing.assert_allclose(factor.solve(right[:, :, 1]), expected[:, :, 1], atol=1e-12)


@pytest.mark.parametrize(("count", "size"), SHAPES)
def test_quadratic_form_agrees_with_dense(count: int, size: int) -> None:
    """Of several right-hand sides with each other."""
    diagonal, off_diagonal, whole = random_system(count, size)
    right = np.random.default_rng(0).normal(size=(count, size, 3))
    flat = right.reshape(-1, 3)
    found = factorise(diagonal, off_diagonal).quadratic_form(right)
    np.testing.assert_allclose(found, flat.T @ np.linalg.solve(whole, flat), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("count", "size"), SHAPES)
def test_marginals_are_blocks_of_the_inverse(count: int, size: int) -> None:
    """Marginals and cross-covariances are the inverse's blocks."""
    diagonal, off_diagonal, whole = random_system(count, size)
    own, next_to = factorise(diagonal, off_diagonal).marginals()
    inverse = np.linalg.inv(whole).reshape(count, size, count, size).transpose(0, 2, 1, 3)
    k = np.arange(count)
    np.testing.assert_allclose(own, inverse[k, k], atol=1e-13)
    np.testing.assert_allclose(next_to, inverse[k[:-1], k[1:]], atol=1e-13)


@pytest.mark.parametrize(("count", "size"), SHAPES)
def test_addition_to_the_last_block_agrees_with_a_new_factorisation(count: int, size: int) -> None:
    """The factor that it was made from stays as it is."""
    diagonal, off_diagonal, _ = random_system(count, size)
    jacobian = np.random.default_rng(1).normal(size=(3, size))
    before = factorise(diagonal, off_diagonal)
    banded = before.banded.copy()
    found = before.with_last_block_added(jacobian.T @ jacobian)
    diagonal[-1] += jacobian.T @ jacobian
    np.testing.assert_allclose(found.banded, factorise(diagonal, off_diagonal).banded, atol=1e-12)
    np.testing.assert_array_equal(before.banded, banded)


def test_negative_addition_to_the_last_block_is_not_determined() -> None:
    """An error of this package, as from the whole factorisation."""
    diagonal, off_diagonal, _ = random_system(3, 4)
    with pytest.raises(GeometryError, match="do not determine"):
        factorise(diagonal, off_diagonal).with_last_block_added(-1e3 * np.eye(4))


@pytest.mark.parametrize(("count", "size"), SHAPES)
def test_log_determinant_agrees_with_dense(count: int, size: int) -> None:
    """The log determinant equals the dense one."""
    diagonal, off_diagonal, whole = random_system(count, size)
    assert factorise(diagonal, off_diagonal).log_determinant() == pytest.approx(
        np.linalg.slogdet(whole)[1], rel=1e-12
    )


def test_upper_triangles_of_the_diagonal_are_ignored() -> None:
    """Only the lower triangles of the diagonal blocks are read."""
    diagonal, off_diagonal, _ = random_system(4, 3)
    changed = np.tril(diagonal)
    np.testing.assert_array_equal(
        factorise(changed, off_diagonal).banded, factorise(diagonal, off_diagonal).banded
    )


def test_singular_matrix_is_rejected() -> None:
    """A matrix that is not positive definite raises an error."""
    diagonal, off_diagonal, _ = random_system(4, 3)
    diagonal[2] = 0.0
    with pytest.raises(GeometryError, match="do not determine"):
        factorise(diagonal, off_diagonal)
