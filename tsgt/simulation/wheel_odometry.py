"""Wheel odometry of the simulated robot: speed of its origin along its x axis, and its yaw rate, with scale error and slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from tsgt.geometry import rotate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from tsgt.simulation.rigid_motion import RigidMotion


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryModel:
    """Errors of wheels or tracks; one sigma. The defaults are assumptions: a robot on tracks, on firm ground."""

    rate_hz: float = 20.0
    scale_error: float = 0.01
    """Relative error of the scale, constant over a mission."""
    slip: float = 0.03
    """Slip in proportion to the speed: a Gauss-Markov process."""
    slip_correlation_time_s: float = 5.0
    speed_noise_mps: float = 0.01
    """White noise of a sample."""
    yaw_rate_noise_radps: float = 0.01
    """White noise of a sample; slip and scale of the yaw rate are drawn like those of the speed, but by themselves."""


@dataclass(frozen=True, slots=True)
class OdometrySamples:
    """N samples of wheel odometry; instantaneous values."""

    time_s: NDArray[np.float64]  # (N,) in s from the start of the mission
    speed_mps: NDArray[np.float64]  # (N,) of the robot's origin along its x axis, positive forwards
    yaw_rate_radps: NDArray[np.float64]  # (N,) about the robot's z axis, positive to the left
    true_speed_mps: NDArray[np.float64]  # (N,)
    true_yaw_rate_radps: NDArray[np.float64]  # (N,)


def simulate_odometry(
    model: OdometryModel,
    motion_at: Callable[[NDArray[np.float64]], RigidMotion],
    until_s: float,
    *,
    seed: Sequence[int],
) -> OdometrySamples:
    """Simulate wheel odometry from the start of a mission to ``until_s``; ``motion_at`` covers this time."""
    rng = np.random.default_rng([*seed, 0x0D])
    time_s = np.arange(rng.uniform(0.0, 1.0 / model.rate_hz), until_s, 1.0 / model.rate_hz)
    motion = motion_at(time_s)
    speed = rotate(np.swapaxes(motion.rotation, 1, 2), motion.velocity_mps)[:, 0]
    yaw_rate = motion.angular_rate_radps[:, 2]
    scale = 1.0 + rng.normal(0.0, model.scale_error, 2) + _gauss_markov(model, len(time_s), rng)
    noise = rng.standard_normal((2, len(time_s)))
    return OdometrySamples(
        time_s,
        scale[:, 0] * speed + model.speed_noise_mps * noise[0],
        scale[:, 1] * yaw_rate + model.yaw_rate_noise_radps * noise[1],
        speed,
        yaw_rate,
    )


def _gauss_markov(model: OdometryModel, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Two stationary first-order Gauss-Markov processes with the slip's sigma, (count, 2)."""
    kept = np.exp(-1.0 / (model.rate_hz * model.slip_correlation_time_s))
    steps = rng.standard_normal((count, 2)) * np.sqrt(1.0 - kept**2)
    steps[:1] /= np.sqrt(1.0 - kept**2)
    slip: NDArray[np.float64] = model.slip * lfilter([1.0], [1.0, -kept], steps, axis=0)
    return slip
