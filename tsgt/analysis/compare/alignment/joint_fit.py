"""Joint fit of clock, scale and extrinsic while the frame drifts: initial values, error levels, iterations, what is determined."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare.alignment.drifting_frame import (
    NAMES,
    Noise,
    Rows,
    Solved,
    Unknowns,
    all_rows,
    corrected_stamp_ns,
    linearise,
    pose_residuals,
    robust_weight,
    rows_of,
    solve,
    start_states,
    walk_residuals,
)
from tsgt.analysis.compare.alignment.initialisation import (
    estimate_motion,
    extrinsic_rotation,
    offset_by_correlation,
    rotation_between,
)
from tsgt.analysis.compare.alignment.noise import estimate_noise
from tsgt.analysis.compare.alignment.reference_error import as_white, own_covariance, whiten
from tsgt.analysis.compare.alignment.uncertainty import fit_covariance, weak_unknowns, weakest_by_stated_sigma
from tsgt.analysis.compare.pairing import on_reference_clock
from tsgt.analysis.compare.relation import Relation
from tsgt.geometry import exp_so3, log_so3, rotate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.interpolation import ReferenceMotion, ReferenceTrajectory
    from tsgt.analysis.compare.relation import FitSettings
    from tsgt.analysis.compare.trajectories import Estimate
    from tsgt.geometry import FloatArray

MIN_STEP_S = 0.04
MAX_ROWS = 8_000
"""Poses of an estimate that clock and extrinsic are fitted to, at most at 25 Hz: the reference's own errors are correlated over ten
times as long. The frame is aligned, and outliers are told, by all poses."""

NOISE_PASSES = 3
MAX_ITERATIONS = 20
CONVEX_ITERATIONS = 4
LOST_KNOTS, LOST_RATIO = (
    8,
    6.0,
)  # Knots over which displacements are compared; ratio to their usual difference
LOST_AT_FIRST = (
    1e12  # Squared distance given to such steps, so that the first step of the fit does without them
)
CONVERGED_SIGMAS = 1e-3
MAX_TURNS, TURN_TOLERANCE_RAD = 50, 1e-9

OUTLIER_SQUARE = 40.0  # Squared Mahalanobis distance of a pose
LOST_SQUARE = 60.0  # Of a step of drift
MAX_LOST_SHARE = 0.6
MIN_GOOD = 3


@dataclass(frozen=True, slots=True)
class EveryPose:
    """All N poses of an estimate that are paired, also those that nothing was fitted to."""

    rows: Rows
    motion: ReferenceMotion
    covariance: FloatArray | None  # (N, 6, 6) of the reference's point; None: unknown
    good: NDArray[np.bool_]  # (N,) those that are no outliers


@dataclass(frozen=True, slots=True)
class JointFit:
    """Clock, scale and extrinsic, fitted while the frame drifts."""

    rows: Rows
    unknowns: Unknowns
    noise: Noise
    active: list[int]
    covariance: FloatArray  # (P, P)
    unobservable: tuple[str, ...]
    every: EveryPose


def driven_m(rows: Rows, unknowns: Unknowns) -> FloatArray:
    """Return the way from knot to knot, (K - 1,)."""
    steps = np.diff(unknowns.scale * rows.position_m[rows.knot], axis=0)
    return np.asarray(np.sqrt((steps**2).sum(axis=1)))


def fit_jointly(
    trajectory: ReferenceTrajectory, estimate: Estimate, settings: FitSettings, start: Relation
) -> JointFit:
    """Fit from nothing but ``start``. Raises ValueError: less than two seconds of the estimate lie inside the reference."""
    prior = settings.extrinsic_prior
    T_prior = start.T_point_sensor if prior is None else prior.T_point_sensor
    begun = _initial(trajectory, estimate, settings, start, T_prior)
    relation = replace(start, offset_s=begun.offset_s)
    usable = trajectory.covers(on_reference_clock(estimate, relation))
    n_usable = int(np.count_nonzero(usable))
    span_s = 0.0 if n_usable < 2 else float(np.ptp(estimate.stamp_ns[usable])) / 1e9
    rows = rows_of(estimate, usable, max(MIN_STEP_S, span_s / MAX_ROWS))
    frame = _frame_of_positions(trajectory, rows, begun) if rows.rotation is None else np.eye(3)
    unknowns = start_states(trajectory, rows, begun, frame)
    active = [i for i, name in enumerate(NAMES) if _is_free(name, settings, rows)]
    prior_terms = _prior_terms(settings, active)
    lost = _moves_otherwise(rows, unknowns)
    noise = estimate_noise(trajectory, rows, unknowns, lost, is_rough=True)
    first: NDArray[np.bool_] | None = lost
    solved: Solved | None = None
    for _ in range(NOISE_PASSES):
        unknowns, solved = _iterate(trajectory, rows, unknowns, noise, active, T_prior, prior_terms, first)
        lost, first = _steps_lost(rows, unknowns, noise), None
        noise = estimate_noise(trajectory, rows, unknowns, lost)
    unobservable = [i for i, name in enumerate(NAMES) if _never_observable(name, rows)]
    weak = weak_unknowns(solved, active, prior_terms) if solved is not None else []
    while True:
        first = None
        if weak:
            unobservable += weak
            active = [i for i in active if i not in weak]
            unknowns = _at_prior(unknowns, weak, begun, T_prior)
            # The frame that the knots followed is not that of these values.
            unknowns = start_states(trajectory, rows, unknowns, frame)
            first = _moves_otherwise(rows, unknowns)
        unknowns, solved = _iterate(
            trajectory,
            rows,
            unknowns,
            noise,
            active,
            T_prior,
            prior_terms,
            first,
            tolerance_sigmas=CONVERGED_SIGMAS,
        )
        covariance = fit_covariance(solved, rows)
        # The model may take the reference's noise for motion, which the residuals show.
        weak = weakest_by_stated_sigma(covariance, active, prior_terms)
        if not weak:
            break
    every = _every_pose(trajectory, estimate, rows, unknowns, noise)
    names = tuple(NAMES[i] for i in sorted(unobservable))
    return JointFit(rows, unknowns, noise, active, covariance, names, every)


def _initial(
    trajectory: ReferenceTrajectory,
    estimate: Estimate,
    settings: FitSettings,
    start: Relation,
    T_prior: FloatArray,
) -> Unknowns:
    motion = estimate_motion(estimate)
    offset_s, scale, R = start.offset_s, start.scale, T_prior[:3, :3]
    if "offset" in settings.parts:
        offset_s = offset_by_correlation(trajectory, motion, offset_s, settings.max_offset_s)
    found = extrinsic_rotation(trajectory, motion, offset_s, any_scale="scale" in settings.parts)
    if found is not None:
        scale = found[1] if "scale" in settings.parts else scale
        if settings.extrinsic_prior is None:
            R = found[0]
    none = np.zeros((0, 3))
    return Unknowns(offset_s, start.skew, scale, T_prior[:3, 3], R, np.zeros((0, 3, 3)), none)


def _frame_of_positions(trajectory: ReferenceTrajectory, rows: Rows, begun: Unknowns) -> FloatArray:
    motion = trajectory.motion_at(corrected_stamp_ns(rows, begun))
    own, target = rows.position_m[motion.known], motion.position_m[motion.known]
    own, target = own - np.median(own, axis=0), target - np.median(target, axis=0)
    spread = np.linalg.svd(own.T @ target, compute_uv=False)
    if spread[1] <= 1e-6 * spread[0]:
        own, target = own * (1.0, 1.0, 0.0), target * (1.0, 1.0, 0.0)
        (x, y, _), (u, v, _) = own.T, target.T
        return exp_so3(np.array([0.0, 0.0, math.atan2(float(x @ v - y @ u), float(x @ u + y @ v))]))
    return rotation_between(own, target)


def _is_free(name: str, settings: FitSettings, rows: Rows) -> bool:
    if _never_observable(name, rows):
        return False
    if name.startswith("extrinsic"):
        prior = settings.extrinsic_prior
        return prior is None or prior.sigma[NAMES.index(name) - 3] > 0
    return name.removesuffix("_s") in settings.parts


def _never_observable(name: str, rows: Rows) -> bool:
    """Tell whether no motion whatever determines it: the rotation of a sensor that has positions alone."""
    return rows.rotation is None and name.startswith("extrinsic") and name.endswith("_rad")


def _prior_terms(settings: FitSettings, active: list[int]) -> FloatArray:
    """Inverse variances of the prior, (9,)."""
    weight = np.zeros(len(NAMES))
    if settings.extrinsic_prior is not None:
        sigma = settings.extrinsic_prior.sigma
        weight[3:] = np.where(sigma > 0, 1.0 / np.maximum(sigma, 1e-12) ** 2, 0.0)
    weight[[i for i in range(len(NAMES)) if i not in active]] = 0.0
    return weight


def _iterate(
    trajectory: ReferenceTrajectory,
    rows: Rows,
    unknowns: Unknowns,
    noise: Noise,
    active: list[int],
    T_prior: FloatArray,
    prior_weight: FloatArray,
    lost: NDArray[np.bool_] | None = None,
    tolerance_sigmas: float = 0.05,
) -> tuple[Unknowns, Solved]:
    """Iterate to convergence; returns the unknowns with the system at which they converged.

    ``lost``: (K - 1,) steps of drift that must not count in the first step of a fit from initial values.
    """
    dimensions = 3 if rows.rotation is None else 6
    stamp_ns = corrected_stamp_ns(rows, unknowns)
    covariance = own_covariance(trajectory, stamp_ns, trajectory.covers(stamp_ns))
    if covariance is not None:
        covariance = as_white(covariance, float(np.median(np.diff(rows.since_first_s))))
    for iteration in range(MAX_ITERATIONS):
        # The first step is that of least squares: from knots that follow every noisy pose to a smooth drift.
        convex = lost is not None and iteration < CONVEX_ITERATIONS
        linear = linearise(trajectory, rows, unknowns)
        whitening = whiten(
            linear.pose, noise.white, covariance, linear.arm_m, has_orientation=rows.rotation is not None
        )
        walk_variance = _walk_variance(rows, unknowns, noise)
        walk_square = _pairwise(linear.walk**2 / walk_variance)
        if lost is not None and iteration == 0:
            whitening = replace(whitening, square=np.zeros(len(whitening.square)))
            walk_square = np.where(lost[:, None], LOST_AT_FIRST, np.zeros((1, 2)))
        weight = np.where(linear.known, robust_weight(whitening.square, dimensions, convex=convex), 0.0)
        walk_weight = robust_weight(walk_square, 3, convex=convex)
        difference = np.zeros(len(NAMES))
        difference[3:6] = unknowns.arm_m - T_prior[:3, 3]
        difference[6:] = log_so3(unknowns.R_point_sensor @ T_prior[:3, :3].T)
        solved = solve(
            rows,
            linear,
            whitening.matrix * np.sqrt(weight)[:, None, None],
            np.repeat(walk_weight, 3, axis=1) / walk_variance,
            active,
            (difference, prior_weight),
        )
        unknowns = unknowns.moved(solved.border_step, solved.state_step)
        sigma = 1.0 / np.sqrt(np.maximum(np.diag(solved.information), 1e-30))
        if not convex and (np.abs(solved.border_step[active]) <= tolerance_sigmas * sigma).all():
            break
    return unknowns, solved


def _steps_lost(rows: Rows, unknowns: Unknowns, noise: Noise) -> NDArray[np.bool_]:
    """(K - 1,) steps of drift that no noise explains; none if they are most of all."""
    walk, _, _ = walk_residuals(rows, unknowns)
    lost = np.max(_pairwise(walk**2 / _walk_variance(rows, unknowns, noise)), axis=1) > LOST_SQUARE
    return lost if lost.mean() < MAX_LOST_SHARE else np.zeros(len(lost), dtype=np.bool_)


def _moves_otherwise(rows: Rows, unknowns: Unknowns) -> NDArray[np.bool_]:
    """(K - 1,) whether the estimate moves over seconds unlike the reference by far more than it usually does."""
    own = unknowns.scale * rows.position_m[rows.knot]
    before = np.arange(len(own) - 1)
    after = np.minimum(before + LOST_KNOTS, len(own) - 1)
    step = own[after] - own[before]
    by_start, by_end = (rotate(unknowns.Q[each], step) for each in (before, after))
    square = ((0.5 * (by_start + by_end) - unknowns.c[after] + unknowns.c[before]) ** 2).sum(axis=1)
    return np.asarray(square > LOST_RATIO**2 * max(float(np.median(square)), 1e-12))


def _pairwise(squares: FloatArray) -> FloatArray:
    """Sum over position and over rotation, (N, 2)."""
    return np.asarray(squares.reshape(-1, 2, 3).sum(axis=2))


def _walk_variance(rows: Rows, unknowns: Unknowns, noise: Noise) -> FloatArray:
    way_m = driven_m(rows, unknowns)[:, None]
    return np.asarray(noise.walk_per_s * rows.step_s[:, None] + noise.walk_per_m * way_m)


def _at_prior(unknowns: Unknowns, weak: list[int], begun: Unknowns, T_prior: FloatArray) -> Unknowns:
    """Return the unknowns with the weak ones as they were given, clock and scale as they were begun with."""
    names = {NAMES[i] for i in weak}
    arm_m = unknowns.arm_m.copy()
    for i in weak:
        if 3 <= i < 6:
            arm_m[i - 3] = T_prior[i - 3, 3]
    about = np.array([float(i in weak) for i in (6, 7, 8)])
    return replace(
        unknowns,
        offset_s=begun.offset_s if "offset_s" in names else unknowns.offset_s,
        skew=begun.skew if "skew" in names else unknowns.skew,
        scale=begun.scale if "scale" in names else unknowns.scale,
        arm_m=arm_m,
        R_point_sensor=_turned_towards(unknowns.R_point_sensor, T_prior[:3, :3], about),
    )


def _turned_towards(rotation: FloatArray, target: FloatArray, about: FloatArray) -> FloatArray:
    """Turn a rotation, (3, 3), about the fixed axes that are 1 in ``about``, (3,), to where it is closest to another one."""
    for _ in range(MAX_TURNS):
        rest = about * log_so3(rotation @ target.T)
        if np.linalg.norm(rest) < TURN_TOLERANCE_RAD:
            break
        rotation = exp_so3(-rest) @ rotation
    return rotation


def _every_pose(
    trajectory: ReferenceTrajectory, estimate: Estimate, rows: Rows, unknowns: Unknowns, noise: Noise
) -> EveryPose:
    relation = Relation(unknowns.offset_s, unknowns.skew, np.eye(4), np.eye(4), 1.0)
    every = all_rows(estimate, rows, trajectory.covers(on_reference_clock(estimate, relation)))
    stamp_ns = corrected_stamp_ns(every, unknowns)
    motion = trajectory.motion_at(stamp_ns)
    pose, arm_m, _, _ = pose_residuals(motion, every, unknowns)
    covariance = own_covariance(trajectory, stamp_ns, motion.known)
    whitening = whiten(pose, noise.white, covariance, arm_m, has_orientation=rows.rotation is not None)
    lost = _steps_lost(rows, unknowns, noise)
    good = motion.known & (whitening.square <= OUTLIER_SQUARE) & ~lost[every.interval]
    if np.count_nonzero(good) < MIN_GOOD:
        good = motion.known
    return EveryPose(every, motion, covariance, good)
