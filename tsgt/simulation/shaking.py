"""Shaking of a driving robot by its engine, tracks or wheels: faster than its stations measure, but not than its IMU.

Displacement and rotation are band-limited noise whose acceleration and angular rate have a flat spectrum. They scale with
the speed up to half a metre per second, and are part of the ground truth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from tsgt.simulation.rigid_motion import RigidMotion, euler_rates, rotation_from_euler

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.config import ShakingConfig

STEP_S = 0.001
"""Interval of the spline's knots: at 60 Hz its second derivative is within 1.2 % of that of the noise."""

PERIOD_S = 32.768
"""The noise repeats after this time, which bounds memory; the robot's speed, which scales it, does not."""

FULL_SPEED_MPS = 0.5
"""Speed from which the shaking has its full size."""


class Shaking:
    """Shaking about a point of the robot: displacement in m and yaw, pitch, roll in rad, along and about the robot's axes.

    Parameters
    ----------
    pivot_m
        The point that has the configured acceleration and about which the rotation turns, (3,) in frame ``robot``.
    times_s, speed_mps
        Speed of the robot on a grid, (N,) each.
    """

    def __init__(
        self,
        config: ShakingConfig,
        pivot_m: NDArray[np.float64],
        times_s: NDArray[np.float64],
        speed_mps: NDArray[np.float64],
        generator: np.random.Generator,
    ) -> None:
        self.pivot_m = pivot_m
        self._noise = CubicSpline(*_periodic_noise(config, generator), bc_type="periodic")
        self._size = CubicSpline(times_s, np.minimum(1.0, speed_mps / FULL_SPEED_MPS))

    def at(self, times_s: NDArray[np.float64], derivative: int = 0) -> NDArray[np.float64]:
        """Return displacement and angles at N instants, (N, 6), or their first or second derivative."""
        folded_s = np.mod(times_s, PERIOD_S)
        noise = [self._noise(folded_s, order) for order in range(derivative + 1)]
        size = [self._size(times_s, order)[:, None] for order in range(derivative + 1)]
        binomial = ((1.0,), (1.0, 1.0), (1.0, 2.0, 1.0))[derivative]
        found: NDArray[np.float64] = sum(
            (each * size[derivative - k] * noise[k] for k, each in enumerate(binomial)),
            start=np.zeros_like(noise[0]),
        )
        return found

    def shaken_pose(
        self, times_s: NDArray[np.float64], rotation: NDArray[np.float64], position_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return rotation (N, 3, 3) and position (N, 3) of the shaken robot."""
        state = self.at(times_s)
        shaken = rotation @ rotation_from_euler(*state[:, 3:].T)
        pivot = position_m + np.einsum("nij,nj->ni", rotation, self.pivot_m + state[:, :3])
        return shaken, pivot - shaken @ self.pivot_m

    def shaken_motion(self, times_s: NDArray[np.float64], motion: RigidMotion) -> RigidMotion:
        """Return the motion of the shaken robot."""
        state, first, second = (self.at(times_s, order) for order in range(3))
        pivot = motion.at_point(self.pivot_m + state[:, :3], first[:, :3], second[:, :3])
        shaken = pivot.turned(
            rotation_from_euler(*state[:, 3:].T), *euler_rates(state[:, 3:], first[:, 3:], second[:, 3:])
        )
        return shaken.at_point(-self.pivot_m)


def _periodic_noise(
    config: ShakingConfig, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return instants, (M,), and displacement and angles, (M, 6); the last row repeats the first."""
    count = round(PERIOD_S / STEP_S)
    frequency_hz = np.fft.rfftfreq(count, STEP_S)
    inside = (frequency_hz >= config.low_hz) & (frequency_hz <= config.high_hz)
    omega_radps = 2.0 * np.pi * frequency_hz[inside, None]
    spectrum = np.zeros((len(frequency_hz), 6), dtype=np.complex128)
    parts = generator.standard_normal((2, len(omega_radps), 6))
    # K tones whose two parts are standard normal have the variance 4 K / count^2 after the inverse transform.
    unit = (parts[0] + 1j * parts[1]) * count / np.sqrt(4.0 * len(omega_radps))
    spectrum[inside, :3] = -config.acceleration_rms_mps2 * unit[:, :3] / omega_radps**2
    spectrum[inside, 3:] = config.angular_rate_rms_radps * unit[:, 3:] / (1j * omega_radps)
    noise = np.fft.irfft(spectrum, count, axis=0)
    return np.arange(count + 1, dtype=np.float64) * STEP_S, np.concatenate([noise, noise[:1]])
