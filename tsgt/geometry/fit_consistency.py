"""Whether prisms fit their layout as well as their covariances say.

A rigid fit of P prisms has 3 P - 6 degrees of freedom left: what remains of the distances between prisms. With three prisms the
residuals tell an error of a frame, a reflection or a foreign prism only in part, but a covariance that they contradict is too small.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import skew

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray

PRIOR_FREEDOM = 10.0
"""Degrees of freedom that the stated covariances count for beside those of the residuals of one fit."""


def squared_misfit(
    layout: FloatArray,
    rotation: FloatArray,
    translation_m: FloatArray,
    points_m: FloatArray,
    prism_covariances: FloatArray,
    common_errors: FloatArray,
) -> tuple[FloatArray, int]:
    """Return the squared residuals of rigid fits in sigmas, (N,), and their degrees of freedom.

    To first order, whatever the weights of the fit were.

    Parameters
    ----------
    layout : (P, 3) prisms in the robot frame, in m, not collinear.
    rotation, translation_m : (N, 3, 3) and (N, 3), ``T_world_robot``.
    points_m, prism_covariances : (N, P, 3) and (N, P, 3, 3) in the world, in m and m².
    common_errors : (N, P, 3, r) displacements in the world, in m, by errors of one sigma that several prisms share.
    """
    prisms, freedom = len(layout), 3 * len(layout) - 6
    unexplained = _unexplained(layout.tobytes())
    residual = np.zeros((len(rotation), freedom, 1))
    covariance = np.zeros((len(rotation), freedom, freedom))
    common = np.zeros((len(rotation), freedom, common_errors.shape[-1]))
    # Prism by prism: a sum over an axis may group its terms differently for one pose and for many.
    for prism in range(prisms):
        robot_part = unexplained[prism]
        world_part = robot_part @ rotation.swapaxes(1, 2)
        residual += world_part @ (points_m[:, prism] - translation_m)[..., None]
        residual -= (robot_part @ layout[prism])[:, None]
        covariance += world_part @ prism_covariances[:, prism] @ world_part.swapaxes(1, 2)
        common += world_part @ common_errors[:, prism]
    covariance += common @ np.ascontiguousarray(common.swapaxes(1, 2))
    try:
        weighted = np.linalg.solve(covariance, residual)
    except np.linalg.LinAlgError:  # without noise, where it says nothing
        weighted = np.linalg.pinv(covariance, hermitian=True) @ residual
    squared = residual.swapaxes(1, 2) @ weighted
    return squared[:, 0, 0], freedom


def covariance_scale(squared_misfit: FloatArray, freedom: int) -> FloatArray:
    """Return by how much covariances, (N,), must grow to agree with squared residuals in sigmas, (N,); at least 1.

    The inverse of the posterior mean of an unknown factor on the precision, with a gamma prior of mean 1 that counts as
    :data:`PRIOR_FREEDOM` residuals which agree with the covariance: noise alone raises it by 7 % on average, for three prisms.
    """
    return np.maximum(1.0, (PRIOR_FREEDOM + squared_misfit) / (PRIOR_FREEDOM + freedom))


@lru_cache(maxsize=16)
def _unexplained(layout: bytes) -> FloatArray:
    """Return (P, 3 P - 6, 3): orthonormal combinations of displacements of the prisms that no motion of the robot explains."""
    prisms = np.frombuffer(layout).reshape(-1, 3)
    shifts = np.tile(np.eye(3), (len(prisms), 1, 1))
    motions = np.concatenate([shifts, -skew(prisms - prisms.mean(axis=0))], axis=2).reshape(-1, 6)
    basis = np.linalg.svd(motions)[0][:, 6:]
    found = np.ascontiguousarray(basis.reshape(len(prisms), 3, -1).swapaxes(1, 2))
    found.flags.writeable = False
    return found
