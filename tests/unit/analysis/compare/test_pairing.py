import dataclasses

import numpy as np
import pytest
from harness.drives.compared_drive import START_NS, estimate_at, reference, robot
from scipy.spatial.transform import Rotation

from tsgt.analysis.compare import Estimate, ReferencePoses, initial_relation, pair
from tsgt.analysis.compare.interpolation import ReferenceTrajectory
from tsgt.geometry import invert, quaternion_from_rotation, transform_from
from tsgt.model import ROBOT_ORIGIN

EXTRINSIC = transform_from(
    Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix(), np.array([0.3, -0.2, 0.8])
)
FRAME = transform_from(Rotation.from_euler("xyz", [0.1, 0.2, -1.5]).as_matrix(), np.array([30.0, -5.0, 2.0]))


def test_poses_between_those_of_an_accelerating_robot_are_right_to_micrometres() -> None:
    """A straight line would be off by 0.2 mm."""
    time_s = np.arange(0.2, 9.5, 0.0137)
    paired = pair(reference(), estimate_at(time_s), initial_relation())
    assert len(paired.row) == len(time_s)
    error = invert(paired.reference) @ paired.estimated
    assert np.abs(error[:, :3, 3]).max() < 2e-6
    assert np.abs(error[:, :3, :3] - np.eye(3)).max() < 5e-6


def test_motion_is_the_derivative_of_the_poses() -> None:
    """The oracle is the central difference."""
    trajectory = ReferenceTrajectory(reference())
    at_ns = START_NS + np.arange(1_013_000_000, 8_000_000_000, 97_000_000)
    step_ns = 100_000
    motion = trajectory.motion_at(at_ns)
    before, after = (trajectory.motion_at(at_ns + sign * step_ns) for sign in (-1, 1))
    seconds = 2 * step_ns / 1e9
    velocity = (after.position_m - before.position_m) / seconds
    turned = after.rotation @ np.swapaxes(before.rotation, 1, 2)
    rate = Rotation.from_matrix(turned).as_rotvec() / seconds
    np.testing.assert_allclose(motion.velocity_mps, velocity, atol=1e-7)
    np.testing.assert_allclose(motion.angular_velocity_radps, rate, atol=1e-7)


def test_relation_carries_the_estimate_to_the_sensor_of_the_reference() -> None:
    """The estimate is made from the truth by hand: another clock, frame, scale, and sensor."""
    true_s = np.arange(2.0, 8.0, 0.1)
    in_frame = invert(FRAME) @ robot(true_s) @ EXTRINSIC
    stamp_s = 2.0 + (true_s - 2.0) / (1 + 1e-4) - 0.75
    estimate = Estimate(
        name="lidar",
        stamp_ns=START_NS + np.rint(stamp_s * 1e9).astype(np.int64),
        position_m=in_frame[:, :3, 3] / 1.7,
        orientation_xyzw=quaternion_from_rotation(in_frame[:, :3, :3]),
        covariance=None,
    )
    relation = dataclasses.replace(
        initial_relation(),
        offset_s=0.75,
        skew=1e-4,
        T_point_sensor=EXTRINSIC,
        T_station1_frame=FRAME,
        scale=1.7,
    )
    paired = pair(reference(), estimate, relation)
    np.testing.assert_allclose(paired.estimated, paired.reference, atol=5e-6)


def test_positions_alone_take_the_rotation_of_the_reference() -> None:
    """So that a pose error of positions alone has no rotation."""
    paired = pair(
        reference(), estimate_at(np.arange(1.0, 2.0, 0.1), orientation_xyzw=None), initial_relation()
    )
    np.testing.assert_array_equal(paired.estimated[:, :3, :3], paired.reference[:, :3, :3])
    assert not paired.has_orientation


def test_nothing_is_paired_across_an_invalid_pose_or_a_gap() -> None:
    """Poses at the edges of a valid stretch are paired."""
    complete = reference()
    kept = np.ones(len(complete.stamp_ns), dtype=np.bool_)
    kept[40:45] = False  # 2.00 s to 2.20 s missing: a gap of 0.3 s
    valid = complete.valid.copy()
    valid[100] = False  # 5.00 s
    part = ReferencePoses(
        complete.stamp_ns[kept], complete.T_station1_point[kept], None, None, valid[kept], ROBOT_ORIGIN
    )
    time_s = np.array([-0.1, 1.95, 1.96, 2.24, 2.25, 4.95, 4.96, 5.0, 5.04, 5.05, 9.95, 9.96])
    paired = pair(part, estimate_at(time_s), initial_relation())
    np.testing.assert_allclose((paired.stamp_ns - START_NS) / 1e9, [1.95, 2.25, 4.95, 5.05, 9.95])
    assert (paired.n_estimate, paired.n_outside, paired.n_reference_gap) == (12, 2, 5)


def test_covariance_of_the_reference_is_carried_to_the_sensor() -> None:
    """The oracle displaces the pose by samples of the error."""
    made = reference(3.0)
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6)) * 1e-3
    covariance = np.broadcast_to(root @ root.T, (len(made.stamp_ns), 6, 6))
    relation = dataclasses.replace(initial_relation(), T_point_sensor=EXTRINSIC)
    paired = pair(dataclasses.replace(made, covariance=covariance), estimate_at(np.array([1.02])), relation)
    errors = rng.normal(size=(200_000, 6)) @ root.T
    point = robot(np.array([1.02]))[0]
    moved = (
        point[:3, 3]
        + errors[:, :3]
        + Rotation.from_rotvec(errors[:, 3:]).apply(point[:3, :3] @ EXTRINSIC[:3, 3])
    )
    assert paired.reference_covariance is not None
    np.testing.assert_allclose(paired.reference_covariance[0, :3, :3], np.cov(moved.T), atol=2e-7)


def test_weak_instants_of_the_reference_are_left_out_and_counted() -> None:
    """The limit is on the least certain direction."""
    made = reference(3.0)
    covariance = np.tile(np.eye(6) * 1e-6, (len(made.stamp_ns), 1, 1))
    covariance[made.stamp_ns > START_NS + 2_000_000_000, 2, 2] = 1e-2
    weak = dataclasses.replace(made, covariance=covariance)
    paired = pair(weak, estimate_at(np.arange(0.0, 2.9, 0.1)), initial_relation(), max_sigma_m=0.05)
    assert (len(paired.row), paired.n_reference_weak) == (21, 8)


def test_covariance_of_the_estimate_is_turned_and_scaled_with_it() -> None:
    """A quarter turn swaps x and y."""
    covariance = np.diag([4.0, 1.0, 1.0, 9.0, 1.0, 1.0])[None]
    quarter = transform_from(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.zeros(3))
    relation = dataclasses.replace(initial_relation(), T_station1_frame=quarter, scale=2.0)
    paired = pair(reference(), estimate_at(np.array([1.0]), covariance=covariance), relation)
    assert paired.estimate_covariance is not None
    np.testing.assert_allclose(np.diag(paired.estimate_covariance[0]), [4.0, 16.0, 4.0, 1.0, 9.0, 1.0])


@pytest.mark.parametrize("n", [0, 1])
def test_reference_of_less_than_two_valid_poses_pairs_nothing(n: int) -> None:
    """It covers no interval."""
    made = reference(1.0)
    valid = np.arange(len(made.stamp_ns)) < n
    paired = pair(
        dataclasses.replace(made, valid=valid), estimate_at(np.array([0.0, 0.01])), initial_relation()
    )
    assert len(paired.row) == 0
