"""Poses of other points of the robot: position, rotation, velocity and covariance carried over a lever arm. Sans-I/O.

With ``T_a_b`` from the new frame b on the robot to the old one a, and its lever arm l in a: p' = p + R l, R' = R R_a_b,
v' = v + R (ω x l), and ω' has the axes of b. A rotation error θ about fixed axes displaces the point by θ x R l, to first
order; the second-order part of a covariance is that of the point (:func:`tsgt.geometry.trajectory.with_second_order_terms`); the
common part has none.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation.observations import centroid_m
from tsgt.estimation.pose_batch import Kind
from tsgt.geometry import (
    covariance_over_lever_arm,
    invert,
    quaternion_from_rotation,
    rotate,
    rotation_from_quaternion,
    skew,
    transform_from,
)
from tsgt.geometry.trajectory import with_second_order_terms
from tsgt.model import ROBOT_FRAME, ROBOT_ORIGIN, ReferencePoint

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from tsgt.estimation.pose_batch import PoseBatch
    from tsgt.geometry import FloatArray
    from tsgt.model import Parameters
    from tsgt.recording import PoseRecord

POINT_COMMENT = "# reference_point:"
"""Begins the comment of a TUM file that states the point of its poses, as :func:`reference_point_text`."""

_RECORDS_PER_CHUNK = 1024


def transform_of(point: ReferencePoint) -> FloatArray:
    """Return ``T_robot_point``, (4, 4)."""
    rotation = rotation_from_quaternion(np.array(point.orientation_xyzw))
    return transform_from(rotation, np.array(point.position_m))


def transform_between(a: ReferencePoint, b: ReferencePoint) -> FloatArray:
    """Return ``T_a_b``, (4, 4)."""
    return invert(transform_of(a)) @ transform_of(b)


def centroid_point(parameters: Parameters) -> ReferencePoint:
    """Return the prisms' centroid, with the axes of the reference point."""
    x, y, z = centroid_m(parameters).tolist()
    axes = parameters.reference_point.orientation_xyzw
    return ReferencePoint(name="centroid", position_m=(x, y, z), orientation_xyzw=axes)


def named_point(parameters: Parameters, name: str) -> ReferencePoint:
    """Return a point by its name: the robot's origin, the prisms' ``centroid``, the IMU, or the recorded reference point.

    Raises ValueError: there is none of this name.
    """
    points = {ROBOT_FRAME: ROBOT_ORIGIN}
    if parameters.prisms:
        points["centroid"] = centroid_point(parameters)
    if parameters.imu is not None:
        points[parameters.imu.name] = parameters.imu.point
    points.setdefault(parameters.reference_point.name, parameters.reference_point)
    if name not in points:
        raise ValueError(f"there is no point {name!r}; there are {', '.join(points)}")
    return points[name]


def centroid_at_point(parameters: Parameters) -> FloatArray:
    """Return the prisms' centroid, (3,) in m, in the frame of the reference point."""
    centroid: FloatArray = transform_between(parameters.reference_point, centroid_point(parameters))[:3, 3]
    return centroid


def poses_at(batch: PoseBatch, point: ReferencePoint) -> PoseBatch:
    """Return the poses of another point; the same bits for a pose alone as in a batch."""
    if point == batch.reference_point:
        return batch
    T = transform_between(batch.reference_point, point)
    rows = np.flatnonzero(np.isfinite(batch.position_m[:, 0]))
    if not len(rows):
        return dataclasses.replace(batch, reference_point=point)
    names = (
        *("position_m", "orientation_xyzw", "covariance", "covariance_common"),
        *("velocity_mps", "angular_velocity_radps"),
    )
    second_order = batch.kind[rows] != Kind.INTERPOLATED
    found = moved_poses(T, *(getattr(batch, name)[rows] for name in names), second_order=second_order)
    moved = {name: getattr(batch, name).copy() for name in names}
    for name, values in zip(names, found, strict=True):
        moved[name][rows] = values
    return dataclasses.replace(batch, reference_point=point, **moved)


def moved_poses(
    T: FloatArray,
    position: FloatArray,
    orientation: FloatArray,
    covariance: FloatArray,
    covariance_common: FloatArray,
    velocity: FloatArray,
    rate: FloatArray,
    *,
    second_order: NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return poses of frame a as those of frame b, in the order of the arguments, by ``T_a_b``.

    ``second_order``: (N,) whether ``covariance`` contains second-order terms, which depend on the point.
    """
    if np.array_equal(T, np.eye(4)):
        return position, orientation, covariance, covariance_common, velocity, rate
    arm_m, (position, orientation, velocity, rate) = _motion_at(T, position, orientation, velocity, rate)
    covariance = _covariance_at(covariance, arm_m, second_order)
    covariance_common = covariance_over_lever_arm(covariance_common, arm_m)
    return position, orientation, covariance, covariance_common, velocity, rate


def records_at(records: Iterable[PoseRecord], a: ReferencePoint, b: ReferencePoint) -> Iterator[PoseRecord]:
    """Yield records of poses of point ``a`` as those of point ``b``."""
    T = transform_between(a, b)
    remaining = iter(records)
    while some := tuple(itertools.islice(remaining, _RECORDS_PER_CHUNK)):
        yield from _some_records_at(some, T, b.name)


def _some_records_at(records: tuple[PoseRecord, ...], T: FloatArray, name: str) -> Iterator[PoseRecord]:
    numbers = np.array(
        [
            (
                *(record.position_m or (np.nan,) * 3),
                *(record.orientation_xyzw or (0.0, 0.0, 0.0, 1.0)),
                *(record.velocity_mps or (np.nan,) * 3),
                *(record.angular_velocity_radps or (np.nan,) * 3),
            )
            for record in records
        ]
    )
    arm_m, motion = _motion_at(T, *np.split(numbers, (3, 7, 10), axis=1))
    continuous = np.array([record.estimator == "continuous" for record in records])
    full = _recorded_covariance_at([record.covariance for record in records], arm_m, continuous)
    commons = [record.covariance_common for record in records]
    common = _recorded_covariance_at(commons, arm_m, np.zeros_like(continuous))
    for record, *moved, covariance, covariance_common in zip(
        records, *(values.tolist() for values in motion), full, common, strict=True
    ):
        old = (record.position_m, record.orientation_xyzw, record.velocity_mps, record.angular_velocity_radps)
        position, orientation, velocity, rate = (
            None if before is None or not math.isfinite(sum(after)) else tuple(after)
            for before, after in zip(old, moved, strict=True)
        )
        yield dataclasses.replace(
            record,
            child_frame=name,
            position_m=position,
            orientation_xyzw=orientation,
            velocity_mps=velocity,
            angular_velocity_radps=rate,
            covariance=covariance,
            covariance_common=covariance_common,
        )


def _motion_at(
    T: FloatArray, position: FloatArray, orientation: FloatArray, velocity: FloatArray, rate: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Return the lever arms, (N, 3) in the frame of the poses, and position, orientation, velocity and angular velocity."""
    rotation = rotation_from_quaternion(orientation)
    arm_m = rotate(rotation, T[:3, 3])
    turn = T[:3, :3]
    if not np.array_equal(turn, np.eye(3)):
        orientation = quaternion_from_rotation(rotation @ turn)
    velocity = velocity + rotate(rotation, rotate(skew(rate), T[:3, 3]))
    return arm_m, (position + arm_m, orientation, velocity, rotate(turn.T, rate))


def _covariance_at(covariance: FloatArray, arm_m: FloatArray, second_order: NDArray[np.bool_]) -> FloatArray:
    """Carry covariances, (N, 6, 6) with rotations about fixed axes, over lever arms, (N, 3) along the same axes.

    ``second_order``: (N,) whether they contain second-order terms, which depend on the point.
    """
    first_order = covariance.copy()
    first_order[second_order] -= _second_order(covariance[second_order])
    moved = covariance_over_lever_arm(first_order, arm_m)
    moved[second_order] += _second_order(moved[second_order])
    return moved


def _second_order(covariance: FloatArray) -> FloatArray:
    """Return the second-order terms; they depend on the blocks that they leave as they are, so they can be taken off again."""
    return with_second_order_terms(np.eye(3)[None], covariance)[0] - covariance


def _recorded_covariance_at(
    covariances: list[tuple[float, ...] | None], arm_m: FloatArray, second_order: NDArray[np.bool_]
) -> list[tuple[float, ...] | None]:
    moved: list[tuple[float, ...] | None] = [None] * len(covariances)
    rows = [row for row, each in enumerate(covariances) if each is not None]
    if rows:
        known = np.array([covariances[row] for row in rows]).reshape(-1, 6, 6)
        found = _covariance_at(known, arm_m[rows], second_order[rows]).reshape(-1, 36)
        for row, values in zip(rows, found.tolist(), strict=True):
            moved[row] = tuple(values)
    return moved


def parse_reference_point(text: str) -> ReferencePoint:
    """Parse ``X,Y,Z`` or ``NAME=X,Y,Z[,QX,QY,QZ,QW]``: metres and a quaternion in the robot frame.

    Without a name the point is called ``point``, the origin ``robot``. Raises ValueError with the reason.
    """
    name, separator, coordinates = text.rpartition("=")
    try:
        values = tuple(float(word) for word in coordinates.split(","))
    except ValueError:
        values = ()
    if len(values) not in (3, 7) or (separator and not name):
        raise ValueError(f"{text!r} is no point; expected X,Y,Z or NAME=X,Y,Z[,QX,QY,QZ,QW] in m")
    x, y, z = values[:3]
    qx, qy, qz, qw = values[3:] or (0.0, 0.0, 0.0, 1.0)
    if not separator:
        name = ROBOT_FRAME if (x, y, z, qx, qy, qz) == (0.0,) * 6 else "point"
    return ReferencePoint(name=name, position_m=(x, y, z), orientation_xyzw=(qx, qy, qz, qw))


def reference_point_text(point: ReferencePoint) -> str:
    """Return what :func:`parse_reference_point` parses, to the last bit."""
    return f"{point.name}={','.join(map(repr, (*point.position_m, *point.orientation_xyzw)))}"


def point_label(point: ReferencePoint) -> str:
    """Return the name of a point in a sentence or a table."""
    return "the robot's origin" if point.name == ROBOT_FRAME else point.name


def point_place(point: ReferencePoint) -> str:
    """Return where a point is in the robot frame, to the millimetre."""
    return "({}) m".format(", ".join(f"{round(value, 3) + 0.0:.10g}" for value in point.position_m))
