"""The fit of the relation between an estimate and the reference, with uncertainties that allow for drift."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare.alignment.drifting_frame import NAMES
from tsgt.analysis.compare.alignment.frame import FRAME_NAMES, align_frame, frame_covariance
from tsgt.analysis.compare.alignment.joint_fit import JointFit, driven_m, fit_jointly
from tsgt.analysis.compare.alignment.reference_error import as_white, at_sensor
from tsgt.analysis.compare.interpolation import ReferenceTrajectory
from tsgt.analysis.compare.pairing import on_reference_clock
from tsgt.analysis.compare.relation import Alignment, Fit, FitSettings, FittedPart, Relation, initial_relation
from tsgt.geometry import rotate, transform_from

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.trajectories import Estimate, ReferencePoses
    from tsgt.geometry import FloatArray


def fit(
    reference: ReferencePoses, estimate: Estimate, settings: FitSettings, start: Relation | None = None
) -> Fit:
    """Fit the parts asked for; of the others, and of what the motion does not determine, ``start`` holds.

    Clock and extrinsic are always fitted together, so that an extrinsic which is not asked for, hence not applied, does not
    bias the offset. Raises ValueError: less than two seconds of the estimate lie inside the reference.
    """
    start = initial_relation() if start is None else start
    trajectory = ReferenceTrajectory(reference)
    return _applied(fit_jointly(trajectory, estimate, settings, start), estimate, settings, start)


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
    joints: dict[frozenset[FittedPart], JointFit] = {}
    for added, align in steps:
        if not added <= settings.parts:
            continue
        parts |= added
        own = replace(settings, parts=frozenset(parts), align=align if "frame" in parts else "none")
        if not parts:
            prior = settings.extrinsic_prior
            given = start if prior is None else replace(start, T_point_sensor=prior.T_point_sensor)
            used = trajectory.covers(on_reference_clock(estimate, given))
            found.append((own, Fit(given, (), np.zeros((0, 0)), (), used, math.nan)))
            continue
        key = own.parts & {"offset", "skew", "scale"}
        if key not in joints:
            joints[key] = fit_jointly(trajectory, estimate, own, start)
        found.append((own, _applied(joints[key], estimate, own, start)))
    return found


def _applied(joint: JointFit, estimate: Estimate, settings: FitSettings, start: Relation) -> Fit:
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
    used[joint.every.rows.row[joint.every.good]] = True
    ate_sigma_m = math.nan
    if "frame" in settings.parts and settings.align != "none":
        framed = _with_frame(joint, settings.align, relation)
        relation = framed.relation
        by_error = framed.ate_by_unknowns[stated]
        ate_sigma_m = math.sqrt(max(float(by_error @ covariance @ by_error), 0.0))
        cross = framed.by_unknowns[:, stated] @ covariance
        own = framed.covariance + cross @ framed.by_unknowns[:, stated].T
        covariance = np.block([[covariance, cross.T], [cross, own]])
        kept = np.concatenate([np.ones(len(stated), dtype=np.bool_), framed.determined])
        covariance = covariance[np.ix_(kept, kept)]
        names += tuple(name for name, ok in zip(FRAME_NAMES, framed.determined, strict=True) if ok)
    return Fit(relation, names, covariance, unobservable, used, ate_sigma_m)


@dataclass(frozen=True, slots=True)
class _Framed:
    relation: Relation
    by_unknowns: FloatArray  # (6, 9) derivative of the frame by the unknowns
    covariance: FloatArray  # (6, 6) of the frame alone
    determined: NDArray[np.bool_]  # (6,) what the alignment fits
    ate_by_unknowns: FloatArray  # (9,) derivative of the position ATE by the unknowns, the frame following


def _with_frame(joint: JointFit, align: Alignment, relation: Relation) -> _Framed:
    rows, motion = joint.every.rows, joint.every.motion
    sensor = motion.transform @ relation.T_point_sensor
    good = joint.every.good & motion.known
    own_m = relation.scale * rows.position_m
    arm_m = rotate(motion.rotation, relation.T_point_sensor[:3, 3])
    frame = align_frame(align, rows, own_m, sensor, np.ones(len(own_m)), good)
    of_reference = None
    if joint.every.covariance is not None:
        of_reference = at_sensor(joint.every.covariance, arm_m)
        variance = np.einsum("nii->n", of_reference[:, :3, :3])
        excess = np.maximum(variance - np.median(variance[good]), 0.0)
        # Errors of an alignment are mostly drift: the reference counts less only where it adds to this.
        aligned = rotate(frame.T_station1_frame[:3, :3], own_m) + frame.T_station1_frame[:3, 3]
        usual = float(np.median(((aligned - sensor[:, :3, 3]) ** 2).sum(axis=1)[frame.kept]))
        weight = usual / (usual + excess) if usual > 0 else np.ones(len(own_m))
        frame = align_frame(align, rows, own_m, sensor, weight, good)
    R = frame.T_station1_frame[:3, :3]
    aligned = rotate(R, own_m) + frame.T_station1_frame[:3, 3]
    by_unknowns = np.zeros((len(own_m), 6, len(NAMES)))
    velocity = motion.velocity_mps + np.cross(motion.angular_velocity_radps, arm_m)
    by_unknowns[:, :3, 0], by_unknowns[:, 3:, 0] = -velocity, -motion.angular_velocity_radps
    by_unknowns[:, :, 1] = by_unknowns[:, :, 0] * rows.since_first_s[:, None]
    by_unknowns[:, :3, 2] = rotate(R, rows.position_m)
    by_unknowns[:, :3, 3:6] = by_unknowns[:, 3:, 6:9] = -motion.rotation
    change = -np.tensordot(frame.by_position, by_unknowns[:, :3], axes=([0, 2], [0, 1]))
    change -= np.tensordot(frame.by_rotation, by_unknowns[:, 3:], axes=([0, 2], [0, 1]))
    error = (aligned - sensor[:, :3, 3])[motion.known]
    about = (aligned - aligned[good].mean(axis=0))[motion.known]
    pull = np.tensordot(error, by_unknowns[motion.known, :3], axes=([0, 1], [0, 1]))
    pull += np.concatenate([error.sum(axis=0), np.cross(about, error).sum(axis=0)]) @ change
    ate_m = math.sqrt(float((error**2).sum(axis=1).mean()))
    if of_reference is not None:
        of_reference = as_white(of_reference, float(np.median(np.diff(rows.since_first_s))))
    return _Framed(
        relation=replace(relation, T_station1_frame=frame.T_station1_frame),
        by_unknowns=change,
        covariance=frame_covariance(
            frame, rows, aligned, joint.noise, driven_m(rows, joint.unknowns), of_reference
        ),
        determined=frame.determined,
        ate_by_unknowns=pull / max(len(error) * ate_m, 1e-12),
    )
