"""Block-tridiagonal systems with a border: states in the order of time, and a few unknowns that all of them share. Sans-I/O.

The states are eliminated by their banded factor (Schur complement); the shared unknowns are few, so that the border costs no
more than further right-hand sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.trajectory.block_tridiagonal import BlockCholesky, factorise

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray


@dataclass(frozen=True, slots=True)
class BorderedCholesky:
    """Factor of ``[[A, X], [X^T, C]]``, with A block-tridiagonal."""

    states: BlockCholesky  # of A
    border: FloatArray  # (K, B, S) X
    solved_border: FloatArray  # (K, B, S) ``A^-1 X``
    shared_covariance: FloatArray  # (S, S) inverse of ``C - X^T A^-1 X``: covariance of the shared unknowns

    def solve(self, right: FloatArray, shared_right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve for the states, (K, B), and for the shared unknowns, (S,); or for N right-hand sides, along a last axis."""
        alone = self.states.solve(right)
        shared = self.shared_covariance @ (shared_right - np.tensordot(self.border, alone, ((0, 1), (0, 1))))
        return alone - self.solved_border @ shared, shared

    def marginals(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of the states, (K, B, B), and of each with the next one, (K - 1, B, B)."""
        diagonal, off_diagonal = self.states.marginals()
        spread = self.solved_border @ self.shared_covariance
        diagonal += spread @ self.solved_border.swapaxes(1, 2)
        off_diagonal += spread[:-1] @ self.solved_border[1:].swapaxes(1, 2)
        return diagonal, off_diagonal

    def last_covariance(self) -> FloatArray:
        """(B + S, B + S) covariance of the last state and the shared unknowns."""
        covariance = np.linalg.inv(self.last_information())
        symmetric: FloatArray = 0.5 * (covariance + covariance.T)
        return symmetric

    def last_information(self) -> FloatArray:
        """(B + S, B + S) information on the last state and the shared unknowns, all other states eliminated."""
        size = self.states.size
        root, solved = self.states.last_block(), self.solved_border[-1]
        root_solved = root.T @ solved
        information = np.empty((size + solved.shape[1],) * 2)
        information[:size, :size] = root @ root.T
        information[:size, size:] = root @ root_solved
        information[size:, :size] = information[:size, size:].T
        information[size:, size:] = np.linalg.inv(self.shared_covariance) + root_solved.T @ root_solved
        return information


def factorise_bordered(
    diagonal: FloatArray, off_diagonal: FloatArray, border: FloatArray, corner: FloatArray
) -> BorderedCholesky:
    """Factorise; blocks as for :func:`~tsgt.geometry.trajectory.block_tridiagonal.factorise`, which says what is raised."""
    states = factorise(diagonal, off_diagonal)
    solved = states.solve(border)
    schur = corner - np.einsum("kbs,kbt->st", border, solved)
    schur = 0.5 * (schur + schur.T)
    try:
        np.linalg.cholesky(schur)
    except np.linalg.LinAlgError as error:
        raise GeometryError("the measurements do not determine what all states share") from error
    return BorderedCholesky(states, border, solved, np.linalg.inv(schur))
