"""Joint fit of clock, scale and extrinsic while the frame of the estimate drifts: residuals, Jacobians, Gauss-Newton.

An estimate errs in two ways: each pose for itself (white noise), and by drift, in which each pose continues the errors of all
before it. A fit that takes drift for white noise weighs the wrong poses, and states sigmas that are far too small. So the frame of
the estimate is a trajectory of its own here: at knots about half a second apart it has a pose in ``station1``, and from knot to
knot it walks at random, about where the sensor is then. Rotation that has drifted bends the path from there on, as odometry
composes its steps. What drift cannot imitate, quick changes of velocity and turn rate, determines clock, scale and extrinsic.

Notation at knot k: rotation Q_k, position c_k in ``station1`` of the sensor at the estimate's own e_k; between knots,
``f(e) = (1 - a) (Q_k (e - e_k) + c_k) + a (Q_k+1 (e - e_k+1) + c_k+1)``. Unknowns perturb rotations from the left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare.interpolation import MAX_GAP_NS
from tsgt.geometry import exp_so3, log_so3, rotate, rotation_from_quaternion, skew
from tsgt.geometry.trajectory.block_tridiagonal import BlockCholesky, factorise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.analysis.compare.interpolation import ReferenceMotion, ReferenceTrajectory
    from tsgt.analysis.compare.trajectories import Estimate
    from tsgt.geometry import FloatArray

NAMES = (
    "offset_s",
    "skew",
    "scale",
    *(f"extrinsic_{axis}_m" for axis in "xyz"),
    *(f"extrinsic_{axis}_rad" for axis in ("roll", "pitch", "yaw")),
)
"""Unknowns besides the drifting frame, in their order."""

KNOT_STEP_S = 0.5
MIN_ROWS, MIN_SPAN_S = 5, 2.0
ROBUSTNESS_DOF = 5.0
"""Degrees of freedom of Student's t-distribution that weighs residuals: 3 % less efficient than least squares if all is normal."""

DAMPING = np.array([1.0, 1e-3, 1.0, *[3.0] * 3, *[1.0] * 3])
"""Sigmas by which steps are damped: only what the motion does not determine notices."""

MAX_STEP = np.array([0.2, 1e-2, 0.5, *[2.0] * 3, *[0.5] * 3])


@dataclass(frozen=True, slots=True)
class Rows:
    """N poses of an estimate that a fit uses, and the K of them that are knots; the first and the last are."""

    row: NDArray[np.intp]  # (N,) of the estimate
    stamp_ns: NDArray[np.int64]  # (N,)
    since_first_s: FloatArray  # (N,) from the first stamp of the estimate
    position_m: FloatArray  # (N, 3)
    rotation: FloatArray | None  # (N, 3, 3)
    knot: NDArray[np.intp]  # (K,) of these rows
    interval: NDArray[np.intp]  # (N,) the knot before, at most K - 2
    share: FloatArray  # (N,) a, from the knot before to the one after

    @property
    def step_s(self) -> FloatArray:
        """(K - 1,) from knot to knot."""
        return np.diff(self.since_first_s[self.knot])


@dataclass(frozen=True, slots=True)
class Noise:
    """Variances of an estimate's errors along the axes of ``station1``: position in m^2, rotation in rad^2, (6,) each."""

    white: FloatArray
    walk_per_s: FloatArray
    walk_per_m: FloatArray


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Values of all unknowns."""

    offset_s: float
    skew: float
    scale: float
    arm_m: FloatArray  # (3,)
    R_point_sensor: FloatArray  # (3, 3)
    Q: FloatArray  # (K, 3, 3)
    c: FloatArray  # (K, 3)

    def moved(self, border: FloatArray, state: FloatArray) -> Unknowns:
        """Add a step of the border, (9,), and of the states, (K, 6)."""
        return Unknowns(
            self.offset_s + border[0],
            self.skew + border[1],
            self.scale + border[2],
            self.arm_m + border[3:6],
            exp_so3(border[6:]) @ self.R_point_sensor,
            exp_so3(state[:, 3:]) @ self.Q,
            self.c + state[:, :3],
        )


@dataclass(frozen=True, slots=True)
class Linearised:
    """Residuals and Jacobians; states of one interval: c, Q before, c, Q after."""

    known: NDArray[np.bool_]  # (N,) whether the reference covers the row
    arm_m: FloatArray  # (N, 3) from the reference's point to the sensor, in ``station1``
    pose: FloatArray  # (N, 6) estimate minus reference: position, rotation
    pose_by_state: FloatArray  # (N, 6, 12)
    pose_by_border: FloatArray  # (N, 6, 9)
    walk: FloatArray  # (K - 1, 6)
    walk_by_state: FloatArray  # (K - 1, 6, 12)
    walk_by_border: FloatArray  # (K - 1, 6, 9)


@dataclass(frozen=True, slots=True)
class Solved:
    """Normal equations, solved, with what the uncertainty needs."""

    border_step: FloatArray  # (9,)
    state_step: FloatArray  # (K, 6)
    information: FloatArray  # (P, P) of the active unknowns, the frame eliminated
    scores: (
        FloatArray  # (K - 1, P) derivative of the cost by these, interval by interval, the frame following
    )


def rows_of(estimate: Estimate, usable: NDArray[np.bool_], min_step_s: float) -> Rows:
    """Choose rows at least about ``min_step_s`` apart among the usable ones. Raises ValueError: they last too short."""
    row = np.flatnonzero(usable)
    since_s = (estimate.stamp_ns - estimate.stamp_ns[0]) / 1e9
    if len(row) < MIN_ROWS or since_s[row[-1]] - since_s[row[0]] < MIN_SPAN_S:
        raise ValueError(
            f"a fit needs at least {MIN_ROWS} poses over {MIN_SPAN_S:g} s inside the reference, there are {len(row)}; the reference is "
            f"interpolated between valid poses that are at most {MAX_GAP_NS / 1e9:g} s apart"
        )
    row = row[_first_of_each(np.floor(since_s[row] / min_step_s))]
    knot = _first_of_each(np.floor(since_s[row] / KNOT_STEP_S))
    if len(row) - 1 - knot[-1] > 0:
        knot = np.append(knot, len(row) - 1)
    rotation = _rotations(estimate, row)
    interval, share = _in_interval(since_s[row[knot]], since_s[row])
    return Rows(
        row, estimate.stamp_ns[row], since_s[row], estimate.position_m[row], rotation, knot, interval, share
    )


def all_rows(estimate: Estimate, rows: Rows, usable: NDArray[np.bool_]) -> Rows:
    """Return every usable pose of the estimate, on the knots of ``rows``."""
    row = np.union1d(np.flatnonzero(usable), rows.row)
    since_s = (estimate.stamp_ns - estimate.stamp_ns[0]) / 1e9
    knot = np.searchsorted(row, rows.row[rows.knot])
    rotation = _rotations(estimate, row)
    interval, share = _in_interval(since_s[row[knot]], since_s[row])
    return Rows(
        row, estimate.stamp_ns[row], since_s[row], estimate.position_m[row], rotation, knot, interval, share
    )


def _rotations(estimate: Estimate, row: NDArray[np.intp]) -> FloatArray | None:
    q = estimate.orientation_xyzw
    return None if q is None else rotation_from_quaternion(q[row])


def _first_of_each(bins: FloatArray) -> NDArray[np.intp]:
    return np.flatnonzero(np.concatenate([[True], np.diff(bins) > 0]))


def _in_interval(knot_s: FloatArray, at_s: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    interval = np.clip(np.searchsorted(knot_s, at_s, side="right") - 1, 0, len(knot_s) - 2)
    return interval, (at_s - knot_s[interval]) / (knot_s[interval + 1] - knot_s[interval])


def drift_at(rows: Rows, unknowns: Unknowns) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the frame's rotation at each row, (N, 3, 3), the sensor's position by it, (N, 3), and the arms from both knots."""
    before, after = rows.interval, rows.interval + 1
    a = rows.share[:, None]
    own = unknowns.scale * rows.position_m
    at_knot = own[rows.knot]
    arm_before = rotate(unknowns.Q[before], own - at_knot[before])
    arm_after = rotate(unknowns.Q[after], own - at_knot[after])
    position = (1 - a) * (arm_before + unknowns.c[before]) + a * (arm_after + unknowns.c[after])
    turn = log_so3(unknowns.Q[1:] @ np.swapaxes(unknowns.Q[:-1], 1, 2))
    rotation = exp_so3(a * turn[before]) @ unknowns.Q[before]
    return rotation, position, arm_before, arm_after


def linearise(trajectory: ReferenceTrajectory, rows: Rows, unknowns: Unknowns) -> Linearised:
    """Residuals and their derivatives; those of rotations to first order in the residual."""
    n, k = len(rows.row), len(rows.knot)
    motion = trajectory.motion_at(corrected_stamp_ns(rows, unknowns))
    pose, arm_m, arm_before, arm_after = pose_residuals(motion, rows, unknowns)
    a = rows.share[:, None, None]
    velocity = motion.velocity_mps + np.cross(motion.angular_velocity_radps, arm_m)
    by_state, by_border = np.zeros((n, 6, 12)), np.zeros((n, 6, 9))
    eye = np.eye(3)
    by_state[:, :3, 0:3], by_state[:, :3, 3:6] = (1 - a) * eye, -(1 - a) * skew(arm_before)
    by_state[:, :3, 6:9], by_state[:, :3, 9:12] = a * eye, -a * skew(arm_after)
    by_border[:, :3, 0] = -velocity
    by_border[:, :3, 2] = ((1 - a[:, 0]) * arm_before + a[:, 0] * arm_after) / unknowns.scale
    by_border[:, :3, 3:6] = -motion.rotation
    if rows.rotation is not None:
        by_state[:, 3:, 3:6], by_state[:, 3:, 9:12] = (1 - a) * eye, a * eye
        by_border[:, 3:, 0] = -motion.angular_velocity_radps
        by_border[:, 3:, 6:9] = -motion.rotation
    by_border[:, :, 1] = by_border[:, :, 0] * rows.since_first_s[:, None]
    walk, step_before, step_after = walk_residuals(rows, unknowns)
    walk_by_state = np.zeros((k - 1, 6, 12))
    walk_by_border = np.zeros((k - 1, 6, 9))
    walk_by_state[:, :3, 0:3], walk_by_state[:, :3, 6:9] = -eye, eye
    walk_by_state[:, :3, 3:6], walk_by_state[:, :3, 9:12] = 0.5 * skew(step_before), 0.5 * skew(step_after)
    walk_by_state[:, 3:, 3:6], walk_by_state[:, 3:, 9:12] = -eye, eye
    walk_by_border[:, :3, 2] = -0.5 * (step_before + step_after) / unknowns.scale
    return Linearised(motion.known, arm_m, pose, by_state, by_border, walk, walk_by_state, walk_by_border)


def corrected_stamp_ns(rows: Rows, unknowns: Unknowns) -> NDArray[np.int64]:
    """Return the instants of rows on the reference's clock, (N,)."""
    correction_ns = 1e9 * (unknowns.offset_s + unknowns.skew * rows.since_first_s)
    return np.asarray(rows.stamp_ns + np.rint(correction_ns).astype(np.int64))


def pose_residuals(
    motion: ReferenceMotion, rows: Rows, unknowns: Unknowns
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return estimate minus reference, (N, 6); the lever arm in ``station1``, (N, 3), and those from both knots."""
    rotation, position, arm_before, arm_after = drift_at(rows, unknowns)
    arm_m = rotate(motion.rotation, unknowns.arm_m)
    pose = np.zeros((len(rows.row), 6))
    pose[:, :3] = position - motion.position_m - arm_m
    if rows.rotation is not None:
        sensor = motion.rotation @ unknowns.R_point_sensor
        pose[:, 3:] = log_so3(rotation @ rows.rotation @ np.swapaxes(sensor, 1, 2))
    return pose, arm_m, arm_before, arm_after


def walk_residuals(rows: Rows, unknowns: Unknowns) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the steps of drift, (K - 1, 6), and the estimate's own steps turned as at either knot, (K - 1, 3)."""
    step = np.diff(unknowns.scale * rows.position_m[rows.knot], axis=0)
    step_before, step_after = rotate(unknowns.Q[:-1], step), rotate(unknowns.Q[1:], step)
    walk = np.zeros((len(step), 6))
    walk[:, :3] = np.diff(unknowns.c, axis=0) - 0.5 * (step_before + step_after)
    walk[:, 3:] = log_so3(unknowns.Q[1:] @ np.swapaxes(unknowns.Q[:-1], 1, 2))
    return walk, step_before, step_after


def robust_weight(square: FloatArray, dimensions: int, *, convex: bool) -> FloatArray:
    """Weight of residuals with this squared Mahalanobis distance: by Student's t-distribution, or Huber's while ``convex``.

    Huber's cost has one minimum only: from far away, Student's would take for outliers whatever does not fit yet.
    """
    if convex:
        limit = dimensions + 4.0
        return np.asarray(np.sqrt(limit / np.maximum(square, limit)))
    return (ROBUSTNESS_DOF + dimensions) / (ROBUSTNESS_DOF + square)


def solve(
    rows: Rows,
    linear: Linearised,
    pose_whitening: FloatArray,
    walk_information: FloatArray,
    active: Sequence[int],
    prior: tuple[FloatArray, FloatArray],
) -> Solved:
    """Solve the normal equations: block tridiagonal in the drifting frame, bordered by the active unknowns.

    ``pose_whitening``, (N, 6, 6), makes residuals of unit covariance; ``walk_information``, (K - 1, 6): inverse variances. ``prior``: differences from the prior,
    (9,), and their inverse variances, (9,).
    """
    k, p = len(rows.knot), len(active)
    columns = list(active)
    both = np.concatenate(
        [linear.pose_by_state, linear.pose_by_border[:, :, columns], linear.pose[:, :, None]], axis=2
    )
    both = pose_whitening @ both
    walk = np.concatenate(
        [linear.walk_by_state, linear.walk_by_border[:, :, columns], linear.walk[:, :, None]], axis=2
    )
    walk *= np.sqrt(walk_information)[:, :, None]
    # All rows of one interval in one product: padded with zeros to the same number.
    count = np.bincount(rows.interval, minlength=k - 1)
    most = int(count.max())
    slot = np.arange(len(rows.row)) - np.concatenate([[0], np.cumsum(count)[:-1]])[rows.interval]
    padded = np.zeros((k - 1, most + 1, 6, 13 + p))
    padded[rows.interval, slot] = both
    padded[:, most] = walk
    stacked = padded.reshape(k - 1, -1, 13 + p)
    normal = np.swapaxes(stacked, 1, 2) @ stacked
    diagonal, right = np.zeros((k, 6, 6)), np.zeros((k, 6, p + 1))
    diagonal[:-1] += normal[:, :6, :6]
    diagonal[1:] += normal[:, 6:12, 6:12]
    right[:-1] += normal[:, :6, 12:]
    right[1:] += normal[:, 6:12, 12:]
    # The first knot alone is tied down, barely: positions along a line leave a rotation open.
    diagonal[0] += np.diag([1e-8] * 3 + [1e-4] * 3)
    factor: BlockCholesky = factorise(diagonal, normal[:, :6, 6:12])
    eliminated = factor.solve(right)
    border = normal[:, 12:, 12:].sum(axis=0) - np.einsum("kij,kil->jl", right, eliminated)
    difference, weight = prior[0][columns], prior[1][columns]
    information = border[:p, :p] + np.diag(weight)
    gradient = border[:p, p] + weight * difference
    damped = information + np.diag(DAMPING[columns] ** -2.0)
    step = -np.linalg.solve(damped, gradient) if p else np.zeros(0)
    limit = np.abs(step / MAX_STEP[columns]).max(initial=1.0)
    step = step / limit
    state_step = -eliminated[:, :, p] - eliminated[:, :, :p] @ step
    # What the residuals of each interval pull at the unknowns, the frame following them.
    followed = np.concatenate([eliminated[:-1, :, :p], eliminated[1:, :, :p]], axis=1)
    effective = stacked[:, :, 12 : 12 + p] - stacked[:, :, :12] @ followed
    scores = np.einsum("kip,ki->kp", effective, stacked[:, :, 12 + p])
    border_step = np.zeros(len(NAMES))
    border_step[columns] = step
    return Solved(border_step, state_step, information, scores)


def start_states(
    trajectory: ReferenceTrajectory, rows: Rows, unknowns: Unknowns, R_station1_frame: FloatArray
) -> Unknowns:
    """Return the unknowns with a frame that brings each knot to the reference; of positions alone, turned as given."""
    correction_ns = 1e9 * (unknowns.offset_s + unknowns.skew * rows.since_first_s[rows.knot])
    motion = trajectory.motion_at(rows.stamp_ns[rows.knot] + np.rint(correction_ns).astype(np.int64))
    c = motion.position_m + rotate(motion.rotation, unknowns.arm_m)
    if rows.rotation is None:
        Q = np.broadcast_to(R_station1_frame, (len(c), 3, 3)).copy()
    else:
        Q = motion.rotation @ unknowns.R_point_sensor @ np.swapaxes(rows.rotation[rows.knot], 1, 2)
    # A knot that the reference does not cover takes the frame of the covered one before it.
    covered = np.flatnonzero(motion.known)
    nearest = covered[np.clip(np.searchsorted(covered, np.arange(len(c)), side="right") - 1, 0, None)]
    own = unknowns.scale * rows.position_m[rows.knot]
    c = rotate(Q[nearest], own - own[nearest]) + c[nearest]
    return replace(unknowns, Q=Q[nearest], c=c)
