"""Covariances that are too large: normalised squared errors far below their expectation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import centroid_at_point
from tsgt.geometry import log_so3, rotate, rotation_from_quaternion, skew
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.simulation.mission import MasterLog, MissionResult

MIN_POSES = 600
"""Minimum number of poses: half a minute."""

MIN_SQUARE = 0.9
"""Limit of the mean squared error in sigmas of position or rotation, three degrees of freedom. 3 if the covariance is exact, 1.8 to
2.7 in missions: the noise of the times is stated conservatively, and the motion prior allows for more than robots do.
"""

MIN_PREDICTED_SQUARE = 0.6
"""The same of predicted poses of a moving robot, 1.1 to 2.2 in missions; at rest they must allow for a start."""

MIN_INTERPOLATED_SQUARE = 0.4
"""The same of interpolated poses of a moving robot, down to 0.6 in missions over ``classic``: their covariance grows where residuals
contradict it, and allows for an acceleration at rest, too.
"""

SIGMAS = 2.0
"""Standard errors of the mean that are added to it."""

BLOCK_S = 2.0
"""Errors of poses farther apart than this are taken as independent: those of smoothed poses are correlated over half a second."""

MIN_SPEED_MPS = 0.2

_STEP_S = 0.01

_LIMITS = {
    "predicted": MIN_PREDICTED_SQUARE,
    "interpolated": MIN_INTERPOLATED_SQUARE,
}  # while the robot moves


def scale_failures(master_log: MasterLog, result: MissionResult) -> Iterator[str]:
    """Yield the series of a master whose covariances are too large.

    Fewer than three stations rest on the IMU, whose errors within one mission are hardly random. While its set-up is not
    confirmed, covariances allow for errors that it need not have.
    """
    if len(result.parameters.prisms) < MIN_PRISMS:
        return
    valid = master_log.valid_poses()
    for series in np.unique(valid.series).tolist():
        poses = valid.select((valid.series == series) & ~valid.unconfirmed)
        at_s = (poses.stamp_ns - master_log.unix_at_zero_ns) / 1e9
        truth = result.true_poses(at_s)
        limit = _LIMITS.get(series, MIN_SQUARE)
        if series in _LIMITS:
            moved_m = result.true_poses(at_s + _STEP_S)[:, :3, 3] - truth[:, :3, 3]
            moving = np.linalg.norm(moved_m, axis=1) > MIN_SPEED_MPS * _STEP_S
            poses, at_s, truth = poses.select(moving), at_s[moving], truth[moving]
        if len(at_s) < MIN_POSES:
            continue
        rotation = rotation_from_quaternion(poses.orientation_xyzw)
        errors = {
            "position": (poses.position_m - truth[:, :3, 3], poses.covariance[:, :3, :3]),
            "rotation": (
                log_so3(rotation @ np.swapaxes(truth[:, :3, :3], 1, 2)),
                poses.covariance[:, 3:, 3:],
            ),
        }
        # The prisms' centroid is known better than the reference point: only with the right blocks, about the right axes, do
        # position and rotation errors cancel there.
        arm_m = rotate(rotation, centroid_at_point(result.parameters))
        errors["centroid"] = _at_arm(errors["position"][0], errors["rotation"][0], arm_m, poses.covariance)
        for name, (error, covariance) in errors.items():
            squares = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
            mean, sigma = mean_of_correlated(at_s, squares)
            if mean + SIGMAS * sigma < limit:
                yield (
                    f"{len(at_s)} {series} poses: the mean squared error of the {name} in sigmas is {mean:.2f}, standard error "
                    f"{sigma:.2f}, minimum {limit:g} of 3: its covariance is too large"
                )


def _at_arm(
    position: NDArray[np.float64],
    rotation: NDArray[np.float64],
    arm_m: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return errors, (N, 3), and covariance, (N, 3, 3), of the position at the end of lever arms."""
    to_arm = np.concatenate([np.broadcast_to(np.eye(3), (len(arm_m), 3, 3)), -skew(arm_m)], axis=2)
    return position + np.cross(rotation, arm_m), to_arm @ covariance @ to_arm.swapaxes(1, 2)


def mean_of_correlated(at_s: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the mean of values at instants, and its standard error by the scatter of blocks."""
    blocks = np.unique((at_s / BLOCK_S).astype(np.int64), return_inverse=True)[1]
    mean = values.mean()
    deviations = np.bincount(blocks, values - mean)
    return float(mean), float(np.sqrt(np.sum(deviations**2)) / len(values))
