"""Mathematics of rigid bodies and polar measurements; sans-I/O, numpy and scipy only.

In: polar measurements, station frames, prism layouts. Out: transforms, registered point sets, poses with covariances,
interpolated tracks. Conventions: docs/explanation/conventions.md. Whatever lies between measurement and pose gives the same
bits for an item alone as in a batch: live stream, replay and post-processing agree exactly.
"""

from tsgt.geometry.alignment import BatchAlignment, align, align_many, align_triplets
from tsgt.geometry.euler import euler_angles_rad, euler_covariance, euler_jacobian
from tsgt.geometry.fit_consistency import covariance_scale, squared_misfit
from tsgt.geometry.interpolation import (
    NO_GAP_NS,
    Interpolated,
    interpolate,
    interpolate_prisms,
    interpolated_covariance,
    interpolation_error_s2,
)
from tsgt.geometry.polar import (
    cartesian_to_polar,
    corrected_angles,
    corrected_distance,
    measurement_covariance,
    polar_to_cartesian,
    raw_distance,
)
from tsgt.geometry.pose import (
    check_layout,
    covariance_over_lever_arm,
    interpolation_errors,
    pose_covariance,
    pose_displacement,
    poses_from_prisms,
    twists,
)
from tsgt.geometry.rigid import (
    FloatArray,
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

__all__ = [
    "NO_GAP_NS",
    "BatchAlignment",
    "FloatArray",
    "Interpolated",
    "align",
    "align_many",
    "align_triplets",
    "cartesian_to_polar",
    "check_layout",
    "corrected_angles",
    "corrected_distance",
    "covariance_over_lever_arm",
    "covariance_scale",
    "euler_angles_rad",
    "euler_covariance",
    "euler_jacobian",
    "exp_so3",
    "interpolate",
    "interpolate_prisms",
    "interpolated_covariance",
    "interpolation_error_s2",
    "interpolation_errors",
    "invert",
    "log_so3",
    "measurement_covariance",
    "polar_to_cartesian",
    "pose_covariance",
    "pose_displacement",
    "poses_from_prisms",
    "quaternion_from_rotation",
    "raw_distance",
    "rotate",
    "rotation_from_quaternion",
    "skew",
    "squared_misfit",
    "transform_from",
    "transform_points",
    "twists",
]
