"""Cholesky factorisation of symmetric positive definite block-tridiagonal systems. Sans-I/O.

The normal equations of a trajectory have this form (Barfoot, "State Estimation for Robotics", section 3.2). LAPACK's banded
Cholesky factorises them in linear time; marginal covariances follow from the factor without forming the inverse
(K. Takahashi, "Formation of sparse bus impedance matrix", 1973, for this form).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs, dtbtrs, dtrtri

from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray

_BLOCKS_PER_CHUNK = 64  # Chunk that stays in the L1 cache: twice as fast as all blocks in one pass


@dataclass(frozen=True, slots=True)
class BlockCholesky:
    """Cholesky factor of a block-tridiagonal matrix."""

    banded: FloatArray  # (2 B, K B) the lower factor by its diagonals, LAPACK's band storage
    size: int  # B, the order of one block

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve for one right-hand side, (K, B), or several, (K, B, N); the result has the same shape."""
        solution, _ = dpbtrs(self.banded, right.reshape(self.banded.shape[1], -1), lower=True)
        return np.asarray(solution).reshape(right.shape)

    def quadratic_form(self, right: FloatArray) -> FloatArray:
        """(N, N) product of N right-hand sides, (K, B, N), transposed, with their solutions: half the work of solving for them."""
        forward, _ = dtbtrs(self.banded, right.reshape(self.banded.shape[1], -1), uplo="L")
        return np.asarray(forward.T @ forward)

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the matrix."""
        return 2.0 * float(np.log(self.banded[0]).sum())

    def last_block(self) -> FloatArray:
        """(B, B) lower triangle L: ``L L^T`` is the Schur complement of the last block, all others eliminated."""
        rows, columns = _lower_triangle(self.size)
        lower = np.zeros((self.size, self.size))
        lower[rows, columns] = self.banded[rows - columns, columns - self.size]
        return lower

    def with_last_block_added(self, block: FloatArray) -> BlockCholesky:
        """Return the factor of the matrix with (B, B) ``block``, positive semidefinite, added to its last diagonal block.

        Nothing before that block changes. Raises GeometryError as :func:`factorise`.
        """
        rows, columns = _lower_triangle(self.size)
        last = self.last_block()
        try:
            lower = np.linalg.cholesky(last @ last.T + block)
        except np.linalg.LinAlgError:
            raise GeometryError("the measurements do not determine the trajectory") from None
        banded = self.banded.copy(order="F")
        banded[rows - columns, columns - self.size] = lower[rows, columns]
        return BlockCholesky(banded, self.size)

    def marginals(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the inverse matrix: (K, B, B) on the diagonal and (K - 1, B, B) right of it."""
        size, count = self.size, self.banded.shape[1] // self.size
        columns = self.banded.T.reshape(count, size, 2 * size)
        diagonal, off_diagonal = np.empty((count, size, size)), np.empty((count - 1, size, size))
        next_block, added = np.zeros((size, size)), np.empty((size, size))
        for start in range((count - 1) // _BLOCKS_PER_CHUNK * _BLOCKS_PER_CHUNK, -1, -_BLOCKS_PER_CHUNK):
            chunk = slice(start, start + _BLOCKS_PER_CHUNK)
            inverse, sub_diagonal = _inverse_and_sub_diagonal(columns[chunk])
            own, gain_transposed = inverse.swapaxes(1, 2) @ inverse, -sub_diagonal @ inverse
            gain = gain_transposed.swapaxes(1, 2)
            cross = np.empty_like(own)
            # Lists of views: to index the arrays in the loop takes as long as the products.
            blocks = zip(*(list(each)[::-1] for each in (gain, gain_transposed, own, cross)), strict=True)
            for block_gain, block_gain_transposed, block, block_cross in blocks:
                np.dot(block_gain, next_block, block_cross)
                np.dot(block_cross, block_gain_transposed, added)
                np.add(block, added, block)
                next_block = block
            off_diagonal[chunk] = cross[: len(off_diagonal[chunk])]
            diagonal[chunk] = 0.5 * (own + own.swapaxes(1, 2))
        return diagonal, off_diagonal


@cache
def _lower_triangle(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the lower triangle of a block."""
    return np.tril_indices(size)


def _inverse_and_sub_diagonal(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverses of the factor's diagonal triangles, and its sub-diagonal blocks, of N block columns; (N, B, B) each."""
    count, size, _ = columns.shape
    inverse, sub_diagonal = np.zeros((count, size, size)), np.empty((count, size, size))
    for column in range(size):
        inverse[:, column:, column] = columns[:, column, : size - column]
        sub_diagonal[:, :, column] = columns[:, column, size - column : 2 * size - column]
    for block in inverse:
        # The transpose has Fortran order: inverted in place.
        dtrtri(block.T, lower=False, overwrite_c=True)
    return inverse, sub_diagonal


def factorise(diagonal: FloatArray, off_diagonal: FloatArray) -> BlockCholesky:
    """Factorise a block-tridiagonal matrix. Raises GeometryError: it is not positive definite.

    ``diagonal``, (K, B, B): symmetric, only the lower triangles are read; ``off_diagonal``, (K - 1, B, B): row block k,
    column block k + 1.
    """
    count, size, _ = diagonal.shape
    # LAPACK's band storage is column by column, each from the diagonal down: a column of both blocks, one below the other, and
    # zeros, from its own number on.
    columns = np.empty((count, size, 2 * size))
    full = np.zeros((min(count, _BLOCKS_PER_CHUNK), size, 3 * size))
    of_block, of_column, of_row = full.strides
    from_diagonal = np.lib.stride_tricks.as_strided(
        full, (len(full), size, 2 * size), (of_block, of_column + of_row, of_row), writeable=False
    )
    for start in range(0, count, _BLOCKS_PER_CHUNK):
        blocks, below = (each[start : start + _BLOCKS_PER_CHUNK] for each in (diagonal, off_diagonal))
        full[: len(blocks), :, :size] = blocks.swapaxes(1, 2)
        full[: len(below), :, size : 2 * size] = below
        full[len(below) :, :, size : 2 * size] = 0.0
        columns[start : start + len(blocks)] = from_diagonal[: len(blocks)]
    # LAPACK directly: scipy's checks cost more than a system of the fixed lag, of which there are a dozen a second.
    factor, failed = dpbtrf(columns.reshape(count * size, 2 * size).T, lower=True, overwrite_ab=True)
    if failed:
        raise GeometryError("the measurements do not determine the trajectory")
    return BlockCholesky(factor, size)
