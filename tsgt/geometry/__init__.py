"""Geometry of prisms on a rigid robot, seen by total stations. numpy and scipy only.

Conventions (docs/explanation/conventions.md): SI units and radians, times in integer nanoseconds; ``T_a_b`` maps
coordinates in frame b to frame a; quaternions are x, y, z, w with w >= 0; a pose covariance is 6x6 of
(x, y, z, rotation about the fixed axes x, y, z) in the frame of the pose. Arrays are float64 and functions broadcast
over leading dimensions.

What lies on the way from measurement to pose gives the same bits for an item alone as for the same item in a batch,
so that a live stream, its replay and later processing agree exactly.
"""

from tsgt.geometry.alignment import Alignment, BatchAlignment, align, align_many, align_triplets
from tsgt.geometry.interpolation import (
    NO_GAP_NS,
    Interpolated,
    interpolate,
    interpolate_prisms,
    interpolated_covariance,
    unseen_s2,
)
from tsgt.geometry.polar import (
    cartesian_jacobian,
    cartesian_to_polar,
    corrected_distance,
    measurement_covariance,
    polar_jacobian,
    polar_to_cartesian,
    raw_distance,
)
from tsgt.geometry.pose import (
    Poses,
    check_layout,
    pose_covariance,
    poses_from_prisms,
    twists,
    unseen_motion_covariance,
)
from tsgt.geometry.rigid import (
    FloatArray,
    check_transform,
    exp_so3,
    invert,
    log_so3,
    quaternion_from_rotation,
    rotate,
    rotation_from_quaternion,
    skew,
    transform_from,
    transform_points,
)
from tsgt.geometry.trajectory.fixed_lag import FixedLag
from tsgt.geometry.trajectory.measurement_factors import Observations
from tsgt.geometry.trajectory.query import Trajectory, of_point, ros_covariance, with_curvature
from tsgt.geometry.trajectory.states import Knots, joined

__all__ = [
    "NO_GAP_NS",
    "Alignment",
    "BatchAlignment",
    "FixedLag",
    "FloatArray",
    "Interpolated",
    "Knots",
    "Observations",
    "Poses",
    "Trajectory",
    "align",
    "align_many",
    "align_triplets",
    "cartesian_jacobian",
    "cartesian_to_polar",
    "check_layout",
    "check_transform",
    "corrected_distance",
    "exp_so3",
    "interpolate",
    "interpolate_prisms",
    "interpolated_covariance",
    "invert",
    "joined",
    "log_so3",
    "measurement_covariance",
    "of_point",
    "polar_jacobian",
    "polar_to_cartesian",
    "pose_covariance",
    "poses_from_prisms",
    "quaternion_from_rotation",
    "raw_distance",
    "ros_covariance",
    "rotate",
    "rotation_from_quaternion",
    "skew",
    "transform_from",
    "transform_points",
    "twists",
    "unseen_motion_covariance",
    "unseen_s2",
    "with_curvature",
]
