"""Symmetric positive definite systems of equal blocks, of which only neighbours are coupled. Pure.

The normal equations of a trajectory have this form. LAPACK's banded Cholesky factorises them in a time that grows with
their length; marginal covariances come out of the factor without forming the inverse (K. Takahashi, "Formation of
sparse bus impedance matrix", 1973, for this form).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs, dtrtri

from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray

_BLOCKS_AT_ONCE = 64
"""What is made of so many blocks before they are done with stays in the nearest cache: twice as fast as all at once."""


@dataclass(frozen=True, slots=True)
class BlockCholesky:
    """The Cholesky factor of a block tridiagonal matrix.

    Attributes
    ----------
    banded
        (2 B, K B): the lower factor by its diagonals, as LAPACK keeps it.
    size
        B, the order of one block.
    """

    banded: FloatArray
    size: int

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve for one right hand side, shape (K, B), or several, shape (K, B, N); the result has the same shape."""
        solution, _ = dpbtrs(self.banded, right.reshape(self.banded.shape[1], -1), lower=True)
        return np.asarray(solution).reshape(right.shape)

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the matrix."""
        return 2.0 * float(np.log(self.banded[0]).sum())

    def last(self) -> FloatArray:
        """(B, B) lower triangle L: ``L L^T`` is the information of the last block when the others are eliminated."""
        size = self.size
        by_block = self.banded[:, -size:]
        lower = np.zeros((size, size))
        for column in range(size):
            lower[column:, column] = by_block[: size - column, column]
        return lower

    def marginals(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the inverse without the rest of it.

        Returns
        -------
        diagonal : FloatArray
            (K, B, B) blocks on the diagonal.
        beside : FloatArray
            (K - 1, B, B) blocks right of it: row of one, column of the next.
        """
        size, count = self.size, self.banded.shape[1] // self.size
        by_block = self.banded.T.reshape(count, size, 2 * size)
        diagonal, off_diagonal = np.empty((count, size, size)), np.empty((count - 1, size, size))
        later: FloatArray | None = None
        for start in range((count - 1) // _BLOCKS_AT_ONCE * _BLOCKS_AT_ONCE, -1, -_BLOCKS_AT_ONCE):
            inverse, below = _inverse_and_below(by_block[start : start + _BLOCKS_AT_ONCE])
            own, gain = np.swapaxes(inverse, 1, 2) @ inverse, np.swapaxes(-below @ inverse, 1, 2)
            for k in range(len(own) - 1, -1, -1):
                if later is not None:
                    shared = np.dot(gain[k], later, out=off_diagonal[start + k])
                    own[k] += np.dot(shared, gain[k].T)
                later = own[k]
            diagonal[start : start + len(own)] = 0.5 * (own + np.swapaxes(own, 1, 2))
        return diagonal, off_diagonal


def _inverse_and_below(by_block: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverses of the factor's triangles on the diagonal, and its blocks below them, of some columns; (N, B, B) each."""
    count, size, _ = by_block.shape
    inverse, below = np.zeros((count, size, size)), np.empty((count, size, size))
    for column in range(size):
        inverse[:, column:, column] = by_block[:, column, : size - column]
        below[:, :, column] = by_block[:, column, size - column : 2 * size - column]
    for block in inverse:
        # Transposed it is as LAPACK keeps it, so that it works in place.
        dtrtri(block.T, lower=False, overwrite_c=True)
    return inverse, below


def factorise(diagonal: FloatArray, off_diagonal: FloatArray) -> BlockCholesky:
    """Factorise.

    Parameters
    ----------
    diagonal
        (K, B, B) symmetric blocks on the diagonal; only their lower triangles are looked at.
    beside
        (K - 1, B, B) blocks right of the diagonal: row of one, column of the next.

    Raises
    ------
    GeometryError
        The matrix is not positive definite: something is not determined.
    """
    count, size, _ = diagonal.shape
    # Column by column, as LAPACK goes through it.
    by_column = np.zeros((count, size, 2 * size))
    for column in range(size):
        by_column[:, column, : size - column] = diagonal[:, column:, column]
        by_column[:-1, column, size - column : 2 * size - column] = off_diagonal[:, column]
    # LAPACK itself, without what scipy asks about it first: live, there are a dozen systems a second.
    factor, failed = dpbtrf(by_column.reshape(count * size, 2 * size).T, lower=True, overwrite_ab=True)
    if failed:
        raise GeometryError("the measurements do not determine the trajectory")
    return BlockCholesky(factor, size)
