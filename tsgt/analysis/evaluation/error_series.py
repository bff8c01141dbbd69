"""Errors of poses against a reference over time, in six components with the stated sigmas of each. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.evaluation.ate_rpe import absolute_errors, relative_error_table
from tsgt.analysis.evaluation.reference import match_poses, transforms_of
from tsgt.geometry import euler_angles_rad, euler_covariance, rotation_from_quaternion

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.evaluation.ate_rpe import RelativeErrors, TransformErrors
    from tsgt.analysis.evaluation.reference import Reference
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray

COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True, slots=True)
class PoseComponents:
    """Six components at N epochs: x, y, z of the poses' point in frame ``station1`` (m); roll, pitch, yaw (rad).

    ``value``, (N, 6), are the poses or their errors; ``sigma``, (N, 6), what the poses state about them, of which
    ``sigma_common``, (N, 6), is the part that all poses share. NaN where unknown.
    """

    stamp_ns: NDArray[np.int64]
    value: FloatArray
    sigma: FloatArray
    sigma_common: FloatArray

    @property
    def within_two_sigma(self) -> FloatArray:
        """Share of the known values within two sigmas of zero, (6,): 0.954 of normal errors. NaN without any."""
        known = np.isfinite(self.value) & np.isfinite(self.sigma)
        inside = known & (np.abs(self.value) <= 2 * self.sigma)
        return np.where(known.any(axis=0), inside.sum(axis=0) / np.maximum(known.sum(axis=0), 1), np.nan)

    @property
    def rms(self) -> FloatArray:
        """Root mean square of the known values, (6,); NaN without any."""
        known = np.isfinite(self.value)
        squares = np.where(known, self.value, 0.0) ** 2
        return np.where(
            known.any(axis=0), np.sqrt(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1)), np.nan
        )


def pose_components(poses: PoseBatch) -> PoseComponents:
    """Return the components of all poses and their stated sigmas; NaN where a pose is not valid."""
    valid = poses.valid[:, None]
    R = rotation_from_quaternion(np.where(valid, poses.orientation_xyzw, [0.0, 0.0, 0.0, 1.0]))
    value = np.concatenate([poses.position_m, euler_angles_rad(R)], axis=1)
    columns = (value, component_sigmas(R, poses.covariance), component_sigmas(R, poses.covariance_common))
    return PoseComponents(poses.stamp_ns, *(np.where(valid, column, np.nan) for column in columns))


def error_components(poses: PoseBatch, reference: Reference) -> PoseComponents:
    """Return the unaligned errors, estimated minus true, of the valid poses that have a reference, at the poses' own point."""
    rows, true = match_poses(poses, reference)
    R = rotation_from_quaternion(poses.orientation_xyzw[rows])
    angles = euler_angles_rad(R) - euler_angles_rad(true[:, :3, :3])
    turn = (angles + np.pi) % (2 * np.pi) - np.pi
    value = np.concatenate([poses.position_m[rows] - true[:, :3, 3], turn], axis=1)
    sigmas = (component_sigmas(R, each[rows]) for each in (poses.covariance, poses.covariance_common))
    return PoseComponents(poses.stamp_ns[rows], value, *sigmas)


def component_sigmas(R: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the sigmas of the six components, (N, 6), of poses with rotations R, (N, 3, 3), and covariances (N, 6, 6)."""
    rotation = euler_covariance(R, covariance[:, 3:, 3:])
    variances = [np.einsum("nii->ni", block) for block in (covariance[:, :3, :3], rotation)]
    # A variance that should be 0 may be less by rounding.
    return np.asarray(np.sqrt(np.maximum(np.concatenate(variances, axis=1), 0.0)))


@dataclass(frozen=True, slots=True)
class PoseErrorDetails:
    """Unaligned errors of poses against a reference, at the poses' own point: over time, absolute (ATE) and relative (RPE)."""

    components: PoseComponents
    ate: TransformErrors
    rpe: tuple[RelativeErrors, ...]

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        c = self.components
        return {
            "components": {
                name: {"rms": rms, "within_2_sigma": share}
                for name, rms, share in zip(
                    ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg"),
                    (np.array([1e3] * 3 + [180 / np.pi] * 3) * c.rms).tolist(),
                    c.within_two_sigma.tolist(),
                    strict=True,
                )
            },
            "ate": self.ate.keys(),
            "rpe": [each.keys() for each in self.rpe],
        }


def error_details(poses: PoseBatch, reference: Reference) -> PoseErrorDetails:
    """Compare the valid poses that have a reference with it."""
    rows, true = match_poses(poses, reference)
    estimated = transforms_of(poses, rows)
    return PoseErrorDetails(
        error_components(poses, reference),
        absolute_errors(estimated, true),
        relative_error_table(estimated, true, poses.stamp_ns[rows]),
    )
