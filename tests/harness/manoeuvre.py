"""Robots that do the hardest thing that the robot of the scenario `dynamic` does, at a given instant."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from harness.prior_motion import PLACE_M, STEP_S
from scipy.stats import norm

from tsgt.geometry import exp_so3
from tsgt.geometry.trajectory import States

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

SMOOTHING_S = 0.35
"""Commands are smoothed by a Gaussian of this sigma."""


def speeding_up_and_turning_back(
    *, duration_s: float, at_s: float, speeds_mps: tuple[float, float], rates_radps: tuple[float, float]
) -> States:
    """Return the motion, on a grid of ``STEP_S``, of a level robot that is told another speed and yaw rate at an instant."""
    time_s = np.arange(round(duration_s / STEP_S) + 1, dtype=np.float64) * STEP_S
    told: FloatArray = norm.cdf(time_s, at_s, SMOOTHING_S)
    speed = speeds_mps[0] + (speeds_mps[1] - speeds_mps[0]) * told
    rate = rates_radps[0] + (rates_radps[1] - rates_radps[0]) * told
    yaw = np.cumsum(rate) * STEP_S
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])
    about_z = np.array([0.0, 0.0, 1.0])
    velocity, angular_velocity = speed[:, None] * ahead, rate[:, None] * about_z
    return States(
        time_s,
        PLACE_M + np.cumsum(velocity, axis=0) * STEP_S,
        exp_so3(yaw[:, None] * about_z),
        velocity,
        angular_velocity,
        np.gradient(velocity, STEP_S, axis=0),
        np.gradient(angular_velocity, STEP_S, axis=0),
    )
