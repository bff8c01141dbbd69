"""Symmetric positive definite systems of equal blocks, of which only neighbours are coupled. Pure.

The normal equations of a trajectory have this form. LAPACK's banded Cholesky factorises them in a time that grows with
their length; marginal covariances come out of the factor without forming the inverse (K. Takahashi, "Formation of
sparse bus impedance matrix", 1973, for this form).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray


@dataclass(frozen=True, slots=True)
class BlockFactor:
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
        flat = right.reshape(self.banded.shape[1], -1)
        solution: FloatArray = cho_solve_banded((self.banded, True), flat, check_finite=False)
        return solution.reshape(right.shape)

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
        lower, below = self._blocks()
        count = len(lower)
        inverse = np.linalg.inv(lower)
        own = np.swapaxes(inverse, 1, 2) @ inverse
        gain = -np.swapaxes(below @ inverse[:-1], 1, 2)
        diagonal, beside = np.empty_like(lower), np.empty_like(below)
        diagonal[-1] = own[-1]
        for k in range(count - 2, -1, -1):
            beside[k] = gain[k] @ diagonal[k + 1]
            diagonal[k] = own[k] + beside[k] @ gain[k].T
        return 0.5 * (diagonal + np.swapaxes(diagonal, 1, 2)), beside

    def _blocks(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the factor: (K, B, B) lower triangles on the diagonal, (K - 1, B, B) below it."""
        size, count = self.size, self.banded.shape[1] // self.size
        by_block = self.banded.T.reshape(count, size, 2 * size)
        lower, below = np.zeros((count, size, size)), np.zeros((max(count - 1, 0), size, size))
        for column in range(size):
            lower[:, column:, column] = by_block[:, column, : size - column]
            below[:, :, column] = by_block[:-1, column, size - column : 2 * size - column]
        return lower, below


def factorise(diagonal: FloatArray, beside: FloatArray) -> BlockFactor:
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
        by_column[:-1, column, size - column : 2 * size - column] = beside[:, column]
    try:
        factor = cholesky_banded(
            by_column.reshape(count * size, 2 * size).T, overwrite_ab=True, lower=True, check_finite=False
        )
    except LinAlgError as error:
        raise GeometryError("the measurements do not determine the trajectory") from error
    return BlockFactor(factor, size)
