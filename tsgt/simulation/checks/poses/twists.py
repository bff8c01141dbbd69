"""Velocities and angular velocities of poses against the true motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import log_so3
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.simulation.mission import MasterLog, MissionResult

MIN_POSES = 900
"""Minimum number of poses: 45 s. In 36 s with many faults predictions turned by 0.71 of the truth (30987)."""

MIN_RMS = 0.1
"""Minimum rms of the true motion in m/s or rad/s."""

MAX_ERROR_SHARE, MAX_PREDICTED_ERROR_SHARE = 0.4, 0.9
"""Limits of the squared errors over the squares of the truth. Missions have up to 0.2, predictions up to 0.5, which do not know of a
manoeuvre yet; a wrong sign gives 4, wrong axes give 1 or more.
"""

SPOILT_SHARE = 0.05
"""Share of the interpolated poses, those with the largest errors, that :data:`MAX_ERROR_SHARE` leaves out: noise of single measurements,
in rain or shimmer, goes into them undiminished.
"""

MAX_GAIN_ERROR, MAX_ROUGH_GAIN_ERROR = 0.15, 0.25
"""Limits of the error of the gain: estimate over truth, by least squares; the second for predicted and interpolated poses. Missions have 0.96
to 1.02, predictions down to 0.93, interpolation down to 0.84 over ``classic``: the robot accelerates between the instants of its prisms.
"""

MAX_AXES_RATIO = 1.1
"""Limit of the squared errors along the robot's axes over those along the axes of the frame. Missions have up to 0.92; not for
predictions, whose errors are large along either, up to 1.06.
"""

_STEP_S = 0.01


def twist_failures(master_log: MasterLog, result: MissionResult) -> Iterator[str]:
    """Yield the series whose velocities, along the axes of the frame, or angular velocities, along those of the robot, are wrong.

    Fewer than three stations do not tell all of them.
    """
    if len(result.parameters.prisms) < MIN_PRISMS:
        return
    valid = master_log.valid_poses()
    for series in np.unique(valid.series).tolist():
        poses = valid.select(valid.series == series)
        if len(poses.stamp_ns) < MIN_POSES:
            continue
        at_s = (poses.stamp_ns - master_log.unix_at_zero_ns) / 1e9
        upright = np.ones(len(at_s), dtype=np.bool_)
        for each in (
            result.rollovers
        ):  # faster than anything that a robot does on purpose, and over as soon as it is seen
            upright &= (at_s < each.at_s) | (at_s > each.until_s)
        poses, at_s = poses.select(upright), at_s[upright]
        before, after = result.true_poses(at_s - _STEP_S), result.true_poses(at_s + _STEP_S)
        velocity_mps = (after[:, :3, 3] - before[:, :3, 3]) / (2 * _STEP_S)
        turned_rad = log_so3(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
        for name, stated, true in (
            ("velocity", poses.velocity_mps, velocity_mps),
            ("angular velocity", poses.angular_velocity_radps, turned_rad / (2 * _STEP_S)),
        ):
            if name == "angular velocity" and series != "predicted":
                yield from _axes_failures(len(at_s), series, stated, true, before[:, :3, :3])
            yield from _failures(f"{len(at_s)} {series} poses: {name}", series, stated, true)


def _axes_failures(
    count: int,
    series: str,
    stated: NDArray[np.float64],
    true: NDArray[np.float64],
    rotation: NDArray[np.float64],
) -> Iterator[str]:
    """Yield angular velocities that agree better with the truth along the axes of the frame than along those of the robot."""
    along_frame = np.einsum("nij,nj->ni", rotation, true)
    of_robot, of_frame = np.sum((stated - true) ** 2), np.sum((stated - along_frame) ** 2)
    if of_robot > MAX_AXES_RATIO * of_frame:
        yield (
            f"{count} {series} poses: the squared errors of the angular velocity are {of_robot / of_frame:.2f} times those "
            "along the axes of the frame"
        )


def _failures(
    where: str, series: str, stated: NDArray[np.float64], true: NDArray[np.float64]
) -> Iterator[str]:
    squares = float(np.sum(true**2))
    if squares < len(true) * MIN_RMS**2:
        return
    errors = np.sort(np.sum((stated - true) ** 2, axis=1))
    if series == "interpolated":
        errors = errors[: round((1 - SPOILT_SHARE) * len(errors))]
    share = float(np.sum(errors)) / squares
    gain = float(np.sum(stated * true)) / squares
    max_share = MAX_PREDICTED_ERROR_SHARE if series == "predicted" else MAX_ERROR_SHARE
    max_gain_error = MAX_ROUGH_GAIN_ERROR if series in {"predicted", "interpolated"} else MAX_GAIN_ERROR
    if not share <= max_share:
        yield f"{where}: squared errors are {share:.2f} of the truth's squares, limit {max_share:g}"
    elif abs(gain - 1) > max_gain_error:
        yield f"{where}: {gain:.3f} of the truth, limit {max_gain_error:g} from 1"
