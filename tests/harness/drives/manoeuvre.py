"""Abrupt manoeuvres: the hardest motion of the scenario `dynamic`, at a given time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from harness.drives.prior_motion import CENTRE_M, STEP_S
from scipy.stats import norm

from tsgt.geometry import exp_so3
from tsgt.geometry.trajectory import States

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

SMOOTHING_S = 0.35
"""Sigma of the Gaussian that smooths commands."""


def speeding_up_and_turning_back(
    *, duration_s: float, at_s: float, speeds_mps: tuple[float, float], rates_radps: tuple[float, float]
) -> States:
    """Motion, on a grid of ``STEP_S``, of a level robot whose commanded speed and yaw rate step at a time."""
    time_s = np.arange(round(duration_s / STEP_S) + 1, dtype=np.float64) * STEP_S
    step_response: FloatArray = norm.cdf(time_s, at_s, SMOOTHING_S)
    speed = speeds_mps[0] + (speeds_mps[1] - speeds_mps[0]) * step_response
    rate = rates_radps[0] + (rates_radps[1] - rates_radps[0]) * step_response
    yaw = np.cumsum(rate) * STEP_S
    heading = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])
    about_z = np.array([0.0, 0.0, 1.0])
    velocity, angular_velocity = speed[:, None] * heading, rate[:, None] * about_z
    return States(
        time_s,
        CENTRE_M + np.cumsum(velocity, axis=0) * STEP_S,
        exp_so3(yaw[:, None] * about_z),
        velocity,
        angular_velocity,
        np.gradient(velocity, STEP_S, axis=0),
        np.gradient(angular_velocity, STEP_S, axis=0),
    )
