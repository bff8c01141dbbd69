"""Motions drawn from the motion prior, and their measurements; independent of the estimator's code."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from harness.drives.scene import FRAMES, LAYOUT
from scipy.signal import lfilter

from tsgt.geometry import cartesian_to_polar, exp_so3, invert, polar_to_cartesian, transform_points
from tsgt.geometry.trajectory import Observations, States

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.model import MotionPrior

STEP_S = 0.005
SIGMAS_M = np.array([0.0025, 0.0012, 0.0012])
TIME_SIGMA_S = 0.0005
CENTRE_M = np.array([60.0, 45.0, -1.0])


def draw_motions(prior: MotionPrior, *, count: int, duration_s: float, seed: int) -> list[States]:
    """Draw motions from the prior on a grid of ``STEP_S``, at random positions and attitudes.

    The accelerations at the grid are exact draws of the process; between them they are linear, and rotations are multiplied step
    by step.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(round(duration_s / STEP_S) + 1, dtype=np.float64) * STEP_S
    parts = []
    for sigmas, time_s in (
        (prior.acceleration_sigma_mps2, prior.acceleration_correlation_time_s),
        (prior.angular_acceleration_sigma_radps2, prior.angular_acceleration_correlation_time_s),
    ):
        decay = np.exp(-STEP_S / time_s)
        noise = rng.normal(size=(count, len(times), 3))
        noise[:, 1:] *= np.sqrt(1 - decay**2)
        parts.append(np.array(sigmas) * lfilter([1.0], [1.0, -decay], noise, axis=1))
    acceleration, angular_acceleration = parts
    velocity = _integrate(acceleration) + rng.normal(size=(count, 1, 3))
    position = _integrate(velocity) + CENTRE_M + rng.normal(size=(count, 1, 3))
    angular_velocity = _integrate(angular_acceleration) + rng.normal(scale=0.2, size=(count, 1, 3))
    rotation = np.empty((count, len(times), 3, 3))
    rotation[:, 0] = exp_so3(rng.normal(scale=2.0, size=(count, 3)))
    turns = exp_so3(0.5 * STEP_S * (angular_velocity[:, 1:] + angular_velocity[:, :-1]))
    for step in range(len(times) - 1):
        rotation[:, step + 1] = rotation[:, step] @ turns[:, step]
    return [
        States(
            times,
            *(part[i] for part in (position, rotation, velocity, angular_velocity)),
            *(part[i] for part in parts),
        )
        for i in range(count)
    ]


def rows_at(time_s: FloatArray) -> NDArray[np.intp]:
    """Rows of a drawn motion at these times."""
    return np.round(np.asarray(time_s) / STEP_S).astype(np.intp)


def measure(motion: States, *, until_s: float, rate_hz: float = 2.5, seed: int) -> Observations:
    """Measure each prism by its own station, with noise in range, both angles and time."""
    rng = np.random.default_rng(seed)
    times: list[FloatArray] = []
    which: list[NDArray[np.intp]] = []
    for row in range(len(LAYOUT)):
        phase_s = rng.uniform(0, 1 / rate_hz)
        prism_times = np.arange(phase_s, until_s, 1 / rate_hz)
        times.append(np.round(prism_times / STEP_S) * STEP_S)
        which.append(np.full(len(prism_times), row))
    time_s, prism = np.concatenate(times), np.concatenate(which)
    order = np.argsort(time_s, kind="stable")
    time_s, prism = time_s[order], prism[order]
    truth = motion.select(rows_at(time_s))
    world = truth.position + (truth.rotation @ LAYOUT[prism][:, :, None])[:, :, 0]
    in_station = transform_points(invert(FRAMES)[prism], world)
    noisy = add_polar_noise(in_station, SIGMAS_M, rng)
    count = len(time_s)
    return Observations(
        time_s=time_s + rng.normal(scale=TIME_SIGMA_S, size=count),
        time_sigma_s=np.full(count, TIME_SIGMA_S),
        points_m=noisy,
        sigmas_m=np.tile(SIGMAS_M, (count, 1)),
        polar=np.ones(count, dtype=bool),
        station=prism,
        prism=prism,
        frames=FRAMES,
        layout=LAYOUT,
    )


def sorted_by_time(observations: Observations) -> Observations:
    """Sort measurements by time: noisy timestamps may be out of order."""
    return observations.select(np.argsort(observations.time_s, kind="stable"))


def add_polar_noise(points_m: FloatArray, sigmas_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Add noise in range and both angles, given as lengths at the point."""
    horizontal_rad, zenith_rad, distance_m = cartesian_to_polar(points_m)
    noise = rng.normal(size=(len(points_m), 3)) * sigmas_m
    return polar_to_cartesian(
        horizontal_rad + noise[:, 1] / (distance_m * np.sin(zenith_rad)),
        zenith_rad + noise[:, 2] / distance_m,
        distance_m + noise[:, 0],
    )


def as_cartesian(observations: Observations) -> Observations:
    """Take the measurements as Cartesian points in frame ``station1`` with isotropic noise."""
    return replace(
        observations,
        points_m=observations.in_world(),
        sigmas_m=np.full((len(observations), 3), SIGMAS_M[0]),
        polar=np.zeros(len(observations), dtype=bool),
        station=np.full(len(observations), len(FRAMES)),
        frames=np.concatenate([FRAMES, np.eye(4)[None]]),
    )


def _integrate(rates: FloatArray) -> FloatArray:
    means = 0.5 * STEP_S * (rates[:, 1:] + rates[:, :-1])
    return np.concatenate([np.zeros_like(rates[:, :1]), np.cumsum(means, axis=1)], axis=1)
