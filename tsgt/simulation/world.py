"""The truth: where the simulated robot and its prisms are at any instant.

The robot gets commands (speed and yaw rate, constant for some seconds), follows them smoothly, and is shaken by the
ground while it moves. Its motion is computed on a fine grid and joined by cubic splines; the splines *are* the
truth, so that it can be asked for at any instant and is smooth there.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from tsgt.geometry import transform_from, transform_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.config import MotionConfig

STEP_S = 0.02

# Towards the area, a robot outside turns at the rate that would take away its error of heading in this time.
STEERING_TIME_S = 1.0


class World:
    """A robot that drives; frames ``station1`` (the world) and ``robot``.

    The robot's origin lies on the ground under it, as that of the prism layout does.

    Parameters
    ----------
    motion
        How it drives.
    prisms_m
        Prism positions in the frame ``robot``, (P, 3).
    duration_s
        The truth reaches from 0 to here.
    generator
        Source of all randomness; the same state gives the same world.
    """

    def __init__(
        self,
        motion: MotionConfig,
        prisms_m: NDArray[np.float64],
        duration_s: float,
        generator: np.random.Generator,
    ) -> None:
        self.prisms_m = prisms_m
        self.duration_s = duration_s
        # Two steps more, so that the last instant lies inside the splines whatever rounding does.
        times_s = np.arange(math.ceil(duration_s / STEP_S) + 3) * STEP_S
        self._spline = CubicSpline(times_s, _motion(motion, len(times_s), generator))

    def pose_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``T_station1_robot`` at N instants, seconds from the start: (N, 4, 4).

        Raises
        ------
        ValueError
            An instant lies outside the truth.
        """
        times_s = np.asarray(times_s, dtype=np.float64)
        if times_s.size and not (times_s.min() >= 0.0 and times_s.max() <= self.duration_s):
            raise ValueError(
                f"the truth reaches from 0 to {self.duration_s} s, asked for {times_s.min()} to {times_s.max()} s"
            )
        state = self._spline(times_s)
        return transform_from(_rotation(state[:, 3], state[:, 4], state[:, 5]), state[:, :3])

    def prism_at(self, times_s: NDArray[np.float64], index: int) -> NDArray[np.float64]:
        """Return the position of one prism, by its row in the layout, in ``station1`` at N instants: (N, 3)."""
        return transform_points(self.pose_at(times_s), self.prisms_m[index])


def _motion(motion: MotionConfig, n: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """State on the grid, (n, 6): x, y, z in m, yaw, pitch, roll in rad."""
    start_yaw = generator.uniform(-math.pi, math.pi)
    commands = _commands(motion, n, start_yaw, generator)
    speed, yaw_rate = _smoothed(commands, motion.command_smoothing_s).T
    yaw = start_yaw + np.cumsum(yaw_rate) * STEP_S
    shaking = _unit_noise(n, 3, motion.shaking_smoothing_s, generator)
    shaking *= _smoothed((commands[:, :1] > 0).astype(np.float64), motion.command_smoothing_s)
    x, y, z = motion.area_centre_m
    return np.column_stack(
        [
            x + np.cumsum(speed * np.cos(yaw)) * STEP_S,
            y + np.cumsum(speed * np.sin(yaw)) * STEP_S,
            z + shaking[:, 0] * motion.heave_rms_mm / 1e3,
            yaw,
            shaking[:, 1] * math.radians(motion.tilt_rms_deg),
            shaking[:, 2] * math.radians(motion.tilt_rms_deg),
        ]
    )


def _commands(
    motion: MotionConfig, n: int, start_yaw: float, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Speed in m/s and yaw rate in rad/s before smoothing, (n, 2); steers back a robot that leaves the area."""
    weights = np.array(motion.speed_weights) / sum(motion.speed_weights)
    fastest_turn = max(abs(rate) for rate in motion.yaw_rates_radps)
    commands = np.empty((n, 2))
    x = y = 0.0  # from the centre of the area
    yaw, speed, drawn_rate, next_draw = start_yaw, 0.0, 0.0, 0.0
    for step in range(n):
        if step * STEP_S >= next_draw:
            speed = float(generator.choice(motion.speeds_mps, p=weights))
            drawn_rate = float(generator.choice(motion.yaw_rates_radps)) if speed else 0.0
            next_draw += generator.uniform(motion.interval_min_s, motion.interval_max_s)
        rate = drawn_rate
        if speed and math.hypot(x, y) > motion.area_radius_m:
            off_course = math.remainder(math.atan2(-y, -x) - yaw, math.tau)
            rate = max(-fastest_turn, min(fastest_turn, off_course / STEERING_TIME_S))
        commands[step] = speed, rate
        yaw += rate * STEP_S
        x += speed * math.cos(yaw) * STEP_S
        y += speed * math.sin(yaw) * STEP_S
    return commands


def _unit_noise(n: int, columns: int, sigma_s: float, generator: np.random.Generator) -> NDArray[np.float64]:
    """White noise smoothed with a Gaussian, scaled so that its standard deviation is 1, (n, columns)."""
    # A Gaussian kernel leaves white noise the variance sum(k^2), which is step / (2 sqrt(pi) sigma).
    scale = math.sqrt(2.0 * math.sqrt(math.pi) * sigma_s / STEP_S)
    return scale * _smoothed(generator.standard_normal((n, columns)), sigma_s)


def _smoothed(columns: NDArray[np.float64], sigma_s: float) -> NDArray[np.float64]:
    smoothed: NDArray[np.float64] = gaussian_filter1d(columns, sigma_s / STEP_S, axis=0, mode="reflect")
    return smoothed


def _rotation(
    yaw: NDArray[np.float64], pitch: NDArray[np.float64], roll: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotation about z by yaw, then about the new y by pitch, then about the new x by roll: (N, 3, 3)."""
    cy, sy, cp, sp, cr, sr = (
        np.cos(yaw),
        np.sin(yaw),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(roll),
        np.sin(roll),
    )
    return np.stack(
        [
            np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], axis=-1),
            np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], axis=-1),
            np.stack([-sp, cp * sr, cp * cr], axis=-1),
        ],
        axis=-2,
    )
