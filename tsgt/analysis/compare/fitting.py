"""The joint fit of what stands between an estimate and the reference, with uncertainties that allow for drift."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare.drifting_frame import (
    NAMES,
    Noise,
    Rows,
    Solved,
    Unknowns,
    all_rows,
    linearise,
    robust_weight,
    rows_of,
    solve,
    start_states,
)
from tsgt.analysis.compare.fit_uncertainty import fit_covariance, weak_unknowns
from tsgt.analysis.compare.frame_alignment import FRAME_NAMES, align_frame, drift_covariance
from tsgt.analysis.compare.initialisation import (
    estimate_motion,
    extrinsic_rotation,
    offset_by_correlation,
    rotation_between,
)
from tsgt.analysis.compare.interpolation import ReferenceTrajectory
from tsgt.analysis.compare.noise import estimate_noise
from tsgt.analysis.compare.pairing import on_reference_clock
from tsgt.analysis.compare.reference_error import as_white, at_sensor, own_covariance, whiten
from tsgt.analysis.compare.relation import Alignment, Fit, FittedPart, Relation, initial_relation
from tsgt.geometry import exp_so3, log_so3, rotate, transform_from

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.trajectories import Estimate, ReferencePoses
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

OUTLIER_SQUARE = 40.0  # Squared Mahalanobis distance of a pose
LOST_SQUARE = 60.0  # Of a step of drift
MAX_LOST_SHARE = 0.6
MIN_GOOD = 3


@dataclass(frozen=True, slots=True)
class ExtrinsicPrior:
    """Where the sensor is by CAD or by an earlier calibration."""

    T_point_sensor: FloatArray  # (4, 4)
    sigma: FloatArray
    """(6,) in m along, and in rad about, the axes of the reference's point; 0: known exactly."""


@dataclass(frozen=True, slots=True)
class FitSettings:
    """What is fitted, and how the frame is aligned."""

    parts: frozenset[FittedPart] = frozenset({"offset", "frame"})
    align: Alignment = "start"
    extrinsic_prior: ExtrinsicPrior | None = None
    max_offset_s: float = 60.0


@dataclass(frozen=True, slots=True)
class _Joint:
    """Clock, scale and extrinsic, fitted while the frame drifts."""

    trajectory: ReferenceTrajectory
    rows: Rows
    unknowns: Unknowns
    noise: Noise
    active: list[int]
    covariance: FloatArray  # (P, P)
    unobservable: tuple[str, ...]
    every: Rows  # All poses that are paired
    good: NDArray[np.bool_]  # of these, those that are no outliers


def fit(
    reference: ReferencePoses, estimate: Estimate, settings: FitSettings, start: Relation | None = None
) -> Fit:
    """Fit the parts asked for; of the others, and of what the motion does not determine, ``start`` holds.

    Clock and extrinsic are always fitted together, so that an extrinsic which is not asked for, hence not applied, does not
    bias the offset. Raises ValueError: less than two seconds of the estimate lie inside the reference.
    """
    start = initial_relation() if start is None else start
    trajectory = ReferenceTrajectory(reference)
    return _applied(_fit_jointly(trajectory, estimate, settings, start), estimate, settings, start)


def nested_fits(
    reference: ReferencePoses, estimate: Estimate, settings: FitSettings, start: Relation | None = None
) -> list[tuple[FitSettings, Fit]]:
    """Fit growing sets of the parts asked for, to show what each of them hides.

    Nothing; the clock; the frame at the start; the extrinsic; the frame over all (by yaw if the settings say so); the scale.
    """
    start = initial_relation() if start is None else start
    trajectory = ReferenceTrajectory(reference)
    overall: Alignment = "yaw" if settings.align == "yaw" else "rigid"
    steps: list[tuple[set[FittedPart], Alignment]] = [
        (set(), "none"),
        ({"offset"}, "none"),
        ({"skew"}, "none"),
        ({"frame"}, "start"),
        ({"extrinsic"}, "start"),
        ({"frame"}, overall),
        ({"scale"}, overall),
    ]
    parts: set[FittedPart] = set()
    found: list[tuple[FitSettings, Fit]] = []
    joints: dict[frozenset[FittedPart], _Joint] = {}
    for added, align in steps:
        if not added <= settings.parts:
            continue
        parts |= added
        own = replace(settings, parts=frozenset(parts), align=align if "frame" in parts else "none")
        if not parts:
            prior = settings.extrinsic_prior
            given = start if prior is None else replace(start, T_point_sensor=prior.T_point_sensor)
            used = trajectory.covers(on_reference_clock(estimate, given))
            found.append((own, Fit(given, (), np.zeros((0, 0)), (), used)))
            continue
        key = own.parts & {"offset", "skew", "scale"}
        if key not in joints:
            joints[key] = _fit_jointly(trajectory, estimate, own, start)
        found.append((own, _applied(joints[key], estimate, own, start)))
    return found


def _fit_jointly(
    trajectory: ReferenceTrajectory, estimate: Estimate, settings: FitSettings, start: Relation
) -> _Joint:
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
        lost, first = _steps_lost(trajectory, rows, unknowns, noise), None
        noise = estimate_noise(trajectory, rows, unknowns, lost)
    unobservable = [i for i, name in enumerate(NAMES) if _never_observable(name, rows)]
    weak = weak_unknowns(solved, active, prior_terms) if solved is not None else []
    if weak:
        unobservable += weak
        active = [i for i in active if i not in weak]
        unknowns = _at_prior(unknowns, weak, begun, T_prior)
    unknowns, solved = _iterate(
        trajectory, rows, unknowns, noise, active, T_prior, prior_terms, tolerance_sigmas=CONVERGED_SIGMAS
    )
    covariance = fit_covariance(solved, rows)
    every, good = _good_poses(trajectory, estimate, rows, unknowns, noise)
    names = tuple(NAMES[i] for i in sorted(unobservable))
    return _Joint(trajectory, rows, unknowns, noise, active, covariance, names, every, good)


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
    motion = trajectory.motion_at(_stamp_ns(rows, begun))
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
    covariance = own_covariance(trajectory, _stamp_ns(rows, unknowns), _known(trajectory, rows, unknowns))
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


def _steps_lost(
    trajectory: ReferenceTrajectory, rows: Rows, unknowns: Unknowns, noise: Noise
) -> NDArray[np.bool_]:
    """(K - 1,) steps of drift that no noise explains; none if they are most of all."""
    linear = linearise(trajectory, rows, unknowns)
    square = _pairwise(linear.walk**2 / _walk_variance(rows, unknowns, noise))
    lost = np.max(square, axis=1) > LOST_SQUARE
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


def _stamp_ns(rows: Rows, unknowns: Unknowns) -> NDArray[np.int64]:
    correction_ns = 1e9 * (unknowns.offset_s + unknowns.skew * rows.since_first_s)
    return np.asarray(rows.stamp_ns + np.rint(correction_ns).astype(np.int64))


def _known(trajectory: ReferenceTrajectory, rows: Rows, unknowns: Unknowns) -> NDArray[np.bool_]:
    return trajectory.covers(_stamp_ns(rows, unknowns))


def _driven_m(rows: Rows, unknowns: Unknowns) -> FloatArray:
    steps = np.diff(unknowns.scale * rows.position_m[rows.knot], axis=0)
    return np.asarray(np.sqrt((steps**2).sum(axis=1)))


def _walk_variance(rows: Rows, unknowns: Unknowns, noise: Noise) -> FloatArray:
    driven_m = _driven_m(rows, unknowns)[:, None]
    return np.asarray(noise.walk_per_s * rows.step_s[:, None] + noise.walk_per_m * driven_m)


def _at_prior(unknowns: Unknowns, weak: list[int], begun: Unknowns, T_prior: FloatArray) -> Unknowns:
    names = {NAMES[i] for i in weak}
    arm_m = unknowns.arm_m.copy()
    turned = log_so3(unknowns.R_point_sensor @ begun.R_point_sensor.T)
    for i in weak:
        if 3 <= i < 6:
            arm_m[i - 3] = T_prior[i - 3, 3]
        elif i >= 6:
            turned[i - 6] = 0.0
    return replace(
        unknowns,
        offset_s=begun.offset_s if "offset_s" in names else unknowns.offset_s,
        skew=begun.skew if "skew" in names else unknowns.skew,
        scale=begun.scale if "scale" in names else unknowns.scale,
        arm_m=arm_m,
        R_point_sensor=exp_so3(turned) @ begun.R_point_sensor,
    )


def _applied(joint: _Joint, estimate: Estimate, settings: FitSettings, start: Relation) -> Fit:
    """Return the relation with the parts asked for, and the frame by its alignment."""
    unknowns = joint.unknowns
    prior = settings.extrinsic_prior
    T_point_sensor = start.T_point_sensor if prior is None else prior.T_point_sensor
    if "extrinsic" in settings.parts:
        T_point_sensor = transform_from(unknowns.R_point_sensor, unknowns.arm_m)
    relation = Relation(
        offset_s=float(unknowns.offset_s),
        skew=float(unknowns.skew),
        T_point_sensor=T_point_sensor,
        T_station1_frame=start.T_station1_frame,
        scale=float(unknowns.scale),
    )
    stated = [i for i in joint.active if i < 3 or "extrinsic" in settings.parts]
    chosen = [joint.active.index(i) for i in stated]
    covariance = joint.covariance[np.ix_(chosen, chosen)]
    names = tuple(NAMES[i] for i in stated)
    unobservable = tuple(
        n for n in joint.unobservable if not n.startswith("extrinsic") or "extrinsic" in settings.parts
    )
    used = np.zeros(len(estimate.stamp_ns), dtype=np.bool_)
    used[joint.every.row[joint.good]] = True
    if "frame" in settings.parts and settings.align != "none":
        relation, by_unknowns, own, determined = _with_frame(joint, settings.align, relation)
        cross = by_unknowns[:, stated] @ covariance
        own = own + cross @ by_unknowns[:, stated].T
        covariance = np.block([[covariance, cross.T], [cross, own]])
        kept = np.concatenate([np.ones(len(stated), dtype=np.bool_), determined])
        covariance = covariance[np.ix_(kept, kept)]
        names += tuple(name for name, ok in zip(FRAME_NAMES, determined, strict=True) if ok)
    return Fit(relation, names, covariance, unobservable, used)


def _good_poses(
    trajectory: ReferenceTrajectory, estimate: Estimate, rows: Rows, unknowns: Unknowns, noise: Noise
) -> tuple[Rows, NDArray[np.bool_]]:
    """Return all poses that are paired, and of these which are no outliers, (N,)."""
    relation = Relation(unknowns.offset_s, unknowns.skew, np.eye(4), np.eye(4), 1.0)
    every = all_rows(estimate, rows, trajectory.covers(on_reference_clock(estimate, relation)))
    linear = linearise(trajectory, every, unknowns)
    covariance = own_covariance(trajectory, _stamp_ns(every, unknowns), linear.known)
    whitening = whiten(
        linear.pose, noise.white, covariance, linear.arm_m, has_orientation=rows.rotation is not None
    )
    lost = _steps_lost(trajectory, rows, unknowns, noise)
    good = linear.known & (whitening.square <= OUTLIER_SQUARE) & ~lost[every.interval]
    return every, good if np.count_nonzero(good) >= MIN_GOOD else linear.known


def _with_frame(
    joint: _Joint, align: Alignment, relation: Relation
) -> tuple[Relation, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return the relation with its frame, the frame's derivative by the unknowns, (6, 9), its own covariance, what it fits."""
    rows = joint.every
    stamp_ns = _stamp_ns(rows, joint.unknowns)
    motion = joint.trajectory.motion_at(stamp_ns)
    sensor = motion.transform @ relation.T_point_sensor
    good = joint.good & motion.known
    own_m = relation.scale * rows.position_m
    frame = align_frame(align, rows, own_m, sensor, np.ones(len(own_m)), good)
    covariance = own_covariance(joint.trajectory, stamp_ns, motion.known)
    if covariance is not None:
        arms = rotate(motion.rotation, relation.T_point_sensor[:3, 3])
        variance = np.einsum("nii->n", at_sensor(covariance, arms)[:, :3, :3])
        excess = np.maximum(variance - np.median(variance[good]), 0.0)
        # Errors of an alignment are mostly drift: the reference counts less only where it adds to this.
        aligned = rotate(frame.T_station1_frame[:3, :3], own_m) + frame.T_station1_frame[:3, 3]
        usual = float(np.median(((aligned - sensor[:, :3, 3]) ** 2).sum(axis=1)[frame.kept]))
        weight = usual / (usual + excess) if usual > 0 else np.ones(len(own_m))
        frame = align_frame(align, rows, own_m, sensor, weight, good)
    R = frame.T_station1_frame[:3, :3]
    aligned = rotate(R, own_m) + frame.T_station1_frame[:3, 3]
    arm_m = rotate(motion.rotation, relation.T_point_sensor[:3, 3])
    by_unknowns = np.zeros((len(own_m), 6, len(NAMES)))
    velocity = motion.velocity_mps + np.cross(motion.angular_velocity_radps, arm_m)
    by_unknowns[:, :3, 0], by_unknowns[:, 3:, 0] = -velocity, -motion.angular_velocity_radps
    by_unknowns[:, :, 1] = by_unknowns[:, :, 0] * rows.since_first_s[:, None]
    by_unknowns[:, :3, 2] = rotate(R, rows.position_m)
    by_unknowns[:, :3, 3:6] = by_unknowns[:, 3:, 6:9] = -motion.rotation
    change = -np.einsum("nij,njl->il", frame.by_position, by_unknowns[:, :3])
    change -= np.einsum("nij,njl->il", frame.by_rotation, by_unknowns[:, 3:])
    own = drift_covariance(frame, rows, aligned, joint.noise, _driven_m(rows, joint.unknowns))
    return replace(relation, T_station1_frame=frame.T_station1_frame), change, own, frame.determined
