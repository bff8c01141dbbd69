"""Ground truth: poses of the simulated robot and positions of its prisms at any instant.

The robot follows velocity commands (speed and yaw rate, each constant for some seconds) or drives along a route, with
smooth transitions and vibration from the ground. The motion is integrated on a fine grid and interpolated by cubic
splines. The splines are the ground truth: defined at every instant, and smooth. Faster shaking may be added to them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from tsgt.geometry import transform_from, transform_points
from tsgt.simulation.rigid_motion import RigidMotion, euler_rates, rotation_from_euler
from tsgt.simulation.shaking import Shaking

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from tsgt.config import MotionConfig, OcclusionConfig, ScenarioConfig, ShakingConfig

STEP_S = 0.02

ROUTE_STEP_M = 0.05

# A robot outside its area turns back at a rate of its heading error divided by this time.
STEERING_TIME_CONSTANT_S = 1.0

STOP_S = 1.0
"""From driving to standing before a rollover, and from standing to driving after it."""

HIDDEN_ROLL_RAD = math.radians(45.0)
"""A robot that is rolled by more hides its prisms."""


class Rollover(NamedTuple):
    """The robot rolls over and lies until it is put on its wheels again; times in s."""

    at_s: float  # it begins to roll
    roll_s: float  # for how long it rolls over, and is rolled back at the end
    until_s: float  # it stands on its wheels again; at least twice ``roll_s`` after ``at_s``
    angle_rad: float  # roll while it lies, positive to the right


class World:
    """Ground truth of a driving robot; frames ``station1`` (the world) and ``robot`` (origin on the ground below it).

    Parameters
    ----------
    prisms_m
        Prism positions in the frame ``robot``, (P, 3).
    duration_s
        The truth covers 0 to this time.
    occlusions_s
        Occlusions by station number: start and end in s from the start, (K, 2).

    Attributes
    ----------
    shaking
        Fast shaking while driving; None: there is none.
    """

    def __init__(
        self,
        motion: MotionConfig,
        prisms_m: NDArray[np.float64],
        duration_s: float,
        generator: np.random.Generator,
        occlusions_s: Mapping[int, NDArray[np.float64]] | None = None,
    ) -> None:
        self.prisms_m = prisms_m
        self.duration_s = duration_s
        self.occlusions_s = occlusions_s or {}
        # Two extra steps keep the last instant inside the splines despite rounding.
        times_s = np.arange(math.ceil(duration_s / STEP_S) + 3) * STEP_S
        self._spline = CubicSpline(times_s, _integrate_motion(motion, len(times_s), generator))
        self.shaking: Shaking | None = None

    def shake(
        self, config: ShakingConfig, pivot_m: NDArray[np.float64], generator: np.random.Generator
    ) -> None:
        """Add shaking about a point of the robot, (3,) in frame ``robot``; poses, prisms and motion are shaken from now on."""
        times_s = self._spline.x
        speed_mps = np.linalg.norm(self._spline(times_s, 1)[:, :2], axis=1)
        self.shaking = Shaking(config, pivot_m, times_s, speed_mps, generator)

    def roll_over(self, rollovers: Sequence[Rollover], stations: Sequence[int]) -> None:
        """Let the robot stop, roll over, lie with its prisms hidden from the stations, and drive on; before :meth:`shake`.

        It rolls about its x axis and is lifted: its prisms, the highest at height h, are not below the ground.
        """
        times_s = self._spline.x
        driven, rolled_rad = np.ones(len(times_s)), np.zeros(len(times_s))
        for each in rollovers:
            driven *= 1.0 - _smooth_step((times_s - each.at_s) / STOP_S + 1.0)
            driven += _smooth_step((times_s - each.until_s) / STOP_S)
            over = _smooth_step((times_s - each.at_s) / each.roll_s)
            back = _smooth_step((times_s - each.until_s) / each.roll_s + 1.0)
            rolled_rad += each.angle_rad * (over - back)
        state = self._spline(np.minimum(np.cumsum(driven) * STEP_S - STEP_S, times_s[-1]))
        state[:, 5] += rolled_rad
        state[:, 2] += self.prisms_m[:, 2].max() * (1.0 - np.cos(rolled_rad)) / 2.0
        self._spline = CubicSpline(times_s, state)
        edges = np.flatnonzero(np.diff(np.abs(rolled_rad) > HIDDEN_ROLL_RAD))
        hidden_s = times_s[edges[: len(edges) // 2 * 2] + 1].reshape(-1, 2)
        self.occlusions_s = {
            station: np.concatenate([self.occlusions_s.get(station, np.empty((0, 2))), hidden_s])
            for station in stations
        }

    def pose_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``T_station1_robot`` at N instants in s from the start: (N, 4, 4).

        Raises
        ------
        ValueError
            An instant is outside the covered time.
        """
        times_s = self._covered(times_s)
        state = self._spline(times_s)
        rotation, position_m = rotation_from_euler(state[:, 3], state[:, 4], state[:, 5]), state[:, :3]
        if self.shaking is not None:
            rotation, position_m = self.shaking.shaken_pose(times_s, rotation, position_m)
        return transform_from(rotation, position_m)

    def motion_at(self, times_s: NDArray[np.float64]) -> RigidMotion:
        """Return the motion of the frame ``robot`` at N instants: the exact derivatives of the poses.

        Raises as :meth:`pose_at`.
        """
        times_s = self._covered(times_s)
        state, first, second = (self._spline(times_s, order) for order in range(3))
        rate, acceleration = euler_rates(state[:, 3:], first[:, 3:], second[:, 3:])
        motion = RigidMotion(
            rotation_from_euler(state[:, 3], state[:, 4], state[:, 5]),
            state[:, :3],
            first[:, :3],
            second[:, :3],
            rate,
            acceleration,
        )
        return motion if self.shaking is None else self.shaking.shaken_motion(times_s, motion)

    def _covered(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        times_s = np.asarray(times_s, dtype=np.float64)
        if times_s.size and not (times_s.min() >= 0.0 and times_s.max() <= self.duration_s):
            raise ValueError(
                f"the ground truth covers 0 to {self.duration_s} s, got {times_s.min()} to {times_s.max()} s"
            )
        return times_s

    def prism_at(self, times_s: NDArray[np.float64], index: int) -> NDArray[np.float64]:
        """Return the position of a prism, by its row in the layout, in ``station1`` at N instants: (N, 3)."""
        return transform_points(self.pose_at(times_s), self.prisms_m[index])


def scenario_world(scenario: ScenarioConfig, duration_s: float, generator: np.random.Generator) -> World:
    """Build the ground truth of a scenario: robot, prisms in their order, occlusions."""
    # Separate generators: the motion does not depend on the occlusions.
    motion_rng, occlusion_rng = generator.spawn(2)
    numbers = [station.station for station in scenario.stations]
    return World(
        scenario.motion,
        np.array([prism.position_m for prism in scenario.prisms]),
        duration_s,
        motion_rng,
        draw_occlusions(scenario.occlusions, numbers, duration_s, occlusion_rng),
    )


def _smooth_step(progress: NDArray[np.float64]) -> NDArray[np.float64]:
    """From 0 to 1 while the progress does, with a continuous second derivative."""
    x = np.clip(progress, 0.0, 1.0)
    stepped: NDArray[np.float64] = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    return stepped


def is_shaken(scenario: ScenarioConfig) -> bool:
    """Whether the robot of a scenario is shaken while it drives."""
    return scenario.shaking.when == "always" or (
        scenario.shaking.when == "with_imu" and scenario.imu.model != "none"
    )


def draw_occlusions(
    occlusions: Sequence[OcclusionConfig],
    stations: Sequence[int],
    duration_s: float,
    generator: np.random.Generator,
) -> dict[int, NDArray[np.float64]]:
    """Draw the occlusions of each station.

    Each station keeps its draws when further stations are added. None starts after ``duration_s``.

    Returns
    -------
    dict
        By station number: start and end in s, (K, 2); they may overlap.
    """
    shared = _draw_intervals([o for o in occlusions if o.common], duration_s, generator.spawn(1)[0])
    own = [o for o in occlusions if not o.common]
    return {
        station: np.concatenate([shared, _draw_intervals(own, duration_s, generator.spawn(1)[0])])
        for station in stations
    }


def _draw_intervals(
    occlusions: Sequence[OcclusionConfig], duration_s: float, generator: np.random.Generator
) -> NDArray[np.float64]:
    spans = [np.empty((0, 2))]
    for occlusion in occlusions:
        count = generator.poisson(occlusion.rate_per_min / 60.0 * duration_s)
        start_s = generator.uniform(0.0, duration_s, count)
        length_s = generator.uniform(occlusion.duration_min_s, occlusion.duration_max_s, count)
        spans.append(np.column_stack([start_s, start_s + length_s]))
    return np.concatenate(spans)


def _integrate_motion(motion: MotionConfig, n: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """State on the grid, (n, 6): x, y, z in m, yaw, pitch, roll in rad."""
    start_yaw = generator.uniform(-math.pi, math.pi)
    if motion.route_m:
        speeds = _route_commands(motion, n, generator)
        state = _state_along_route(
            motion, np.cumsum(_smoothed(speeds[:, None], motion.command_smoothing_s)) * STEP_S
        )
    else:
        commands = _commands(motion, n, start_yaw, generator)
        speeds = commands[:, 0]
        state = _state_from_commands(motion, _smoothed(commands, motion.command_smoothing_s), start_yaw)
    shaking = _unit_noise(n, 3, motion.attitude_smoothing_s, generator)
    shaking *= _smoothed((speeds[:, None] > 0).astype(np.float64), motion.command_smoothing_s)
    state[:, 2] += shaking[:, 0] * motion.heave_rms_mm / 1e3
    state[:, 4:] += shaking[:, 1:] * math.radians(motion.tilt_rms_deg)
    return state


def _state_from_commands(
    motion: MotionConfig, commands: NDArray[np.float64], start_yaw: float
) -> NDArray[np.float64]:
    """State after speeds and yaw rates (n, 2) from the centre of the area, without vibration."""
    speed, yaw_rate = commands.T
    yaw = start_yaw + np.cumsum(yaw_rate) * STEP_S
    x, y, z = motion.area_centre_m
    state = np.zeros((len(commands), 6))
    state[:, 0] = x + np.cumsum(speed * np.cos(yaw)) * STEP_S
    state[:, 1] = y + np.cumsum(speed * np.sin(yaw)) * STEP_S
    state[:, 2] = z
    state[:, 3] = yaw
    return state


def _state_along_route(motion: MotionConfig, driven_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """State after these distances along the route, (n,), without vibration; heading and pitch are tangential."""
    arc_length_m, points = _path(motion)
    path = CubicSpline(arc_length_m, points)
    driven_m = np.clip(driven_m, 0.0, arc_length_m[-1])
    tangent = path(driven_m, 1)
    state = np.zeros((len(driven_m), 6))
    state[:, :3] = path(driven_m)
    state[:, 3] = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    state[:, 4] = -np.arctan2(tangent[:, 2], np.hypot(tangent[:, 0], tangent[:, 1]))  # nose up is negative
    return state


def _path(motion: MotionConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the route with rounded corners: arc length in m, (m,), and positions, (m, 3)."""
    corners = np.array(motion.route_m)
    at_corner_m = _arc_lengths(corners)
    count = max(2, round(at_corner_m[-1] / ROUTE_STEP_M) + 1)
    steps_m = np.linspace(0.0, at_corner_m[-1], count)
    points = np.column_stack([np.interp(steps_m, at_corner_m, column) for column in corners.T])
    points = gaussian_filter1d(points, motion.corner_smoothing_m / ROUTE_STEP_M, axis=0, mode="nearest")
    # The filter compresses the points at both ends; resample at equal arc lengths to keep the speed.
    arc_length_m = _arc_lengths(points)
    steps_m = np.linspace(0.0, arc_length_m[-1], count)
    return steps_m, np.column_stack([np.interp(steps_m, arc_length_m, column) for column in points.T])


def _arc_lengths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Arc length from the first point to each point, (n,)."""
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def _route_commands(motion: MotionConfig, n: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Speed in m/s before smoothing, (n,); 0 after the end of the route."""
    end_m = _path(motion)[0][-1]
    weights = np.array(motion.speed_weights) / sum(motion.speed_weights)
    speeds = np.zeros(n)
    driven_m = speed = 0.0
    next_draw = motion.start_after_s
    for step in range(n):
        if step * STEP_S >= next_draw:
            speed = float(generator.choice(motion.speeds_mps, p=weights))
            next_draw += generator.uniform(motion.interval_min_s, motion.interval_max_s)
        if driven_m + speed * STEP_S > end_m:
            break
        speeds[step] = speed
        driven_m += speed * STEP_S
    return speeds


def _commands(
    motion: MotionConfig, n: int, start_yaw: float, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Speed in m/s and yaw rate in rad/s before smoothing, (n, 2); a robot outside the area is steered back."""
    weights = np.array(motion.speed_weights) / sum(motion.speed_weights)
    max_rate = max(abs(rate) for rate in motion.yaw_rates_radps)
    commands = np.empty((n, 2))
    x = y = 0.0  # from the centre of the area
    yaw, speed, commanded_rate, next_draw = start_yaw, 0.0, 0.0, motion.start_after_s
    for step in range(n):
        if step * STEP_S >= next_draw:
            speed = float(generator.choice(motion.speeds_mps, p=weights))
            commanded_rate = float(generator.choice(motion.yaw_rates_radps)) if speed else 0.0
            next_draw += generator.uniform(motion.interval_min_s, motion.interval_max_s)
        rate = commanded_rate
        if speed and math.hypot(x, y) > motion.area_radius_m:
            heading_error = math.remainder(math.atan2(-y, -x) - yaw, math.tau)
            rate = max(-max_rate, min(max_rate, heading_error / STEERING_TIME_CONSTANT_S))
        commands[step] = speed, rate
        yaw += rate * STEP_S
        x += speed * math.cos(yaw) * STEP_S
        y += speed * math.sin(yaw) * STEP_S
    return commands


def _unit_noise(n: int, columns: int, sigma_s: float, generator: np.random.Generator) -> NDArray[np.float64]:
    """White noise smoothed with a Gaussian and scaled to a standard deviation of 1, (n, columns)."""
    # A Gaussian kernel reduces the variance of white noise to sum(k^2) = step / (2 sqrt(pi) sigma).
    scale = math.sqrt(2.0 * math.sqrt(math.pi) * sigma_s / STEP_S)
    return scale * _smoothed(generator.standard_normal((n, columns)), sigma_s)


def _smoothed(columns: NDArray[np.float64], sigma_s: float) -> NDArray[np.float64]:
    smoothed: NDArray[np.float64] = gaussian_filter1d(columns, sigma_s / STEP_S, axis=0, mode="reflect")
    return smoothed
