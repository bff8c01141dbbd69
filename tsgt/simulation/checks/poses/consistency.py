"""Consistency of valid poses: with the measurements, with the ground truth, and with the stated covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import build_tracks, centroid_at_point, transform_of, usable
from tsgt.geometry import invert, log_so3, rotation_from_quaternion, transform_from, transform_points
from tsgt.model import MIN_PRISMS
from tsgt.simulation.checks.poses.apparent import apparent_poses, misfit_tolerances
from tsgt.simulation.checks.poses.knocks import displaced_covariance, displacements, untold_displacements
from tsgt.simulation.checks.poses.late_stamps import VELOCITY_S, extrapolated_s, late_stamp_tolerances

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from tsgt.estimation import Track
    from tsgt.model import Parameters
    from tsgt.simulation.mission import JournalIndex, MasterLog, MissionResult, ValidPoses

# Above the latency of any station, which is subtracted from the timestamps.
_MAX_LATENCY_NS = 5_000_000_000
_RESIDUAL_TOLERANCE_M = 1e-6
# NEES with six degrees of freedom exceeds 60 with a probability of 5e-11. A motion that is unlikely under the prior may
# exceed it nevertheless, hence the additional tolerance.
_MAX_NEES = 60.0
# In m at the prisms' centroid and rad. Timestamps of an instrument's first seconds, and of the authors' nodes, have errors of milliseconds beyond
# the stated covariance: millimetres for a moving robot.
_STATE_TOLERANCE = 0.02
# Limit of the median NEES over at least this number of poses (half a minute); the expected median is 5.3.
_MIN_POSES = 600
_MAX_MEDIAN_NEES = 12.0
# In m at the prisms' centroid and rad: limit of the median error of all but predicted poses; noise causes a fifth of it.
MAX_MEDIAN_ERROR = 0.005
MISALIGNMENT_SIGMAS = 3.0
UNSEEN_S = 1.0
"""Predictions go on for this long after the last measurement: the outage limit."""
MAX_MISFIT_M = 0.001
"""Poses are not in the medians if moved stations distort the prisms' triangle by more."""


def pose_failures(
    master_log: MasterLog, result: MissionResult, indices: Mapping[int, JournalIndex]
) -> Iterator[str]:
    """Yield the inconsistent valid poses of a master's process, one line each."""
    yield from refit_mismatches(master_log, master_log.parameters or result.parameters)
    yield from nees_outliers(master_log, result, indices)
    yield from distribution_failures(master_log, result, indices)


def refit_mismatches(master_log: MasterLog, parameters: Parameters) -> Iterator[str]:
    """Refit each valid pose of the estimator ``linear`` from usable measurements and compare the residual."""
    poses = master_log.valid_poses()
    poses = poses.select(poses.series == "interpolated")
    tracks = build_tracks(parameters, [m for m in master_log.measurements if usable(m)])
    mismatched = np.flatnonzero(~_matches_refit(poses, slice(None), tracks, parameters))
    stamps_ns = np.array([m.stamp_ns for m in master_log.measurements], dtype=np.int64)
    around_ns = parameters.pipeline.outage_limit_ns + _MAX_LATENCY_NS
    for index in mismatched.tolist():
        # Refit from the measurements before the pose only: later ones may lie between them.
        before = stamps_ns[: poses.measurements_before[index]]
        near = np.flatnonzero(np.abs(before - poses.stamp_ns[index]) <= around_ns).tolist()
        tracks = build_tracks(parameters, [m for i in near if usable(m := master_log.measurements[i])])
        if not _matches_refit(poses, [index], tracks, parameters)[0]:
            yield (
                f"interpolated pose at {poses.stamp_ns[index]} ns: valid, but a refit from usable measurements "
                f"differs by more than {_RESIDUAL_TOLERANCE_M:g} m"
            )


def nees_outliers(
    master_log: MasterLog, result: MissionResult, indices: Mapping[int, JournalIndex]
) -> Iterator[str]:
    """Compare each valid pose of the estimator ``continuous`` with the truth and its covariance (NEES)."""
    poses = master_log.valid_poses()
    poses = poses.select((poses.series != "interpolated") & ~rolls_over_unseen(poses, master_log, result))
    untold = untold_displacements(poses, master_log, result)
    poses = replace(poses, covariance=displaced_covariance(poses.covariance, untold, result.parameters))
    errors, nees, misfits = _errors(poses, master_log, result)
    error_norms = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2)
    at_s = (poses.stamp_ns - master_log.unix_at_zero_ns) / 1e9
    late = late_stamp_tolerances(result, indices.values(), at_s)
    if late.any():
        beyond_s = extrapolated_s(poses, master_log.measurements, at_s, master_log.unix_at_zero_ns)
        late *= (1.0 + np.minimum(beyond_s, UNSEEN_S) / VELOCITY_S)[:, None]
    limits = _STATE_TOLERANCE + untold + misfits + late
    for index in np.flatnonzero((nees > _MAX_NEES) & (error_norms > limits).any(axis=1)).tolist():
        yield (
            f"{poses.series[index]} pose at {poses.stamp_ns[index]} ns: error {error_norms[index, 0]:.4f} m at the prisms' centroid and "
            f"{error_norms[index, 1]:.4f} rad, limits {limits[index, 0]:.3g} and {limits[index, 1]:.3g}; "
            f"NEES {nees[index]:.0f}, limit {_MAX_NEES:g}"
        )


def rolls_over_unseen(poses: ValidPoses, master_log: MasterLog, result: MissionResult) -> NDArray[np.bool_]:
    """Whether each pose predicts, without an IMU, that a robot which begins to roll over drives on, (N,).

    Its angular acceleration is twenty times that of the motion prior or more, and no measurement shows it yet.
    """
    at_s = (poses.stamp_ns - master_log.unix_at_zero_ns) / 1e9
    blind = (poses.series == "predicted") & ~poses.with_imu
    rolling = np.zeros(len(at_s), dtype=np.bool_)
    for each in result.rollovers:
        rolling |= (at_s >= each.at_s) & (at_s < each.at_s + each.roll_s + UNSEEN_S)
    found: NDArray[np.bool_] = blind & rolling
    return found


def distribution_failures(
    master_log: MasterLog, result: MissionResult, indices: Mapping[int, JournalIndex]
) -> Iterator[str]:
    """Compare the medians of error and NEES of each kind of pose with their limits.

    Chance can explain a single pose, but not the median; and a median error over half a minute, with a robot that turns,
    indicates a wrong setup. Skips the authors' nodes, which keep no journals: they timestamp readings on arrival, so their
    poses are late beyond the stated covariance. Skips poses whose IMU was knocked, where prisms do not tell it.
    """
    if any(station_log.folder is None for station_log in result.station_logs.values()):
        return
    every = master_log.valid_poses()
    told = displacements(every, master_log, result)[:, 1] == 0.0
    told &= _errors(every, master_log, result)[2][:, 0] <= MAX_MISFIT_M
    every_s = (every.stamp_ns - master_log.unix_at_zero_ns) / 1e9
    told &= late_stamp_tolerances(result, indices.values(), every_s)[:, 0] == 0.0
    every = every.select(told)
    for series in np.unique(every.series).tolist():
        poses = every.select(every.series == series)
        if len(poses.stamp_ns) < _MIN_POSES:
            continue
        errors, nees, _ = _errors(poses, master_log, result)
        median_nees = np.median(nees)
        median_m, median_rad = np.linalg.norm(np.median(errors, axis=0).reshape(2, 3), axis=1)
        limit_rad = max_median_rotation_rad(result.parameters)
        if series in ("interpolated", "smoothed") and (median_m > MAX_MEDIAN_ERROR or median_rad > limit_rad):
            yield (
                f"{len(nees)} {series} poses: median error {median_m:.4f} m at the prisms' centroid and {median_rad:.4f} rad, "
                f"limits {MAX_MEDIAN_ERROR:g} and {limit_rad:.4g}"
            )
        if median_nees > _MAX_MEDIAN_NEES:
            yield f"{len(nees)} {series} poses: median NEES {median_nees:.1f}, limit {_MAX_MEDIAN_NEES:g}"


def max_median_rotation_rad(parameters: Parameters) -> float:
    """Limit of the median rotation error.

    Accelerations alone tell the heading with a single prism, and the rotation about the line of two, along axes of the accelerometer
    that are not at right angles and stay so: that is no noise, and no median removes it.
    """
    if parameters.imu is None or len(parameters.prisms) >= MIN_PRISMS:
        return MAX_MEDIAN_ERROR
    return MAX_MEDIAN_ERROR + MISALIGNMENT_SIGMAS * parameters.imu.noise.accelerometer_scale_misalignment


def _errors(
    poses: ValidPoses, master_log: MasterLog, result: MissionResult
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return (N, 6) position errors at the prisms' centroid in m and rotation errors in rad, the NEES, (N,), and what moved stations add.

    Limits at the centroid do not depend on the reference point, whose lever arm magnifies rotation errors. Errors are those from
    what the stations show: that a station has moved is no error of the estimator; what it adds, (N, 2), is that of
    :func:`misfit_tolerances`.
    """
    apparent = apparent_poses(result, master_log, (poses.stamp_ns - master_log.unix_at_zero_ns) / 1e9)
    truth = apparent.T_station1_robot @ transform_of(result.parameters.reference_point)
    estimated = transform_from(rotation_from_quaternion(poses.orientation_xyzw), poses.position_m)
    rotation_error = log_so3(estimated[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2))
    errors = np.concatenate([poses.position_m - truth[:, :3, 3], rotation_error], axis=1)
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(poses.covariance, errors[..., None])[..., 0])
    centroid_m = centroid_at_point(result.parameters)
    at_centroid = transform_points(estimated, centroid_m) - transform_points(truth, centroid_m)
    errors = np.concatenate([at_centroid, rotation_error], axis=1)
    return errors, nees, misfit_tolerances(result, apparent)


def _matches_refit(
    poses: ValidPoses,
    rows: slice | list[int],
    tracks: dict[int, Track],
    parameters: Parameters,
) -> NDArray[np.bool_]:
    """Return whether each pose's prisms lie on the interpolated measurements, to the stated residual."""
    stamps = poses.stamp_ns[rows]
    rotation = rotation_from_quaternion(poses.orientation_xyzw[rows])
    T_point_robot = invert(transform_of(parameters.reference_point))
    matches = np.ones(len(stamps), dtype=np.bool_)
    squares = np.zeros(len(stamps))
    for prism in parameters.prisms:
        track = tracks[prism.prism]
        if len(track) == 0:
            return np.zeros(len(stamps), dtype=np.bool_)
        after = np.searchsorted(track.times_ns, stamps).clip(1, max(1, len(track) - 1))
        before = after - 1
        after = np.minimum(after, len(track) - 1)
        from_ns, to_ns = track.times_ns[before], track.times_ns[after]
        matches &= (from_ns <= stamps) & (stamps <= to_ns)
        matches &= to_ns - from_ns <= parameters.pipeline.outage_limit_ns
        fraction = (stamps - from_ns) / np.maximum(to_ns - from_ns, 1)
        recorded_points = track.points_m[before] + fraction[:, None] * (
            track.points_m[after] - track.points_m[before]
        )
        placed = poses.position_m[rows] + rotation @ transform_points(
            T_point_robot, np.array(prism.position_m)
        )
        squares += np.sum((placed - recorded_points) ** 2, axis=1)
    residual_m = np.sqrt(squares / len(parameters.prisms))
    matches &= np.abs(residual_m - poses.residual_m[rows]) <= _RESIDUAL_TOLERANCE_M
    return matches
