"""Expected second moments of the process residuals, given all measurements. Sans-I/O.

They compare the motion prior with the motion: by Fisher's identity its hyperparameters, and step by step the process noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory.states import linearise_process

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution

ProcessMoments = tuple["FloatArray", "FloatArray", "FloatArray"]


def expected_moments(
    solution: Solution, covariance: FloatArray, cross_covariance: FloatArray
) -> ProcessMoments:
    """(K - 1, 6, 3, 3) second moments by process factor and axis: of the later state, later with earlier, of the earlier."""
    linearised = linearise_process(solution.knots, solution.process)
    count = len(cross_covariance)
    earlier, later = linearised.earlier, linearised.later
    moments = later[..., :, None] * later[..., None, :]
    cross = later[..., :, None] * earlier[..., None, :]
    earlier_earlier = earlier[..., :, None] * earlier[..., None, :]
    # The residual is later - Phi earlier; position and rotation are relative to the earlier knot.
    by_earlier, by_later = np.zeros((2, count, 9, 9)), np.zeros((2, count, 9, 9))
    by_earlier[0, :, range(3), range(3)] = -1.0
    by_earlier[1, :, :3, :6] = linearised.rotation_by_earlier
    by_later[:, :, range(9), range(9)] = 1.0
    by_later[1, :, :3, :6] = linearised.rotation_by_later
    for kind, axes in ((0, slice(0, 3)), (1, slice(3, 6))):
        first, last, coupling = (
            matrix.reshape(count, 3, 2, 3, 3, 2, 3)[:, :, kind, :, :, kind].reshape(count, 9, 9)
            for matrix in (covariance[:-1], covariance[1:], cross_covariance)
        )
        cov_with_earlier = by_earlier[kind] @ first + by_later[kind] @ np.swapaxes(coupling, 1, 2)
        cov_with_later = by_earlier[kind] @ coupling + by_later[kind] @ last
        both = cov_with_earlier @ np.swapaxes(by_earlier[kind], 1, 2) + cov_with_later @ np.swapaxes(
            by_later[kind], 1, 2
        )
        moments[:, axes] += _axis_blocks(both)
        cross[:, axes] += _axis_blocks(cov_with_earlier)
        earlier_earlier[:, axes] += _axis_blocks(first)
    cross[..., :, 0] = 0.0
    earlier_earlier[..., :, 0] = earlier_earlier[..., 0, :] = 0.0
    return moments, cross, earlier_earlier


def _axis_blocks(matrix: FloatArray) -> FloatArray:
    """(N, 3, 3, 3) diagonal axis blocks of (N, 9, 9)."""
    blocks: FloatArray = np.einsum("niaja->naij", matrix.reshape(-1, 3, 3, 3, 3))
    return blocks


def expected_squared_distances(
    process_moments: ProcessMoments, phi: FloatArray, information: FloatArray
) -> FloatArray:
    """(K - 1, A) expected squared Mahalanobis distances of the process residuals of A axes."""
    moments, cross, earlier = process_moments
    coupling = phi @ np.swapaxes(cross, -1, -2)
    residual = moments - coupling - np.swapaxes(coupling, -1, -2) + phi @ earlier @ np.swapaxes(phi, -1, -2)
    expected: FloatArray = (information * residual).sum(axis=(2, 3))
    return expected
