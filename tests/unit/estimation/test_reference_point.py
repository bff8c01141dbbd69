"""Poses of other points of the robot."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from harness.drives.scene import LAYOUT, stationary_scene

from tsgt.estimation import (
    Kind,
    LiveEstimator,
    PoseBatch,
    centroid_at_point,
    centroid_point,
    parse_reference_point,
    poses_at,
    records_at,
    reference_point_text,
    transform_of,
)
from tsgt.geometry import exp_so3, log_so3, quaternion_from_rotation, rotation_from_quaternion
from tsgt.geometry.trajectory import with_second_order_terms
from tsgt.model import ROBOT_ORIGIN, ReferencePoint

LIDAR = ReferencePoint(
    name="lidar", position_m=(0.8, -0.3, 1.4), orientation_xyzw=(0.0, 0.0, np.sin(0.4), np.cos(0.4))
)
STEP_S = 1e-4


def _pose(time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and position of a robot that tumbles."""
    rotation = exp_so3(np.stack([0.3 * np.sin(time_s), 0.2 * np.cos(2 * time_s), 0.5 * time_s], axis=-1))
    return rotation, np.stack([3 * np.sin(time_s), time_s**2, 0.1 * time_s], axis=-1)


def _rates(time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity, and angular velocity in the robot frame, by central differences."""
    (later, p_later), (earlier, p_earlier) = _pose(time_s + STEP_S), _pose(time_s - STEP_S)
    turn = np.swapaxes(earlier, 1, 2) @ later
    return (p_later - p_earlier) / (2 * STEP_S), log_so3(turn) / (2 * STEP_S)


def _covariance(seed: int, n: int, rotation_sigma_rad: float = 0.01) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(n, 6, 6)) * ([[0.01]] * 3 + [[rotation_sigma_rad]] * 3)
    return np.asarray(root @ np.swapaxes(root, 1, 2))


def _batch(n: int = 5, kind: Kind = Kind.INTERPOLATED, rotation_sigma_rad: float = 0.01) -> PoseBatch:
    time_s = np.linspace(0.0, 2.0, n)
    rotation, position = _pose(time_s)
    velocity, rate = _rates(time_s)
    batch = PoseBatch.blank((1e9 * time_s).astype(np.int64) + 1, (1, 2, 3), kind)
    return dataclasses.replace(
        batch,
        position_m=position,
        orientation_xyzw=quaternion_from_rotation(rotation),
        velocity_mps=velocity,
        angular_velocity_radps=rate,
        covariance=_covariance(1, n, rotation_sigma_rad),
    )


def test_motion_is_that_of_the_point() -> None:
    """Pose by the composition of transforms; velocities are its derivatives."""
    found = poses_at(_batch(), LIDAR)
    T, time_s = transform_of(LIDAR), np.linspace(0.0, 2.0, 5)

    def of_point(time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rotation, position = _pose(time_s)
        return rotation @ T[:3, :3], position + rotation @ T[:3, 3]

    rotation, position = of_point(time_s)
    (later, p_later), (earlier, p_earlier) = of_point(time_s + STEP_S), of_point(time_s - STEP_S)
    rate = log_so3(np.swapaxes(earlier, 1, 2) @ later) / (2 * STEP_S)
    np.testing.assert_allclose(found.position_m, position, atol=1e-12)
    np.testing.assert_allclose(rotation_from_quaternion(found.orientation_xyzw), rotation, atol=1e-12)
    np.testing.assert_allclose(found.velocity_mps, (p_later - p_earlier) / (2 * STEP_S), atol=1e-7)
    np.testing.assert_allclose(found.angular_velocity_radps, rate, atol=1e-7)


def test_covariance_of_linear_is_of_first_order() -> None:
    """By the numerical Jacobian of the point's pose by errors about fixed axes."""
    batch = _batch()
    rotation, T = rotation_from_quaternion(batch.orientation_xyzw), transform_of(LIDAR)
    step = 1e-6
    columns = []
    for axis in range(6):
        error = np.zeros(6)
        error[axis] = step
        turned = exp_so3(error[3:]) @ rotation
        shift = error[:3] + (turned - rotation) @ T[:3, 3]
        turn = log_so3((turned @ T[:3, :3]) @ np.swapaxes(rotation @ T[:3, :3], 1, 2))
        columns.append(np.concatenate([shift, turn], axis=1) / step)
    jacobian = np.stack(columns, axis=-1)
    expected = jacobian @ batch.covariance @ np.swapaxes(jacobian, 1, 2)
    np.testing.assert_allclose(poses_at(batch, LIDAR).covariance, expected, rtol=1e-4, atol=1e-9)


def test_second_order_terms_are_those_of_the_point() -> None:
    """A covariance of the origin with its second-order terms becomes that of the point with the point's."""
    first_order = _covariance(2, 5, rotation_sigma_rad=0.1)
    batch = _batch(kind=Kind.SMOOTHED)
    at_origin = with_second_order_terms(np.eye(3)[None], first_order)[0]
    arm = rotation_from_quaternion(batch.orientation_xyzw) @ np.array(LIDAR.position_m)
    by_error = np.tile(np.eye(6), (5, 1, 1))
    for row, (x, y, z) in enumerate(arm):
        by_error[row, :3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    moved = by_error @ first_order @ np.swapaxes(by_error, 1, 2)
    expected = with_second_order_terms(np.eye(3)[None], moved)[0]
    found = poses_at(dataclasses.replace(batch, covariance=at_origin), LIDAR).covariance
    assert np.abs(expected - moved).max() > 1e-4
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", [Kind.INTERPOLATED, Kind.SMOOTHED])
def test_there_and_back_is_the_same(kind: Kind) -> None:
    """Nothing is lost by a change of the point."""
    batch = _batch(kind=kind)
    back = poses_at(poses_at(batch, LIDAR), ROBOT_ORIGIN)
    for name in ("position_m", "orientation_xyzw", "velocity_mps", "angular_velocity_radps", "covariance"):
        np.testing.assert_allclose(getattr(back, name), getattr(batch, name), atol=1e-12)


@pytest.mark.parametrize("kind", [Kind.INTERPOLATED, Kind.PREDICTED])
def test_a_pose_alone_has_the_same_bits(kind: Kind) -> None:
    """A replay asks for poses in other groups than the live stream did."""
    batch = _batch(n=7, kind=kind)
    together = poses_at(batch, LIDAR)
    for row in range(7):
        alone = poses_at(batch.select(np.arange(7) == row), LIDAR)
        for name in ("position_m", "orientation_xyzw", "velocity_mps", "covariance"):
            assert np.array_equal(getattr(alone, name)[0], getattr(together, name)[row])


def test_poses_that_are_not_computed_stay_so() -> None:
    """NaN in, NaN out; the others are carried over."""
    batch = _batch()
    for name in ("position_m", "orientation_xyzw", "velocity_mps", "angular_velocity_radps", "covariance"):
        getattr(batch, name)[2] = np.nan
    found = poses_at(batch, LIDAR)
    assert np.isfinite(found.covariance).all(axis=(1, 2)).tolist() == [True, True, False, True, True]
    assert [record.position_m is None for record in found.records()] == [False, False, True, False, False]


@pytest.mark.parametrize("kind", [Kind.INTERPOLATED, Kind.SMOOTHED])
def test_records_are_carried_over_as_arrays_are(kind: Kind) -> None:
    """Records of the origin become those that an estimator would have made for the point."""
    batch = _batch(kind=kind)
    batch.position_m[1] = np.nan
    batch.covariance_common[:4] = 0.5 * batch.covariance[:4]
    found = list(records_at(batch.records(), ROBOT_ORIGIN, LIDAR))
    expected = list(poses_at(batch, LIDAR).records())
    assert [record.child_frame for record in found] == ["lidar"] * 5
    assert found == expected


def test_common_part_is_carried_over_to_first_order() -> None:
    """As the covariance of linear, which has no second-order terms either."""
    (record,) = _batch(n=1, kind=Kind.SMOOTHED).records()
    record = dataclasses.replace(record, covariance_common=record.covariance)
    (moved,) = records_at([record], ROBOT_ORIGIN, LIDAR)
    expected = poses_at(_batch(n=1), LIDAR).covariance.ravel()
    assert moved.covariance_common is not None
    np.testing.assert_allclose(moved.covariance_common, expected, atol=1e-15)


def test_centroid_in_the_frame_of_the_point() -> None:
    """The centroid of the layout, by the inverse transform."""
    found = dataclasses.replace(stationary_scene().parameters, reference_point=LIDAR)
    expected = np.linalg.inv(transform_of(LIDAR)) @ [*LAYOUT.mean(axis=0), 1.0]
    np.testing.assert_allclose(centroid_at_point(found), expected[:3], atol=1e-12)
    np.testing.assert_allclose(centroid_point(found).position_m, LAYOUT.mean(axis=0))


@pytest.mark.parametrize("estimator", ["linear", "continuous"])
def test_estimators_state_the_pose_of_the_reference_point(estimator: str) -> None:
    """A pose of a resting robot is that of the scene, composed with the point."""
    scene = stationary_scene().with_limits(estimator=estimator)
    live = LiveEstimator(dataclasses.replace(scene.parameters, reference_point=LIDAR))
    times = [(station, 0.4 * tick + 0.1 * station) for tick in range(6) for station in (1, 2, 3)]
    records = [
        record for station, time_s in times for record in live.measurement(scene.measure(station, time_s))
    ]
    poses = [record for record in records if record.type == "pose" and record.position_m is not None]
    rotation, position = scene.motion(0.0)
    T = transform_of(LIDAR)
    assert {pose.child_frame for pose in records if pose.type == "pose"} == {"lidar"}
    assert len(poses) > 5
    np.testing.assert_allclose(np.array(poses[-1].position_m), position + rotation @ T[:3, 3], atol=1e-3)
    found = rotation_from_quaternion(np.array(poses[-1].orientation_xyzw))
    np.testing.assert_allclose(found, rotation @ T[:3, :3], atol=1e-3)


@pytest.mark.parametrize(
    ("text", "name", "position_m"),
    [
        ("1,2,3", "point", (1.0, 2.0, 3.0)),
        ("0,0,0", "robot", (0.0, 0.0, 0.0)),
        ("imu=0.1,0,-0.2", "imu", (0.1, 0.0, -0.2)),
        ("os0/lidar=0.1,0,1e-3,0,0,0.6,0.8", "os0/lidar", (0.1, 0.0, 0.001)),
    ],
)
def test_points_are_parsed_and_written_alike(text: str, name: str, position_m: tuple[float, ...]) -> None:
    """What is written is what is parsed."""
    point = parse_reference_point(text)
    assert (point.name, point.position_m) == (name, position_m)
    assert parse_reference_point(reference_point_text(point)) == point


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2", "expected X,Y,Z or NAME"),
        ("=1,2,3", "expected X,Y,Z or NAME"),
        ("a,b,c", "expected X,Y,Z or NAME"),
        ("nan,0,0", "position_m"),
        ("imu=1,2,3,0,0,0,2", "unit quaternion"),
        ("robot=1,2,3", "the robot frame itself"),
        ("station1=1,2,3", "another frame"),
        ("my sensor=1,2,3", "expected a letter"),
    ],
)
def test_impossible_points_are_rejected(text: str, message: str) -> None:
    """With the reason."""
    with pytest.raises(ValueError, match=message):
        parse_reference_point(text)
