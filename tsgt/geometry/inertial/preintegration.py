"""Preintegration of inertial samples between two times, of many intervals at once. Sans-I/O.

The samples of an interval become one relative motion with its covariance and its Jacobians by the biases, so that an
optimiser that moves the states does not integrate again (C. Forster et al., "On-manifold preintegration for real-time
visual-inertial odometry", IEEE T-RO 33(1), 2017). Here every sum over samples is a product of matrices: the only recursion is
the product of the rotations. docs/explanation/imu.md derives the sums.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.rigid import IDENTITY, FloatArray, cross, exp_and_right_jacobian, exp_so3, matvec, skew

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.geometry.inertial.samples import InertialSamples
    from tsgt.model import ImuNoise

GAP_ANGULAR_RATE_SIGMA_RADPS = 0.5
GAP_SPECIFIC_FORCE_SIGMA_MPS2 = 2.0
"""One sigma of the mean motion while samples are missing, about the mean of the samples before and after."""

_MAX_GAP_SHARE = (
    0.5  # Of a sample's duration: a sample that begins later than this after the one before leaves a gap
)
_ROWS_PER_SCAN = 4  # Samples per interval from which fewer and larger products of rotations are faster
_PARTS_PER_CHUNK = 4096  # Samples that are integrated in one pass; their matrices stay in the cache


@dataclass(frozen=True, slots=True)
class ContiguousSamples:
    """N samples without gaps: each covers the time from its own bound to the next; missing ones are filled in."""

    bounds_s: FloatArray  # (N + 1,) strictly increasing
    angular_rate_radps: FloatArray  # (N, 3) mean over the sample, in the axes of the IMU
    specific_force_mps2: FloatArray  # (N, 3)
    gyro_density: FloatArray  # (N,) square root of the noise's power spectral density, rad/s/sqrt(Hz)
    accelerometer_density: FloatArray  # (N,) m/s^2/sqrt(Hz)
    missing: NDArray[np.bool_]  # (N,) filled in

    def __len__(self) -> int:
        return len(self.angular_rate_radps)

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angular rate and specific force at M instants, (M, 3) each: linear between the middles of the samples."""
        inside = np.minimum(np.maximum(self.bounds_s.searchsorted(time_s) - 1, 0), len(self) - 1)
        # Not of all samples: few times are asked for at once.
        after_middle = 0.5 * (self.bounds_s[inside] + self.bounds_s[inside + 1]) < time_s
        later = np.minimum(np.maximum(inside + after_middle, 1), max(len(self) - 1, 1))
        earlier, later = later - 1, np.minimum(later, len(self) - 1)
        earlier_s, later_s = (
            0.5 * (self.bounds_s[rows] + self.bounds_s[rows + 1]) for rows in (earlier, later)
        )
        step_s = np.where(later > earlier, later_s - earlier_s, 1.0)
        share = np.minimum(np.maximum((time_s - earlier_s) / step_s, 0.0), 1.0)[:, None]
        rate, force = (
            values[earlier] + share * (values[later] - values[earlier])
            for values in (self.angular_rate_radps, self.specific_force_mps2)
        )
        return rate, force


def contiguous(
    samples: InertialSamples, noise: ImuNoise, *, start_s: float | None = None, end_s: float | None = None
) -> ContiguousSamples:
    """Fill the gaps between samples, at least one, and those before ``start_s`` and after ``end_s`` if there are any.

    A sample's increments of angle and velocity are those over its own duration; they are taken to be spread over the time
    since the sample before, so that jitter of the times neither adds nor loses motion.
    """
    begin_s = samples.end_s - samples.duration_s
    previous_s = np.concatenate([begin_s[:1], samples.end_s[:-1]])
    gap = begin_s - previous_s > _MAX_GAP_SHARE * samples.duration_s
    covered_s = np.where(gap, samples.duration_s, samples.end_s - previous_s)
    scale = (samples.duration_s / covered_s)[:, None]
    rate, force = samples.angular_rate_radps * scale, samples.specific_force_mps2 * scale
    ends_s, missing = samples.end_s, np.zeros(len(samples), np.bool_)
    before = np.flatnonzero(gap)
    if len(before):
        ends_s = np.insert(ends_s, before, begin_s[before])
        missing = np.insert(missing, before, True)
        rate, force = (
            np.insert(each, before, 0.5 * (each[before - 1] + each[before]), axis=0) for each in (rate, force)
        )
    bounds_s = np.concatenate([begin_s[:1], ends_s])
    if start_s is not None and start_s < bounds_s[0]:
        bounds_s, missing = np.insert(bounds_s, 0, start_s), np.insert(missing, 0, True)
        rate, force = np.concatenate([rate[:1], rate]), np.concatenate([force[:1], force])
    if end_s is not None and end_s > bounds_s[-1]:
        bounds_s, missing = np.append(bounds_s, end_s), np.append(missing, True)
        rate, force = np.concatenate([rate, rate[-1:]]), np.concatenate([force, force[-1:]])
    gyro_density = np.full(len(missing), noise.gyro_noise_density)
    accelerometer_density = np.full(len(missing), noise.accelerometer_noise_density)
    if missing.any():
        root_s = np.sqrt(np.diff(bounds_s)[missing])
        gyro_density[missing] = GAP_ANGULAR_RATE_SIGMA_RADPS * root_s
        accelerometer_density[missing] = GAP_SPECIFIC_FORCE_SIGMA_MPS2 * root_s
    return ContiguousSamples(bounds_s, rate, force, gyro_density, accelerometer_density, missing)


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """Relative motions over K intervals, in the axes of the IMU at each interval's start, without gravity.

    The error has 9 components, three each of: position, rotation (about the axes at the end, ``R Exp(d)``), velocity.
    """

    duration_s: FloatArray  # (K,)
    position: FloatArray  # (K, 3) double integral of the specific force, m
    rotation: FloatArray  # (K, 3, 3) ``R_start_end``
    velocity: FloatArray  # (K, 3) integral of the specific force, m/s
    covariance: FloatArray  # (K, 9, 9)
    by_gyro_bias: FloatArray  # (K, 9, 3) Jacobian of the error
    by_accelerometer_bias: FloatArray  # (K, 9, 3)
    gyro_bias: FloatArray  # (K, 3) bias that was subtracted, rad/s
    accelerometer_bias: FloatArray  # (K, 3) m/s^2
    missing_s: FloatArray  # (K,) time without samples
    # (K, 3) mean specific force, in the turning axes of the IMU, without the bias that was subtracted
    force: FloatArray

    def __len__(self) -> int:
        return len(self.duration_s)

    def select(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Preintegrated:
        """Return the motions over some intervals."""
        return Preintegrated(
            self.duration_s[rows],
            self.position[rows],
            self.rotation[rows],
            self.velocity[rows],
            self.covariance[rows],
            self.by_gyro_bias[rows],
            self.by_accelerometer_bias[rows],
            self.gyro_bias[rows],
            self.accelerometer_bias[rows],
            self.missing_s[rows],
            self.force[rows],
        )

    def corrected(
        self, gyro_bias: FloatArray, accelerometer_bias: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position, rotation and velocity with other biases, (K, 3) each, to first order."""
        error = matvec(self.by_gyro_bias, gyro_bias - self.gyro_bias)
        error += matvec(self.by_accelerometer_bias, accelerometer_bias - self.accelerometer_bias)
        return (
            self.position + error[:, 0:3],
            self.rotation @ exp_so3(error[:, 3:6]),
            self.velocity + error[:, 6:9],
        )


def concatenate_preintegrated(parts: list[Preintegrated]) -> Preintegrated:
    """Join motions in the given order."""
    return Preintegrated(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in Preintegrated.__slots__)
    )


def preintegrate(
    samples: ContiguousSamples,
    start_s: FloatArray,
    end_s: FloatArray,
    gyro_bias: FloatArray,
    accelerometer_bias: FloatArray,
) -> Preintegrated:
    """Preintegrate K intervals, in the order of time, from ``start_s`` to ``end_s``, (K,), within the samples' bounds.

    Samples are cut at the ends of an interval: rate and force are constant within each. Biases, (K, 3) or (3,), are
    subtracted.
    """
    biases = _biases(len(start_s), gyro_bias, accelerometer_bias)
    parts = [
        _integrate(samples, part, _integrals(samples, part))
        for part in _parts(samples, start_s, end_s, biases)
    ]
    return parts[0] if len(parts) == 1 else concatenate_preintegrated(parts)


def preintegrate_with_matrices(
    samples: ContiguousSamples,
    start_s: FloatArray,
    end_s: FloatArray,
    gyro_bias: FloatArray,
    accelerometer_bias: FloatArray,
) -> tuple[Preintegrated, FloatArray, FloatArray]:
    """Preintegrate, and Jacobians of the errors by errors of scale and misalignment, (K, 9, 3, 3) each; arguments as above.

    The first is that by E, (3, 3), if all angular rates are multiplied by ``I + E``, the second the same for specific forces.
    """
    biases = _biases(len(start_s), gyro_bias, accelerometer_bias)
    motions, by_gyro, by_accelerometer = [], [], []
    for part in _parts(samples, start_s, end_s, biases):
        found = _integrals(samples, part)
        motions.append(_integrate(samples, part, found))
        of_gyro, of_accelerometer = _by_matrices(samples, found)
        by_gyro.append(of_gyro)
        by_accelerometer.append(of_accelerometer)
    return concatenate_preintegrated(motions), np.concatenate(by_gyro), np.concatenate(by_accelerometer)


def _biases(count: int, gyro_bias: FloatArray, accelerometer_bias: FloatArray) -> FloatArray:
    biases = np.empty((count, 6))
    biases[:, :3], biases[:, 3:] = gyro_bias, accelerometer_bias
    return biases


class _Part(NamedTuple):
    """Some intervals, and at most S samples of each: ``size`` from ``first`` on."""

    start_s: FloatArray
    end_s: FloatArray
    first: NDArray[np.intp]
    size: NDArray[np.intp]
    biases: FloatArray  # (K, 6)


def _parts(
    samples: ContiguousSamples, start_s: FloatArray, end_s: FloatArray, biases: FloatArray
) -> Iterator[_Part]:
    """Divide intervals into parts of limited size."""
    count = len(start_s)
    first = samples.bounds_s.searchsorted(start_s, side="right") - 1
    first = np.minimum(np.maximum(first, 0), len(samples) - 1)
    stop = np.minimum(np.maximum(samples.bounds_s.searchsorted(end_s), first + 1), len(samples))
    size = stop - first
    if count * int(size.max(initial=0)) <= _PARTS_PER_CHUNK:
        yield _Part(start_s, end_s, first, size, biases)
        return
    begin = 0
    while begin < count:
        # Intervals of one chunk are padded to the longest.
        longest = np.maximum.accumulate(size[begin : begin + _PARTS_PER_CHUNK])
        fitting = int(np.count_nonzero(longest * np.arange(1, len(longest) + 1) <= _PARTS_PER_CHUNK))
        rows = slice(begin, begin + max(fitting, 1))
        yield _Part(start_s[rows], end_s[rows], first[rows], size[rows], biases[rows])
        begin = rows.stop


class _Integrals(NamedTuple):
    """Of K intervals and S samples of each."""

    rows: NDArray[np.intp]  # (K, S) of the samples
    dt_s: FloatArray  # (K, S) zero for padding
    remaining_s: FloatArray  # (K, S) from the middle of the sample to the end of the interval
    angle: FloatArray  # (K, S, 3)
    force: FloatArray  # (K, S, 3)
    integral: FloatArray  # (K, S, 3, 3) of the rotation to the axes at the start over each sample
    end_rotation: FloatArray  # (K, 3, 3)
    # (K, S, 6) change of velocity and of position by all later samples, and half of the own
    lever: FloatArray
    total: FloatArray  # (K, 6) change of velocity and of position by all samples


def _integrals(samples: ContiguousSamples, part: _Part) -> _Integrals:
    start_s, end_s, first, size, biases = part
    count, longest = len(size), int(size.max())
    step = np.arange(longest)
    index = np.minimum(first[:, None] + step, (first + size - 1)[:, None])
    edges_s = np.empty((count, longest + 1))
    edges_s[:, 0] = start_s
    np.minimum(samples.bounds_s[index + 1], end_s[:, None], out=edges_s[:, 1:])
    edges_s[:, -1] = end_s
    dt_s = edges_s[:, 1:] - edges_s[:, :-1]
    remaining_s = end_s[:, None] - 0.5 * (edges_s[:, 1:] + edges_s[:, :-1])
    force = samples.specific_force_mps2[index] - biases[:, None, 3:]
    angle = (samples.angular_rate_radps[index] - biases[:, None, :3]) * dt_s[..., None]
    delta_R, J_r = exp_and_right_jacobian(angle)
    rotation = np.empty((count, longest + 1, 3, 3))
    rotation[:, 0] = IDENTITY
    if longest < _ROWS_PER_SCAN * count:
        for i in range(longest):
            np.matmul(rotation[:, i], delta_R[:, i], out=rotation[:, i + 1])
    else:
        # More products in fewer calls: those of 1, 2, 4 ... successive samples.
        rotation[:, 1:] = delta_R
        width = 1
        while width < longest:
            rotation[:, 1 + width :] = rotation[:, 1:-width] @ rotation[:, 1 + width :]
            width *= 2
    # Integral of the rotation over each sample, from the axes during it to those at the start: the transpose of the right
    # Jacobian is the left one. It takes the force to an increment of velocity, and a bias to an error of rotation.
    integral = rotation[:, :-1] @ J_r.swapaxes(2, 3)
    integral *= dt_s[..., None, None]
    increment = matvec(integral, force)
    moments = increment * remaining_s[..., None]
    # An error of rotation in sample i, in the axes at the start, acts on all later increments, and half on its own.
    lever = np.concatenate([increment, moments], axis=2)
    so_far = np.cumsum(lever, axis=1)
    total = so_far[:, -1].copy()
    lever = 0.5 * lever + (total[:, None] - so_far)
    return _Integrals(index, dt_s, remaining_s, angle, force, integral, rotation[:, -1].copy(), lever, total)


def _integrate(samples: ContiguousSamples, part: _Part, found: _Integrals) -> Preintegrated:
    """Preintegrate intervals."""
    index, dt_s, remaining_s, angle, force, integral, end_rotation, lever, total = found
    count, longest = dt_s.shape
    end_rotation_T = end_rotation.swapaxes(1, 2)
    # The increment's mean time is a little off the middle of the sample, for it turns meanwhile.
    sculling = (dt_s / 12)[:, None] @ matvec(integral, cross(angle, force))

    weights = np.empty((count, longest, 8))
    weights[..., 0], weights[..., 1], weights[..., 2:] = 1.0, remaining_s, lever
    weights_T = weights.swapaxes(1, 2)
    sums = (weights_T @ integral.reshape(count, longest, 9)).reshape(count, 8, 3, 3)
    by_gyro_bias, by_accelerometer_bias = np.empty((count, 9, 3)), np.zeros((count, 9, 3))
    by_accelerometer_bias[:, 0:3], by_accelerometer_bias[:, 6:9] = -sums[:, 1], -sums[:, 0]
    by_gyro_bias[:, 0:3], by_gyro_bias[:, 6:9] = _sum_of_crosses(sums[:, 5:8]), _sum_of_crosses(sums[:, 2:5])
    by_gyro_bias[:, 3:6] = -end_rotation_T @ sums[:, 0]

    gyro_variance = samples.gyro_density[index] ** 2 * dt_s
    force_variance = samples.accelerometer_density[index] ** 2 * dt_s
    by_gyro = (weights_T * gyro_variance[:, None]) @ weights
    by_force = (weights_T[:, :2] * force_variance[:, None]) @ weights[..., :2]
    within = (force_variance * dt_s**2).sum(axis=1) / 12
    velocity = total[:, :3].copy()
    # An interval may have no length.
    whole = 1e-12 * IDENTITY - by_accelerometer_bias[:, 6:9]
    mean_force = matvec(np.asarray(np.linalg.inv(whole), np.float64), velocity)
    return Preintegrated(
        part.end_s - part.start_s,
        total[:, 3:] - sculling[:, 0],
        end_rotation,
        velocity,
        _covariance(by_gyro, by_force, within, end_rotation_T),
        by_gyro_bias,
        by_accelerometer_bias,
        part.biases[:, :3],
        part.biases[:, 3:],
        (dt_s * samples.missing[index]).sum(axis=1),
        mean_force,
    )


def _by_matrices(samples: ContiguousSamples, found: _Integrals) -> tuple[FloatArray, FloatArray]:
    """Jacobians by the matrices: a bias of each sample that is proportional to what it measures."""
    count, longest = found.dt_s.shape
    rate, force = samples.angular_rate_radps[found.rows], samples.specific_force_mps2[found.rows]
    weights = np.empty((count, longest, 27))
    weights[..., 0:3], weights[..., 21:24] = rate, force
    weights[..., 3:21] = (found.lever[..., None] * rate[:, :, None]).reshape(count, longest, 18)
    np.multiply(force, found.remaining_s[..., None], out=weights[..., 24:27])
    sums = weights.swapaxes(1, 2) @ found.integral.reshape(count, longest, 9)
    # (K, weight, component of the measured vector, 3, 3)
    by_rate, by_force = (
        sums[:, :21].reshape(count, 7, 3, 3, 3),
        sums[:, 21:].reshape(count, 2, 3, 3, 3),
    )
    by_gyro, by_accelerometer = np.empty((count, 9, 3, 3)), np.zeros((count, 9, 3, 3))
    end_rotation_T = found.end_rotation.swapaxes(1, 2)
    for column in range(3):
        by_gyro[:, 3:6, :, column] = end_rotation_T @ by_rate[:, 0, column]
        by_gyro[:, 0:3, :, column] = -_sum_of_crosses(by_rate[:, 4:7, column])
        by_gyro[:, 6:9, :, column] = -_sum_of_crosses(by_rate[:, 1:4, column])
        by_accelerometer[:, 0:3, :, column] = by_force[:, 1, column]
        by_accelerometer[:, 6:9, :, column] = by_force[:, 0, column]
    return by_gyro, by_accelerometer


def _sum_of_crosses(products: FloatArray) -> FloatArray:
    """Sum of ``skew(a) @ M``, (K, 3, 3), from the sum of the products ``a_i M_jk``, (K, 3, 3, 3)."""
    # Every product is with 0 or ±1: exact.
    crosses: FloatArray = products.reshape(-1, 27) @ _CROSSES
    return crosses.reshape(-1, 3, 3)


def _crosses() -> FloatArray:
    """(27, 9) of the products ``a_i M_jk`` to ``skew(a) @ M``, both flattened."""
    matrix = np.zeros((3, 3, 3, 3, 3))
    for i in range(3):
        row, column = (i + 1) % 3, (i + 2) % 3
        for k in range(3):
            matrix[row, column, k, i, k], matrix[column, row, k, i, k] = 1.0, -1.0
    return matrix.reshape(27, 9)


_CROSSES = _crosses()


def _covariance(
    by_gyro: FloatArray, by_force: FloatArray, within: FloatArray, end_rotation_T: FloatArray
) -> FloatArray:
    """(K, 9, 9) of white noise, from its sums over the samples of each interval.

    Each sample i has a variance of angle and one of velocity. ``by_gyro``, (K, 8, 8): sum of the first times ``u u^T`` with u of 1, the remaining time,
    and how later samples change velocity and position, 3 each; ``by_force``, (K, 2, 2): the same of the second with the first two; ``within``, (K,): of the second times dt^2 / 12.

    The error of rotation n_i, isotropic, moves the velocity by ``-skew(lever_i) n_i``, and the products of skew-symmetric
    matrices are ``skew(a) skew(b)^T = (a . b) I - b a^T``.
    """
    count = len(by_gyro)
    # The transpose of ``-skew(lever)`` is ``skew(lever)``.
    turned = end_rotation_T[:, None] @ skew(by_gyro[:, 0, 2:].reshape(count, 2, 3))
    terms = np.concatenate(
        [
            by_gyro.reshape(count, 64),
            by_force.reshape(count, 4),
            within[:, None],
            turned.reshape(count, 18),
        ],
        axis=1,
    )
    covariance: FloatArray = terms @ _COVARIANCE
    return covariance.reshape(count, 9, 9)


def _covariance_terms() -> FloatArray:
    """(87, 81) of the sums in :func:`_covariance` to the covariance, both flattened: zeros and ones."""
    by_gyro, by_force = np.arange(64).reshape(8, 8), 64 + np.arange(4).reshape(2, 2)
    within, turned = 68, 69 + np.arange(18).reshape(2, 3, 3)
    velocity, position = 0, 1  # Of what comes in the order of ``turned``
    matrix = np.zeros((87, 9, 9))
    begin = {position: 0, velocity: 6}
    for a in (position, velocity):
        for b in (position, velocity):
            product = by_gyro[2 + 3 * a : 5 + 3 * a, 2 + 3 * b : 5 + 3 * b]
            for i in range(3):
                row, column = begin[a] + i, begin[b] + i
                matrix[by_force[a, b], row, column] += 1.0
                for j in range(3):
                    matrix[product[j, j], row, column] += 1.0
                    matrix[product[j, i], row, begin[b] + j] -= 1.0
        for i in range(3):
            for j in range(3):
                matrix[turned[a, i, j], 3 + i, begin[a] + j] = 1.0
                matrix[turned[a, i, j], begin[a] + j, 3 + i] = 1.0
    for i in range(3):
        matrix[by_gyro[0, 0], 3 + i, 3 + i] = 1.0
        matrix[within, i, i] = 1.0
    return matrix.reshape(87, 81)


_COVARIANCE = _covariance_terms()
