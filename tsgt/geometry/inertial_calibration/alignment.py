"""First guess of an IMU's mounting and latency: its rates and forces against those of the stations' trajectory. Sans-I/O.

At a latency, the rotation that takes the IMU's rates to the robot's best has a closed form (G. Wahba, SIAM Review 7, 1965), and
so has the remaining sum of squares, which is least at the right latency. Both are blind to a bias, whatever the mounting. A
robot that turns about one axis only leaves the rotation about this axis open; the specific forces determine it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tsgt.errors import GeometryError
from tsgt.geometry.rigid import matvec

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial import Gravity, InertialSamples
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import States, Trajectory

GRID_S = 0.02
SMOOTHING_S = 0.4  # Of rates and forces of both sides: what the stations can follow
MAX_LATENCY_S = 10.0
RATE_SIGMA_RADPS = 0.02
FORCE_SIGMA_MPS2 = (
    0.5  # Of the difference between the IMU and the stations, smoothed; includes the lever arm's
)
MAX_RATE_SIGMA_RADPS = 0.1
"""Of the trajectory's rates, where they are compared. Three prisms tell them to 0.015, two to 0.06; one alone does not."""
MIN_TURNING_RADPS = 0.03  # rms about the mean
MIN_CORRELATION = 0.96
"""Of rates without noise; the share of the noise is the sigma above. The slow turns of two drives may agree to 0.95."""
MIN_OVERLAP_S = 20.0

_RATE = slice(9, 12)  # Components of the error of a state


class UnrelatedRatesError(GeometryError):
    """No latency explains the rates: the samples are not the robot's."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """Mounting and latency of an IMU by rates and forces alone: to degrees and hundredths of a second."""

    rotation: FloatArray  # (3, 3) ``R_robot_imu``
    latency_s: float
    gyro_bias: FloatArray  # (3,) in the axes of the IMU
    correlation: float  # Of the angular rates, 0 to 1, at that latency


@dataclass(frozen=True, slots=True)
class Series:
    """Angular rates and specific forces on a grid, smoothed, (N, 3) each."""

    start_s: float
    rate: FloatArray
    force: FloatArray
    known: NDArray[np.bool_]  # (N,) where they hold

    def select(self, rows: NDArray[np.intp]) -> Series:
        """Return points of the grid, in its order."""
        return Series(self.start_s, self.rate[rows], self.force[rows], self.known[rows])


class Products(NamedTuple):
    """Sums of products of the robot's and the IMU's vectors, in their sigmas, as of independent instants."""

    rates: FloatArray  # (3, 3) about the means
    forces: FloatArray  # (3, 3)


def series_of_trajectory(trajectory: Trajectory, gravity: Gravity) -> Series:
    """Rates and forces in the axes of the robot on a grid, known where enough prisms were measured to tell the rates."""
    series = series_of_states(trajectory.knots, gravity)
    grid_s = series.start_s + np.arange(len(series.known)) * GRID_S
    variance = np.trace(trajectory.covariance[:, _RATE, _RATE], axis1=1, axis2=2)
    certain = np.interp(grid_s, trajectory.knots.time_s, np.sqrt(variance)) < MAX_RATE_SIGMA_RADPS
    return replace(series, known=series.known & certain)


def series_of_states(states: States, gravity: Gravity) -> Series:
    """Rates and forces in the axes of the robot from states, on a grid."""
    start_s = float(states.time_s[0])
    grid_s = start_s + np.arange(int((states.time_s[-1] - start_s) / GRID_S) + 1, dtype=np.float64) * GRID_S
    to_robot = np.swapaxes(states.rotation, 1, 2)
    force = matvec(to_robot, states.acceleration - gravity.vector())
    later = np.clip(np.searchsorted(states.time_s, grid_s), 1, len(states) - 1)
    known = states.time_s[later] - states.time_s[later - 1] < 2 * SMOOTHING_S
    return _smoothed(start_s, grid_s, states.time_s, states.angular_velocity, force, known)


def series_of_samples(samples: InertialSamples) -> Series:
    """Rates and forces in the axes of the IMU on a grid of its stamps."""
    start_s = float(samples.end_s[0])
    grid_s = start_s + np.arange(int((samples.end_s[-1] - start_s) / GRID_S) + 1, dtype=np.float64) * GRID_S
    middle_s = samples.end_s - 0.5 * samples.duration_s
    # Integrals, so that shaking between the points of the grid does not count.
    rate, force = (
        _mean_over_grid(grid_s, middle_s, samples.duration_s, values)
        for values in (samples.angular_rate_radps, samples.specific_force_mps2)
    )
    later = np.clip(np.searchsorted(samples.end_s, grid_s), 1, len(samples) - 1)
    known = samples.end_s[later] - samples.end_s[later - 1] < SMOOTHING_S
    return _smoothed(start_s, grid_s, grid_s, rate, force, known)


def align(
    robot: Series, imu: Series, *, min_overlap_s: float = MIN_OVERLAP_S, max_latency_s: float = MAX_LATENCY_S
) -> Alignment:
    """Find mounting and latency.

    Raises GeometryError: the robot hardly turns, or both have too little in common. Raises UnrelatedRatesError: no latency explains the
    rates.
    """
    if not turns(robot):
        raise GeometryError(
            f"the robot hardly turns (rms below {np.degrees(MIN_TURNING_RADPS):.1f} deg/s): drive curves, slopes and bumps"
        )
    lags, scores = _rate_scores(robot, imu, min_overlap_s, max_latency_s)
    best = int(np.argmax(scores))
    correlation = float(scores[best])
    turning = _turning(robot)
    if correlation < MIN_CORRELATION * turning / np.hypot(turning, RATE_SIGMA_RADPS):
        raise UnrelatedRatesError(
            "the angular rates of the IMU are not those of the robot at any latency"
            f"{f' within {max_latency_s:g} s' if np.isfinite(max_latency_s) else ''} "
            f"(correlation {correlation:.2f}): another recording's IMU, or damaged samples"
        )
    latency_s = imu.start_s - robot.start_s + float(lags[best]) * GRID_S
    if 0 < best < len(scores) - 1:
        before, at, after = scores[best - 1 : best + 2]
        curvature = before - 2 * at + after
        if curvature < 0:
            latency_s += 0.5 * GRID_S * float((before - after) / curvature)
    products = products_at(robot, imu, latency_s)
    rotation = nearest_rotation(products.rates + products.forces)
    ours, theirs = _overlap(robot, imu, int(lags[best]))
    gyro_bias = np.asarray((imu.rate[theirs] - robot.rate[ours] @ rotation).mean(axis=0))
    return Alignment(rotation, latency_s, gyro_bias, correlation)


def turns(robot: Series) -> bool:
    """Whether a robot turns enough to align its rates."""
    return _turning(robot) >= MIN_TURNING_RADPS


def _turning(robot: Series) -> float:
    if not robot.known.any():
        return 0.0
    return float(np.sqrt(np.var(robot.rate[robot.known], axis=0).sum()))


def products_at(robot: Series, imu: Series, latency_s: float) -> Products:
    """Return sums of products at a latency, to the nearest step of the grid."""
    ours, theirs = overlap_at(robot, imu, latency_s)
    w, g = robot.rate[ours], imu.rate[theirs]
    rates = (w - w.mean(axis=0)).T @ (g - g.mean(axis=0)) / RATE_SIGMA_RADPS**2
    forces = robot.force[ours].T @ imu.force[theirs] / FORCE_SIGMA_MPS2**2
    share = GRID_S / SMOOTHING_S  # Of the points of the grid
    return Products(share * rates, share * forces)


def overlap_at(robot: Series, imu: Series, latency_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of both series at a latency, to the nearest step of the grid, where both are known."""
    return _overlap(robot, imu, round((latency_s + robot.start_s - imu.start_s) / GRID_S))


def nearest_rotation(products: FloatArray) -> FloatArray:
    """Rotation R, (3, 3), that maximises ``trace(R^T products)``: it aligns ``b`` to ``a`` if products are sums of ``a b^T``."""
    left, _, right = np.linalg.svd(products)
    rotation: FloatArray = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return rotation


def _rate_scores(
    robot: Series, imu: Series, min_overlap_s: float, max_latency_s: float
) -> tuple[NDArray[np.intp], FloatArray]:
    """Shifts of the IMU's grid against the robot's, in steps, and the correlation of the rates, aligned, at each."""
    from scipy.fft import irfft, next_fast_len, rfft  # noqa: PLC0415 (programs without an IMU start without it)

    lags = np.arange(-len(robot.rate) + 1, len(imu.rate))
    known, theirs = robot.known.astype(np.float64), imu.known.astype(np.float64)
    a, b = robot.rate * known[:, None], imu.rate * theirs[:, None]

    def correlated(x: FloatArray, y: FloatArray) -> FloatArray:
        # Not scipy.signal, nor its ndimage below: to import them takes longer than all else of this module.
        length = len(x) + len(y) - 1
        size = next_fast_len(length, real=True)
        return np.asarray(irfft(rfft(y, size) * rfft(x[::-1], size), size))[:length]

    count = np.maximum(correlated(known, theirs), 0.5)
    sum_a = np.stack([correlated(a[:, i], theirs) for i in range(3)], axis=1)
    sum_b = np.stack([correlated(known, b[:, i]) for i in range(3)], axis=1)
    products = np.stack(
        [np.stack([correlated(a[:, i], b[:, j]) for j in range(3)], axis=1) for i in range(3)], axis=1
    )
    products -= sum_a[:, :, None] * sum_b[:, None, :] / count[:, None, None]
    square_a = correlated((a**2).sum(axis=1), theirs) - (sum_a**2).sum(axis=1) / count
    square_b = correlated(known, (b**2).sum(axis=1)) - (sum_b**2).sum(axis=1) / count
    latency_s = imu.start_s - robot.start_s + lags * GRID_S
    allowed = (np.abs(latency_s) <= max_latency_s) & (count * GRID_S >= min_overlap_s)
    if not allowed.any():
        raise GeometryError(
            f"samples of the IMU and measurements have less than {min_overlap_s:g} s in common"
        )
    lags, products = lags[allowed], products[allowed]
    singular = np.linalg.svd(products, compute_uv=False)
    aligned = singular.sum(axis=1) - 2 * singular[:, 2] * (np.linalg.det(products) < 0)
    energy = np.sqrt(np.maximum(square_a[allowed] * square_b[allowed], 1e-12))
    return lags, aligned / energy


def _overlap(robot: Series, imu: Series, lag: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of both series at a shift where both are known."""
    ours = np.arange(max(0, -lag), min(len(robot.rate), len(imu.rate) - lag))
    ours = ours[robot.known[ours] & imu.known[ours + lag]]
    return ours, ours + lag


def _mean_over_grid(
    grid_s: FloatArray, middle_s: FloatArray, duration_s: FloatArray, values: FloatArray
) -> FloatArray:
    """Mean of samples about each point of the grid, (N, 3)."""
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(values * duration_s[:, None], axis=0)])
    time = np.concatenate([[0.0], np.cumsum(duration_s)])
    edges = np.searchsorted(middle_s, np.append(grid_s, grid_s[-1] + GRID_S) - 0.5 * GRID_S)
    seconds = np.diff(time[edges])
    filled = seconds > 0
    means = np.diff(integral[edges], axis=0)[filled] / seconds[filled, None]
    return np.stack([np.interp(grid_s, grid_s[filled], each) for each in means.T], axis=1)


def _smoothed(
    start_s: float,
    grid_s: FloatArray,
    time_s: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    known: NDArray[np.bool_],
) -> Series:
    width = round(SMOOTHING_S / GRID_S)

    def smoothed(values: FloatArray) -> FloatArray:
        on_grid = np.stack([np.interp(grid_s, time_s, each) for each in values.T], axis=1)
        padded = np.pad(on_grid, ((width // 2, (width - 1) // 2), (0, 0)), mode="edge")
        return np.asarray(sliding_window_view(padded, width, axis=0).mean(axis=-1))

    return Series(start_s, smoothed(rate), smoothed(force), known)
