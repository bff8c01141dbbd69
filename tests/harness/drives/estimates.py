"""Simulated estimates of other programs from a true trajectory: lidar odometry, visual-inertial odometry, GNSS positions.

Each has its own clock, its own frame and its own point on the robot, and comes with the truth that it was made from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from tsgt.geometry import (
    exp_so3,
    invert,
    quaternion_from_rotation,
    rotate,
    rotation_from_quaternion,
    skew,
    transform_from,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

    PoseAt = Callable[[FloatArray], FloatArray]
    """``T_station1_robot`` at N instants in s from the start of the mission: (N,) to (N, 4, 4)."""

SECOND_NS = 1_000_000_000

MIN_STAMP_STEP_NS = 1000
"""Stamps with jitter remain in order by at least this."""

MAX_LEVER_ARM_M = 0.8
"""Of the sensor from the robot's origin, along each axis."""

MAX_DISTANCE_M = 50.0
"""Of the frame of an estimate from ``station1``, along each axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimateModel:
    """Errors of an estimate, one sigma. Drift is a random walk along the driven path; a robot at rest does not drift."""

    rate_hz: float
    orientation: bool = True
    gravity_aligned: bool = False
    """The frame of the estimate is level: it differs from ``station1`` by yaw and position alone."""
    position_walk_m: float = 0.0
    """Per axis and square root of a metre."""
    tilt_walk_rad: float = 0.0
    """Per horizontal axis and square root of a metre; turns the path from there on, as odometry does."""
    yaw_walk_rad: float = 0.0
    """Likewise, about the vertical."""
    position_noise_m: float = 0.0
    """White, per axis."""
    rotation_noise_rad: float = 0.0
    """White, per axis."""
    horizontal_error_m: float = 0.0
    """First-order Gauss-Markov process, per horizontal axis; stationary."""
    vertical_error_m: float = 0.0
    """Likewise, vertical."""
    tilt_error_rad: float = 0.0
    """Likewise, of the tilt."""
    correlation_time_s: float = 60.0
    """Of the Gauss-Markov processes."""
    stamp_jitter_s: float = 0.0
    """Of each stamp."""
    dropouts_per_min: float = 0.0
    dropout_s: float = 1.0
    """Mean length; exponentially distributed."""
    diverges_at_s: float | None = None
    """From this time of the mission on, the position runs away with :attr:`divergence_mps2` in one horizontal direction."""
    divergence_mps2: float = 0.1


LIDAR = EstimateModel(
    rate_hz=10.0,
    position_walk_m=0.005,
    tilt_walk_rad=math.radians(0.02),
    yaw_walk_rad=math.radians(0.02),
    position_noise_m=0.008,
    rotation_noise_rad=math.radians(0.05),
)
"""Lidar odometry without loop closure: drift of about 0.5 % over straight segments of 400 m, where the KITTI
benchmark has LOAM (Zhang and Singh 2017) at 0.55 % and 0.0013 degrees per metre. White noise of scan matching: assumed."""

VISUAL_INERTIAL = EstimateModel(
    rate_hz=20.0,
    gravity_aligned=True,
    position_walk_m=0.01,
    yaw_walk_rad=math.radians(0.06),
    position_noise_m=0.003,
    rotation_noise_rad=math.radians(0.03),
    tilt_error_rad=math.radians(0.1),
    correlation_time_s=20.0,
    stamp_jitter_s=0.001,
    dropouts_per_min=1.0,
    dropout_s=1.0,
)
"""Visual-inertial odometry: drift of about 1.2 % over straight segments of 400 m, as stereo methods in the KITTI benchmark (ORB-SLAM2:
1.15 %). Gravity keeps the tilt. Stamps of a camera without trigger, tracking lost once a minute: assumed."""

GNSS = EstimateModel(
    rate_hz=5.0,
    orientation=False,
    gravity_aligned=True,
    position_noise_m=0.003,
    horizontal_error_m=0.01,
    vertical_error_m=0.02,
    correlation_time_s=60.0,
)
"""RTK positions of an antenna: 10 mm horizontal as in data sheets of receivers (u-blox ZED-F9P: 0.01 m + 1 ppm CEP), vertical
twice that, correlated by multipath over about a minute."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueRelation:
    """The relation between an estimate and the truth, as ``tsgt.analysis.compare.Relation`` defines it.

    The estimate at stamp τ is the pose of the sensor in ``frame`` at ``t = τ + offset_s``.
    """

    offset_s: float = 0.0
    T_robot_sensor: FloatArray
    T_station1_frame: FloatArray


@dataclass(frozen=True, slots=True)
class SimulatedEstimate:
    """M poses, or positions, of a sensor by a simulated program, and the truth at the instants that its stamps state."""

    stamp_ns: NDArray[np.int64]  # (M,) on the clock of that program, strictly increasing
    position_m: FloatArray  # (M, 3) in its frame
    orientation_xyzw: FloatArray | None  # (M, 4)
    covariance: FloatArray  # (M, 6, 6) of its errors by the model, in its frame, order as in PoseBatch
    truth: TrueRelation
    T_station1_estimated: FloatArray  # (M, 4, 4) by the true relation; of positions alone, the true rotation
    T_station1_sensor: FloatArray  # (M, 4, 4) truth


def draw_relation(
    model: EstimateModel, generator: np.random.Generator, *, max_offset_s: float = 2.0
) -> TrueRelation:
    """Draw offset, extrinsic and frame, each uniform; the sensor's axes point anywhere."""
    yaw = exp_so3(np.array([0.0, 0.0, generator.uniform(-math.pi, math.pi)]))
    turned = _random_rotation(generator)
    return TrueRelation(
        offset_s=generator.uniform(-max_offset_s, max_offset_s),
        T_robot_sensor=transform_from(
            _random_rotation(generator) if model.orientation else np.eye(3),
            generator.uniform(-MAX_LEVER_ARM_M, MAX_LEVER_ARM_M, 3),
        ),
        T_station1_frame=transform_from(
            yaw if model.gravity_aligned else turned, generator.uniform(-MAX_DISTANCE_M, MAX_DISTANCE_M, 3)
        ),
    )


def simulate_estimate(
    model: EstimateModel,
    truth: TrueRelation,
    pose_at: PoseAt,
    until_s: float,
    generator: np.random.Generator,
    *,
    start_ns: int = 0,
) -> SimulatedEstimate:
    """Simulate an estimate from the start of a mission to ``until_s``; ``pose_at`` covers this time.

    ``start_ns``: Unix time of the start of the mission.
    """
    phase_rng, stamp_rng, dropout_rng, error_rng = generator.spawn(4)
    # Stamps with jitter remain inside the covered time.
    margin_s = 6.0 * model.stamp_jitter_s
    first_s = margin_s + phase_rng.uniform(0.0, 1.0 / model.rate_hz)
    time_s = np.arange(first_s, until_s - margin_s, 1.0 / model.rate_hz)
    sensor = pose_at(time_s) @ truth.T_robot_sensor
    estimated = _with_errors(model, time_s, sensor, error_rng)
    stamped_s = time_s + np.clip(
        stamp_rng.normal(0.0, model.stamp_jitter_s, len(time_s)), -margin_s, margin_s
    )
    stamped_s = np.maximum.accumulate(stamped_s)
    kept = _kept(model, time_s, dropout_rng)
    kept[1:] &= np.diff(stamped_s) > MIN_STAMP_STEP_NS / SECOND_NS
    stamped_s, estimated = stamped_s[kept], estimated[kept]
    elapsed_s = stamped_s - stamped_s[0]
    in_frame = invert(truth.T_station1_frame) @ estimated
    into = np.kron(np.eye(2), truth.T_station1_frame[:3, :3].T)
    return SimulatedEstimate(
        start_ns + np.rint((stamped_s[0] - truth.offset_s + elapsed_s) * SECOND_NS).astype(np.int64),
        in_frame[:, :3, 3],
        quaternion_from_rotation(in_frame[:, :3, :3]) if model.orientation else None,
        into @ _covariance(model, time_s, sensor)[kept] @ into.T,
        truth,
        estimated,
        pose_at(stamped_s) @ truth.T_robot_sensor,
    )


def _with_errors(
    model: EstimateModel, time_s: FloatArray, true: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return poses of the sensor in ``station1`` with all errors, (N, 4, 4)."""
    n = len(time_s)
    walks, whites, stationary, direction = (each.standard_normal((n, 6)) for each in rng.spawn(4))
    steps_m = np.diff(true[:, :3, 3], axis=0)
    root_m = np.sqrt(np.linalg.norm(steps_m, axis=1))[:, None]
    turn_sigma = np.array([model.tilt_walk_rad, model.tilt_walk_rad, model.yaw_walk_rad])
    walked = np.zeros((n, 6))
    walked[1:] = np.cumsum(root_m * walks[1:] * np.r_[[model.position_walk_m] * 3, turn_sigma], axis=0)
    turned = exp_so3(walked[:, 3:])
    # Each step of the path is turned by the drift of the rotation up to there, as odometry composes its steps.
    position = np.empty((n, 3))
    position[0] = true[0, :3, 3]
    position[1:] = position[0] + np.cumsum(rotate(turned[:-1], steps_m), axis=0)
    markov = _gauss_markov(model, stationary)
    position += walked[:, :3] + model.position_noise_m * whites[:, :3]
    position += markov[:, :3] * (model.horizontal_error_m, model.horizontal_error_m, model.vertical_error_m)
    if model.diverges_at_s is not None:
        away = direction[0, :2] / np.linalg.norm(direction[0, :2])
        since_s = np.maximum(time_s - model.diverges_at_s, 0.0)
        position[:, :2] += 0.5 * model.divergence_mps2 * since_s[:, None] ** 2 * away
    tilt = np.zeros((n, 3))
    tilt[:, :2] = model.tilt_error_rad * markov[:, 3:5]
    rotation = exp_so3(tilt) @ turned @ true[:, :3, :3] @ exp_so3(model.rotation_noise_rad * whites[:, 3:])
    return transform_from(rotation, position)


def _covariance(model: EstimateModel, time_s: FloatArray, true: FloatArray) -> FloatArray:
    """Covariance of the errors by the model, (N, 6, 6), without dropouts and divergence; stamps count by the mean velocity."""
    n = len(time_s)
    position = true[:, :3, 3]
    steps_m = np.diff(position, axis=0)
    driven_m = np.concatenate([[0.0], np.linalg.norm(steps_m, axis=1)])
    turned = np.diag([model.tilt_walk_rad, model.tilt_walk_rad, model.yaw_walk_rad]) ** 2
    # A turn where the sensor was at p_k has moved it at p by dθ x (p - p_k): sums over all k before.
    arms = skew(position)
    path_m = np.cumsum(driven_m)[:, None, None]
    first = np.cumsum(driven_m[:, None, None] * arms, axis=0)
    second = np.cumsum(driven_m[:, None, None] * (arms @ turned @ np.swapaxes(arms, 1, 2)), axis=0)
    across = arms @ turned @ np.swapaxes(first, 1, 2)
    found = np.zeros((n, 6, 6))
    found[:, :3, :3] = path_m * (arms @ turned @ np.swapaxes(arms, 1, 2)) + second
    found[:, :3, :3] -= across + np.swapaxes(across, 1, 2)
    found[:, :3, :3] += (path_m * model.position_walk_m**2 + model.position_noise_m**2) * np.eye(3)
    stationary = np.diag([model.horizontal_error_m, model.horizontal_error_m, model.vertical_error_m]) ** 2
    velocity_mps = np.gradient(position, time_s, axis=0)
    found[:, :3, :3] += (
        stationary + model.stamp_jitter_s**2 * velocity_mps[:, :, None] * velocity_mps[:, None, :]
    )
    found[:, :3, 3:] = (first - path_m * arms) @ turned
    found[:, 3:, :3] = np.swapaxes(found[:, :3, 3:], 1, 2)
    tilted = np.diag([model.tilt_error_rad, model.tilt_error_rad, 0.0]) ** 2
    found[:, 3:, 3:] = path_m * turned + tilted + model.rotation_noise_rad**2 * np.eye(3)
    return found


def _gauss_markov(model: EstimateModel, white: FloatArray) -> FloatArray:
    """Stationary first-order Gauss-Markov processes of unit sigma from white noise, (N, 6); equal intervals."""
    kept = math.exp(-1.0 / (model.rate_hz * model.correlation_time_s))
    steps = white * math.sqrt(1.0 - kept**2)
    steps[:1] = white[:1]
    process: FloatArray = lfilter([1.0], [1.0, -kept], steps, axis=0)
    return process


def _kept(model: EstimateModel, time_s: FloatArray, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Mask of the poses outside dropouts, (N,); the first remains."""
    kept = np.ones(len(time_s), dtype=np.bool_)
    span_s = time_s[-1] - time_s[0]
    for _ in range(rng.poisson(model.dropouts_per_min / 60.0 * span_s)):
        start_s, length_s = rng.uniform(time_s[0], time_s[-1]), rng.exponential(model.dropout_s)
        kept &= (time_s < start_s) | (time_s > start_s + length_s)
    kept[0] = True
    return kept


def _random_rotation(generator: np.random.Generator) -> FloatArray:
    """Uniform over SO(3) (K. Shoemake, 1992): a quaternion of four normal numbers."""
    return rotation_from_quaternion(generator.standard_normal(4))
