"""Bit-identity: stream, replay and post-processing compute in batches of different sizes and must agree exactly."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.geometry import (
    interpolate,
    interpolated_covariance,
    interpolation_error_s2,
    interpolation_errors,
    measurement_covariance,
    polar_to_cartesian,
    pose_covariance,
    pose_displacement,
    poses_from_prisms,
    quaternion_from_rotation,
    squared_misfit,
    transform_from,
    transform_points,
    twists,
)
from tsgt.model import TRACKING_NOISE

if TYPE_CHECKING:
    from collections.abc import Callable

N = 1000
RNG = np.random.default_rng(1)
LAYOUT = RNG.normal(size=(9, 3))
ROTATIONS = Rotation.random(N, random_state=2).as_matrix()
PRISMS = (
    LAYOUT @ np.swapaxes(ROTATIONS, 1, 2)
    + RNG.normal(scale=50, size=(N, 1, 3))
    + RNG.normal(size=(N, 9, 3)) / 99
)
VELOCITIES = RNG.normal(size=(N, 9, 3))
FACTORS = RNG.normal(size=(N, 9, 3, 3)) / 999
COVARIANCES = FACTORS @ np.swapaxes(FACTORS, 2, 3)
POLAR = RNG.uniform((0, 0.1, 1), (6.3, 3.0, 900), size=(N, 3))
TIMES_NS = 1_647_269_269_671_000_000 + np.cumsum(RNG.integers(1, 800_000_000, N))
EPOCHS_NS = np.sort(RNG.integers(TIMES_NS[0] - 10**9, TIMES_NS[-1] + 10**9, N))
T_WORLD = transform_from(ROTATIONS[0], np.array([1.0, 2.0, 3.0]))

Items = slice
Results = tuple[np.ndarray, ...]


def pose_quantities(count: int) -> Callable[[Items], Results]:
    """All quantities of a pose record from a number of prisms."""
    layout = LAYOUT[:count]

    def compute(items: Items) -> Results:
        poses = poses_from_prisms(layout, PRISMS[items, :count])
        common_errors = interpolation_errors(
            layout,
            poses.rotation,
            np.abs(VELOCITIES[items, :count, 0]),
            acceleration_sigma_mps2=0.3,
            angular_acceleration_sigma_radps2=0.2,
        )
        return (
            poses.rotation,
            poses.translation_m,
            poses.residuals_m,
            poses.rms_m,
            quaternion_from_rotation(poses.rotation),
            pose_covariance(layout, poses.rotation, COVARIANCES[items, :count]),
            *twists(layout, poses.rotation, VELOCITIES[items, :count]),
            common_errors,
            pose_displacement(layout, poses.rotation, common_errors),
            squared_misfit(
                layout,
                poses.rotation,
                poses.translation_m,
                PRISMS[items, :count],
                COVARIANCES[items, :count],
                common_errors,
            )[0],
        )

    return compute


def measured_points(items: Items) -> Results:
    """Positions and their covariances in the world from polar measurements."""
    horizontal_rad, zenith_rad, distance_m = POLAR[items].T
    points = polar_to_cartesian(horizontal_rad, zenith_rad, distance_m)
    covariances = measurement_covariance(horizontal_rad, zenith_rad, distance_m, TRACKING_NOISE)
    R = T_WORLD[:3, :3]
    return transform_points(T_WORLD, points), R @ covariances @ R.T


def interpolated_track(items: Items) -> Results:
    """One prism at the epochs, with its covariance."""
    found = interpolate(TIMES_NS, PRISMS[:, 0], EPOCHS_NS[items], 10**9)
    covariance = interpolated_covariance(
        COVARIANCES[found.after % N, 0], COVARIANCES[found.after - 1, 1], found.fraction
    )
    unseen = interpolation_error_s2(found.fraction, found.gap_ns)
    return found.points, found.velocities_mps, found.fraction, covariance, unseen


@pytest.mark.parametrize(
    "compute",
    [measured_points, interpolated_track, pose_quantities(3), pose_quantities(4), pose_quantities(9)],
    ids=["measured", "interpolated", "three", "four", "nine"],
)
@pytest.mark.parametrize("split", ["one by one", "at random"])
@pytest.mark.slow
def test_batches_agree_bit_for_bit(compute: Callable[[Items], Results], split: str) -> None:
    """A thousand items at once, one by one, and in batches of random sizes give the same bits."""
    cuts = (
        range(N + 1)
        if split == "one by one"
        else [0, *np.sort(np.random.default_rng(3).choice(N, 30)).tolist(), N]
    )
    parts = [compute(slice(a, b)) for a, b in pairwise(cuts)]
    for together, separate in zip(compute(slice(0, N)), zip(*parts, strict=True), strict=True):
        assert together.tobytes() == np.concatenate(separate).tobytes()
