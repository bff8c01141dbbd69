"""Wheel odometry between knots: how far the wheels went along, while they hardly slid across or lifted off. Sans-I/O.

Between two knots a point of the wheels moves by what they measured, turned by the gyro. Scale, slip and direction of travel are
states: scale and direction nearly constant, slip a first-order Gauss-Markov process, which the prisms tell while they are measured. The loss
is robust: wheels that spin contradict the IMU. docs/explanation/imu.md derives the Jacobians.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial.states import WHEELS_DIM
from tsgt.geometry.rigid import FloatArray, dot, exp_so3, matvec, rotation_from_quaternion, skew
from tsgt.geometry.trajectory.gauss_newton import OUTLIER_THRESHOLD

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.preintegration import ContiguousSamples
    from tsgt.geometry.inertial.states import InertialStates, Mounting
    from tsgt.model import OdometryParameters

MIN_COVERED = (
    0.9  # Share of a step that samples must cover; what they do not is driven at the mean speed of the rest
)
MIN_SIGMA_M = 1e-4  # Of the displacement along over a step: what the integration leaves out
SCALE_WALK, DIRECTION_WALK = 1e-4, 1e-4  # Random walks in 1/sqrt(s) and rad/sqrt(s): load, tyres, ground
LARGE_SLIP_SIGMAS = 2.0
"""Estimated slip above which its noise is larger than configured, so that it is as many sigmas of that."""

_TOUCHING = 0.5  # Samples that are closer than this share of their duration follow each other


@dataclass(frozen=True, slots=True)
class WheelSamples:
    """N samples in the order of time; each is the mean over the interval that ends at ``end_s``."""

    end_s: FloatArray  # (N,) from the time origin of the observations
    duration_s: FloatArray  # (N,)
    speed_mps: FloatArray  # (N,) along the direction of travel, positive forwards

    @classmethod
    def none(cls) -> WheelSamples:
        """Return no samples."""
        return cls(np.empty(0), np.empty(0), np.empty(0))

    def __len__(self) -> int:
        return len(self.end_s)

    def select(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> WheelSamples:
        """Return the samples of some rows."""
        return WheelSamples(*(getattr(self, each.name)[rows] for each in fields(self)))

    def joined(self, others: WheelSamples) -> WheelSamples:
        """Return these samples and others, in the order of time; of two of the same interval the first."""
        both = WheelSamples(
            *(np.concatenate([getattr(self, each.name), getattr(others, each.name)]) for each in fields(self))
        )
        order = np.argsort(both.end_s, kind="stable")
        return both.select(order[np.diff(both.end_s[order], prepend=-np.inf) > 0])


@dataclass(frozen=True, slots=True)
class OdometrySteps:
    """Wheel odometry over K steps between knots, in the axes of the IMU at the start of each."""

    forward_m: FloatArray  # (K, 3) displacement of the wheels' point as measured
    leftward_m: FloatArray  # (K, 3) its derivative by the direction of travel
    whitening: FloatArray  # (K, 3, 3) of the displacement's error; zero where nothing was measured
    arm_m: FloatArray  # (3,) the wheels' point, from the origin of the states in the axes of the IMU
    kept: FloatArray  # (K, 3) share of scale, slip and direction that lasts over the step
    variances: FloatArray  # (K, 3) of what comes to them, where slip is as configured
    slip_sigma: float  # As configured
    slip_noise: FloatArray  # (K,) factor on the variance of what comes to slip: 1 unless it is large

    def __len__(self) -> int:
        return len(self.forward_m)

    def select(self, rows: slice | NDArray[np.intp]) -> OdometrySteps:
        """Return some steps."""
        return OdometrySteps(
            self.forward_m[rows],
            self.leftward_m[rows],
            self.whitening[rows],
            self.arm_m,
            self.kept[rows],
            self.variances[rows],
            self.slip_sigma,
            self.slip_noise[rows],
        )

    def joined(self, others: OdometrySteps) -> OdometrySteps:
        """Return these steps, then the others."""
        return OdometrySteps(
            np.concatenate([self.forward_m, others.forward_m]),
            np.concatenate([self.leftward_m, others.leftward_m]),
            np.concatenate([self.whitening, others.whitening]),
            self.arm_m,
            np.concatenate([self.kept, others.kept]),
            np.concatenate([self.variances, others.variances]),
            self.slip_sigma,
            np.concatenate([self.slip_noise, others.slip_noise]),
        )

    def with_slip(self, slip: FloatArray) -> OdometrySteps:
        """Return the steps with as much noise of slip as its estimates at their ends, (K + 1,), show.

        Wheels that spin or slide for seconds would otherwise pass for another scale, which stays when they are over.
        """
        level = np.maximum(np.abs(slip[:-1]), np.abs(slip[1:])) / (LARGE_SLIP_SIGMAS * self.slip_sigma)
        return replace(self, slip_noise=np.maximum(level, 1.0) ** 2)

    def process_variances(self) -> FloatArray:
        """(K, 3) of what comes to scale, slip and direction."""
        variances = self.variances.copy()
        variances[:, 1] *= self.slip_noise
        return variances


@dataclass(frozen=True, slots=True)
class Odometry:
    """Wheel odometry and how it is used."""

    samples: WheelSamples
    parameters: OdometryParameters
    arm_m: FloatArray  # (3,) the wheels' point, from the origin of the states in the axes of the IMU
    axes: FloatArray  # (3, 3) ``R_imu_wheels``: columns forwards, to the left, up

    @classmethod
    def of(
        cls,
        samples: WheelSamples,
        parameters: OdometryParameters,
        mounting: Mounting,
        reference_m: FloatArray,
    ) -> Odometry:
        """Return odometry beside states with a mounting, whose position is from ``reference_m``, (3,) in the robot frame."""
        return cls(
            samples,
            parameters,
            mounting.in_imu(np.array(parameters.position_m) - reference_m),
            mounting.rotation.T @ rotation_from_quaternion(np.array(parameters.orientation_xyzw)),
        )

    def prior_sigmas(self) -> FloatArray:
        """(3,) one sigma of scale, slip and direction."""
        parameters = self.parameters
        return np.array([parameters.scale_sigma, parameters.slip_sigma, parameters.direction_sigma_rad])

    def between(
        self, samples: ContiguousSamples, start_s: FloatArray, end_s: FloatArray, gyro_bias: FloatArray
    ) -> OdometrySteps:
        """Return the steps between K times, (K,) each, with the rotation by the gyro less its biases, (K, 3)."""
        step, begin_s, stop_s, speed = self._pieces(start_s, end_s)
        angle = _Angle(samples)
        duration_s, piece_s = end_s - start_s, stop_s - begin_s
        middle_s = 0.5 * (begin_s + stop_s)
        turned = angle.between(start_s[step], middle_s, gyro_bias[step])
        covered_s = np.bincount(step, piece_s, minlength=len(start_s))
        known = covered_s >= MIN_COVERED * duration_s
        fill = np.where(known, duration_s / np.where(known, covered_s, 1.0), 0.0)
        travelled = (speed * piece_s * fill[step])[:, None]
        forward, leftward = np.zeros((2, len(start_s), 3))
        rotation = exp_so3(turned)
        np.add.at(forward, step, travelled * matvec(rotation, self.axes[:, 0]))
        np.add.at(leftward, step, travelled * matvec(rotation, self.axes[:, 1]))

        parameters = self.parameters
        whole = angle.between(start_s, end_s, gyro_bias)
        variances = np.empty((len(start_s), 3))
        white = np.bincount(step, piece_s**2, minlength=len(start_s)) * fill**2
        variances[:, 0] = parameters.speed_noise_mps**2 * white + MIN_SIGMA_M**2
        # Means over separate seconds are independent: a random walk of the position.
        variances[:, 1] = parameters.lateral_sigma_mps**2 * duration_s
        variances[:, 1] += parameters.turning_sigma_m**2 * (whole @ self.axes[:, 2]) ** 2 / duration_s
        variances[:, 2] = parameters.vertical_sigma_mps**2 * duration_s
        axes = exp_so3(0.5 * whole) @ self.axes
        whitening = (axes / np.sqrt(variances)[:, None, :]).swapaxes(1, 2)
        whitening[~known] = 0.0
        kept, gained = np.ones((2, len(start_s), WHEELS_DIM))
        kept[:, 1] = np.exp(-duration_s / parameters.slip_correlation_time_s)
        gained[:, 0], gained[:, 2] = SCALE_WALK**2 * duration_s, DIRECTION_WALK**2 * duration_s
        gained[:, 1] = parameters.slip_sigma**2 * (1.0 - kept[:, 1] ** 2)
        return OdometrySteps(
            forward,
            leftward,
            whitening,
            self.arm_m,
            kept,
            gained,
            parameters.slip_sigma,
            np.ones(len(start_s)),
        )

    def _pieces(
        self, start_s: FloatArray, end_s: FloatArray
    ) -> tuple[NDArray[np.intp], FloatArray, FloatArray, FloatArray]:
        """Parts of samples in steps: number of the step, begin, end and speed, (N,) each."""
        samples = self.samples
        begins_s, ends_s = samples.end_s - samples.duration_s, samples.end_s
        if len(samples) > 1:
            between_s = begins_s[1:] - ends_s[:-1]
            touching = between_s < _TOUCHING * samples.duration_s[1:]
            begins_s = begins_s.copy()
            begins_s[1:][touching] = ends_s[:-1][touching]
        first = ends_s.searchsorted(start_s, side="right")
        count = np.maximum(begins_s.searchsorted(end_s) - first, 0)
        step = np.repeat(np.arange(len(start_s)), count)
        row = np.arange(len(step)) - np.repeat(np.cumsum(count) - count, count) + first[step]
        begin_s, stop_s = np.maximum(begins_s[row], start_s[step]), np.minimum(ends_s[row], end_s[step])
        return step, begin_s, stop_s, samples.speed_mps[row]


class _Angle:
    """Integral of the angular rate; over half a second it is the rotation, up to the product of two small angles."""

    def __init__(self, samples: ContiguousSamples) -> None:
        self._bounds_s = samples.bounds_s
        steps = samples.angular_rate_radps * np.diff(samples.bounds_s)[:, None]
        self._angle = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def between(self, start_s: FloatArray, end_s: FloatArray, bias: FloatArray) -> FloatArray:
        """(N, 3) from N times to N others, without a bias, (N, 3)."""
        return self._at(end_s) - self._at(start_s) - bias * (end_s - start_s)[:, None]

    def _at(self, time_s: FloatArray) -> FloatArray:
        return np.stack([np.interp(time_s, self._bounds_s, each) for each in self._angle.T], axis=1)


@dataclass(frozen=True, slots=True)
class WheelsEstimate:
    """What the newest states tell of the wheel odometry."""

    values: FloatArray  # (3,) scale, slip and direction
    sigmas: FloatArray  # (3,)
    driven_s: float  # Time of the last steps that samples cover
    rejected_s: float  # Time of those among them that contradict IMU and prisms

    @property
    def rejected_share(self) -> float | None:
        """Share of the time in which the wheels contradict IMU and prisms; None while there are no samples."""
        return self.rejected_s / self.driven_s if self.driven_s > 0 else None


def covered_steps(steps: OdometrySteps) -> NDArray[np.bool_]:
    """(K,) whether samples cover the steps."""
    covered: NDArray[np.bool_] = np.any(steps.whitening, axis=(1, 2))
    return covered


def rejected_steps(knots: InertialStates, steps: OdometrySteps) -> NDArray[np.bool_]:
    """(K - 1,) whether steps contradict the states: they have hardly any weight, or their slip is beyond all that was configured."""
    residuals = linearise_odometry(knots, steps)[:, :, -1]
    large = np.abs(knots.wheels[:, 1]) > OUTLIER_THRESHOLD * steps.slip_sigma
    return (dot(residuals, residuals) > OUTLIER_THRESHOLD**2) | large[:-1] | large[1:]


def linearise_odometry(knots: InertialStates, steps: OdometrySteps, *, shared_dim: int = 0) -> FloatArray:
    """Whitened rows of the K - 1 steps between knots, (K - 1, 3, 2 D + S + 1): in columns as those of the other factors."""
    earlier, later = knots.select(slice(None, -1)), knots.select(slice(1, None))
    size = knots.dim
    R_T = earlier.rotation.swapaxes(1, 2)
    turned = R_T @ later.rotation
    # Of the wheels' point, in the axes at the start.
    end = matvec(R_T, later.position - earlier.position) + matvec(turned, steps.arm_m)
    mean = 0.5 * (earlier.wheels + later.wheels)
    scale, direction = 1.0 + mean[:, 0] + mean[:, 1], mean[:, 2]
    along = steps.forward_m + direction[:, None] * steps.leftward_m
    rows = np.zeros((len(steps), 3, 2 * size + shared_dim + 1))
    rows[:, :, 0:3], rows[:, :, 3:6] = -R_T, skew(end)
    rows[:, :, size : size + 3], rows[:, :, size + 3 : size + 6] = R_T, -turned @ skew(steps.arm_m)
    by_wheels = np.stack([along, along, scale[:, None] * steps.leftward_m], axis=2)
    for columns in (slice(size - WHEELS_DIM, size), slice(2 * size - WHEELS_DIM, 2 * size)):
        rows[:, :, columns] = -0.5 * by_wheels
    rows[:, :, -1] = end - steps.arm_m - scale[:, None] * along
    whitened: FloatArray = steps.whitening @ rows
    return whitened


def add_wheel_processes(
    wheels: FloatArray,
    steps: OdometrySteps,
    diagonal: FloatArray,
    off_diagonal: FloatArray,
    gradient: FloatArray,
) -> float:
    """Add the processes of scale, slip and direction, (K, 3), in place; return the sum of squared Mahalanobis distances."""
    own = slice(diagonal.shape[-1] - WHEELS_DIM, diagonal.shape[-1])
    information = 1.0 / steps.process_variances()
    weighted = information * (wheels[1:] - steps.kept * wheels[:-1])
    np.einsum("kii->ki", diagonal[:-1, own, own])[...] += steps.kept**2 * information
    np.einsum("kii->ki", diagonal[1:, own, own])[...] += information
    np.einsum("kii->ki", off_diagonal[:, own, own])[...] -= steps.kept * information
    gradient[:-1, own] -= steps.kept * weighted
    gradient[1:, own] += weighted
    return wheel_process_cost(wheels, steps)


def wheel_process_cost(wheels: FloatArray, steps: OdometrySteps) -> float:
    """Sum of squared Mahalanobis distances of the processes of scale, slip and direction, (K, 3)."""
    error = wheels[1:] - steps.kept * wheels[:-1]
    return float((1.0 / steps.process_variances() * error * error).sum())
