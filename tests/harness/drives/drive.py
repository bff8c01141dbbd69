"""A synthetic drive of a robot on a winding path over uneven ground, tracked by three stations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import exp_so3, rotate
from tsgt.geometry.trajectory import Observations
from tsgt.geometry.trajectory.measurement_factors import line_of_sight_axes
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])
MOTION_PRIOR = MotionPrior(
    acceleration_sigma_mps2=(0.4, 0.4, 0.1), angular_acceleration_sigma_radps2=(0.05, 0.05, 0.15)
)


def frames() -> FloatArray:
    """Three stations near each other."""
    found = np.tile(np.eye(4), (3, 1, 1))
    for station, (heading, place) in enumerate(
        [(0.0, (0, 0, 0)), (0.6, (2.0, -1.5, 0.1)), (-1.2, (-1.5, 2.5, -0.2))]
    ):
        found[station, :3, :3] = exp_so3(np.array([0.0, 0.0, heading]))
        found[station, :3, 3] = place
    return found


def drive(
    duration_s: float = 120.0, *, seed: int = 0, straight: bool = False, still: bool = False
) -> Observations:
    """Tracks of a robot on a winding path over uneven ground, 40 m away, with the stated noise."""
    rng = np.random.default_rng(seed)
    time_s = np.concatenate([np.arange(0.13 * station, duration_s, 0.4) for station in range(3)])
    station = np.concatenate([np.full(len(np.arange(0.13 * s, duration_s, 0.4)), s) for s in range(3)])
    order = np.argsort(time_s, kind="stable")
    time_s, station = time_s[order], station[order]
    if still:
        position, turn = np.tile([40.0, 10.0, -1.0], (len(time_s), 1)), np.zeros((len(time_s), 3))
    elif straight:
        position = np.stack(
            [20 + 0.5 * time_s, np.full_like(time_s, 10.0), np.full_like(time_s, -1.0)], axis=1
        )
        turn = np.zeros((len(time_s), 3))
    else:
        around = 0.1 * time_s
        position = np.stack(
            [40 + 12 * np.sin(around), 10 + 8 * np.sin(2 * around), -1 + 0.5 * np.sin(3.1 * around)], axis=1
        )
        heading = np.unwrap(np.arctan2(16 * np.cos(2 * around), 12 * np.cos(around)))
        turn = np.stack([0.05 * np.sin(5 * around), 0.05 * np.cos(4 * around), heading], axis=1)
    rotation = exp_so3(np.stack([0 * time_s, 0 * time_s, turn[:, 2]], axis=1)) @ exp_so3(turn * [1, 1, 0])
    seen = frames()[station]
    world = position + rotate(rotation, LAYOUT[station])
    points = rotate(np.swapaxes(seen[:, :3, :3], 1, 2), world - seen[:, :3, 3])
    axes, _ = line_of_sight_axes(points)
    sigmas = np.tile([0.002, 0.001, 0.001], (len(points), 1))
    points = points + rotate(np.swapaxes(axes, 1, 2), rng.normal(size=points.shape) * sigmas)
    everything = np.ones(len(points), np.bool_)
    return Observations(
        time_s, np.zeros(len(points)), points, sigmas, everything, station, station, frames(), LAYOUT
    )
