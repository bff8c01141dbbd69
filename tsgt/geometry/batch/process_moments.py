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
    from tsgt.geometry.trajectory.states import ProcessFactors, States

_STEPS_PER_CHUNK = 256  # Stay in the L2 cache: twice as fast

ProcessMoments = tuple["FloatArray", "FloatArray", "FloatArray"]


def expected_moments(
    solution: Solution, covariance: FloatArray, cross_covariance: FloatArray
) -> ProcessMoments:
    """(K - 1, 6, 3, 3) second moments by process factor and axis: of the later state, later with earlier, of the earlier.

    The later state is relative to the earlier knot, of which only velocity and acceleration count: the residual is
    ``later - Phi earlier``.
    """
    chunks = [
        _expected_moments(
            solution.knots.select(slice(start, start + _STEPS_PER_CHUNK + 1)),
            solution.process.select(slice(start, start + _STEPS_PER_CHUNK)),
            covariance[start : start + _STEPS_PER_CHUNK + 1],
            cross_covariance[start : start + _STEPS_PER_CHUNK],
        )
        for start in range(0, len(cross_covariance), _STEPS_PER_CHUNK)
    ]
    moments, cross, earlier = (np.concatenate(each) for each in zip(*chunks, strict=True))
    return moments, cross, earlier


def _expected_moments(
    knots: States, process: ProcessFactors, covariance: FloatArray, cross_covariance: FloatArray
) -> ProcessMoments:
    linearised = linearise_process(knots, process)
    count = len(cross_covariance)
    earlier, later = linearised.earlier, linearised.later
    moments = later[..., :, None] * later[..., None, :]
    cross = later[..., :, None] * earlier[..., None, :]
    earlier_earlier = earlier[..., :, None] * earlier[..., None, :]
    blocks = [
        matrix.reshape(count, 3, 2, 3, 3, 2, 3)
        for matrix in (covariance[:-1], covariance[1:], cross_covariance)
    ]
    for kind, axes in ((0, slice(0, 3)), (1, slice(3, 6))):
        first, last, both = (_axis_blocks(matrix[:, :, kind, :, :, kind]) for matrix in blocks)
        moments[:, axes] += last
        cross[:, axes] += np.swapaxes(both, 2, 3)
        earlier_earlier[:, axes] += first
        if kind == 0:
            # The position relative to the earlier one.
            moments[:, axes, 0] -= both[:, :, 0]
            moments[:, axes, :, 0] -= both[:, :, 0]
            moments[:, axes, 0, 0] += first[:, :, 0, 0]
            cross[:, axes, 0] -= first[:, :, 0]
    # The rotation vector from the earlier rotation depends on both rotations and angular velocities; 9 errors of each knot.
    first, last, both = (matrix[:, :, 1, :, :, 1].reshape(count, 9, 9) for matrix in blocks)
    by_earlier, by_later = linearised.rotation_by_earlier, linearised.rotation_by_later
    with_earlier = by_earlier @ first[:, :6] + by_later @ np.swapaxes(both[:, :, :6], 1, 2)
    with_later = by_earlier @ both[:, :6] + by_later @ last[:, :6]
    variance = (with_earlier[:, :, :6] * by_earlier + with_later[:, :, :6] * by_later).sum(axis=2)
    by_axis_earlier, by_axis_later = (
        np.einsum("naja->naj", each.reshape(count, 3, 3, 3)) for each in (with_earlier, with_later)
    )
    rotation = later[:, 3:, 0]
    moments[:, 3:, 0, 0] = rotation**2 + variance
    for component in (1, 2):
        moments[:, 3:, 0, component] = rotation * later[:, 3:, component] + by_axis_later[:, :, component]
        moments[:, 3:, component, 0] = moments[:, 3:, 0, component]
        cross[:, 3:, 0, component] = rotation * earlier[:, 3:, component] + by_axis_earlier[:, :, component]
    cross[..., :, 0] = 0.0
    earlier_earlier[..., :, 0] = earlier_earlier[..., 0, :] = 0.0
    return moments, cross, earlier_earlier


def _axis_blocks(matrix: FloatArray) -> FloatArray:
    """(N, 3, 3, 3) view of (N, 3, 3, 3, 3), component and axis of rows and columns: the blocks of one axis with itself."""
    blocks: FloatArray = np.einsum("niaja->naij", matrix)
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
