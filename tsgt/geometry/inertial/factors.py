"""Factors of a trajectory with an IMU, and their normal equations. Sans-I/O.

Between neighbouring knots: the preintegrated motion and the random walks of the biases. Without an accelerometer the
preintegrated rotation alone, and the motion prior for position, velocity and acceleration. At knots: measurements of the
prisms, the same as without an IMU. With wheel odometry the states have three more components. docs/explanation/imu.md derives the Jacobians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.inertial.odometry import add_wheel_processes, linearise_odometry, wheel_process_cost
from tsgt.geometry.inertial.preintegration import Preintegrated, concatenate_preintegrated, preintegrate
from tsgt.geometry.inertial.states import (
    INERTIAL_STATE_DIM,
    TILT_DIM,
    Gravity,
    InertialStates,
)
from tsgt.geometry.rigid import (
    IDENTITY,
    FloatArray,
    dot,
    exp_so3,
    fast_log_so3,
    inverse_right_jacobian,
    matvec,
    skew,
)
from tsgt.geometry.trajectory.gauss_newton import add_measurements, robust_loss
from tsgt.geometry.trajectory.measurement_factors import linearise
from tsgt.geometry.trajectory.motion_prior import process_information, transition
from tsgt.geometry.trajectory.states import States

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.inertial.anchor import InertialAnchor
    from tsgt.geometry.inertial.odometry import Odometry, OdometrySteps
    from tsgt.geometry.inertial.preintegration import ContiguousSamples
    from tsgt.geometry.trajectory.measurement_factors import LinearisedMeasurements, Observations
    from tsgt.model import ImuNoise, MotionPrior

_FACTORS_PER_CHUNK = 256  # Stay in the cache


@dataclass(frozen=True, slots=True)
class InertialFactors:
    """Factors of the K - 1 steps between knots; they depend on the samples, not on the states."""

    preintegrated: Preintegrated
    whitening: FloatArray  # (K - 1, 9, 9) inverse Cholesky factor of the covariance; (K - 1, 3, 3) of the rotation alone
    walk_information: FloatArray  # (K - 1, 2) of each bias: inverse variance of its change
    # Without an accelerometer: transition, (K - 1, 3, 3), and information by axis, (K - 1, 3, 3, 3), of the motion prior
    motion: tuple[FloatArray, FloatArray] | None = None
    odometry: OdometrySteps | None = None

    def __len__(self) -> int:
        return len(self.preintegrated)

    @property
    def with_accelerometer(self) -> bool:
        """Whether the specific force is used."""
        return self.motion is None

    @classmethod
    def of(
        cls,
        samples: ContiguousSamples,
        states: InertialStates,
        noise: ImuNoise,
        *,
        gyro_only: MotionPrior | None = None,
        odometry: Odometry | None = None,
        found: Preintegrated | None = None,
    ) -> InertialFactors:
        """Preintegrate between the states' times, about their biases; ``gyro_only``: prior of the motion in place of forces.

        ``odometry``: where the states have wheels. ``found``: what is preintegrated already.
        """
        return cls.between(
            samples,
            states.select(slice(None, -1)),
            states.time_s[1:],
            noise,
            gyro_only=gyro_only,
            odometry=odometry,
            found=found,
        )

    @classmethod
    def between(
        cls,
        samples: ContiguousSamples,
        earlier: InertialStates,
        end_s: FloatArray,
        noise: ImuNoise,
        *,
        gyro_only: MotionPrior | None = None,
        odometry: Odometry | None = None,
        found: Preintegrated | None = None,
    ) -> InertialFactors:
        """Preintegrate from N states to N later times, unless that is ``found`` already."""
        if found is None:
            bias = np.zeros(3) if gyro_only else earlier.bias_or_acceleration
            found = preintegrate(samples, earlier.time_s, end_s, earlier.gyro_bias, bias)
        walks = np.array([noise.gyro_bias_walk, noise.accelerometer_bias_walk])
        walk_information = 1.0 / (walks**2 * found.duration_s[:, None])
        driven = None
        if odometry is not None:
            driven = odometry.between(samples, earlier.time_s, end_s, earlier.gyro_bias)
        if gyro_only is None:
            return cls(
                found,
                np.linalg.inv(np.linalg.cholesky(found.covariance)),
                walk_information,
                odometry=driven,
            )
        sigma = 1.0 / np.sqrt(found.covariance[:, 3, 3])
        time_s = gyro_only.acceleration_correlation_time_s
        weights = np.array(gyro_only.acceleration_sigma_mps2) ** -2.0
        information = process_information(found.duration_s, time_s)
        return cls(
            found,
            sigma[:, None, None] * IDENTITY,
            walk_information,
            (
                transition(found.duration_s, time_s),
                information[:, None] * weights[:, None, None],
            ),
            driven,
        )

    def select(self, rows: slice | NDArray[np.intp]) -> InertialFactors:
        """Return the factors of some steps."""
        return InertialFactors(
            self.preintegrated.select(rows),
            self.whitening[rows],
            self.walk_information[rows],
            None if self.motion is None else (self.motion[0][rows], self.motion[1][rows]),
            None if self.odometry is None else self.odometry.select(rows),
        )

    def joined(self, others: InertialFactors) -> InertialFactors:
        """Return these factors, then the others."""
        motion = None
        if self.motion is not None and others.motion is not None:
            motion = (
                np.concatenate([self.motion[0], others.motion[0]]),
                np.concatenate([self.motion[1], others.motion[1]]),
            )
        return InertialFactors(
            concatenate_preintegrated([self.preintegrated, others.preintegrated]),
            np.concatenate([self.whitening, others.whitening]),
            np.concatenate([self.walk_information, others.walk_information]),
            motion,
            None
            if self.odometry is None or others.odometry is None
            else self.odometry.joined(others.odometry),
        )


class InertialEquations(NamedTuple):
    """Normal equations of K states and of what they share, the S components of `Gravity`, which borders them."""

    diagonal: FloatArray  # (K, D, D)
    off_diagonal: FloatArray  # (K - 1, D, D)
    gradient: FloatArray  # (K, D)
    border: FloatArray  # (K, D, S) of states and what they share
    corner: FloatArray  # (S, S)
    corner_gradient: FloatArray  # (S,)
    cost: float  # Minus twice the log posterior density, up to a constant
    squared_distances: FloatArray  # (M,) squared Mahalanobis distance of each measurement's residual
    weights: FloatArray  # (M,) of the robust loss
    linearised: LinearisedMeasurements
    whitened: FloatArray  # (M, 3, D + 1) Jacobians and residuals of measurements, without the robust weights


def assemble_inertial(
    observations: Observations,
    knot_index: NDArray[np.intp],
    knots: InertialStates,
    kinematics: tuple[FloatArray, FloatArray],
    gravity: Gravity,
    factors: InertialFactors,
    anchor: InertialAnchor,
    *,
    active: NDArray[np.bool_] | None = None,
    rejectable: NDArray[np.bool_] | None = None,
) -> InertialEquations:
    """Assemble the normal equations at a trajectory.

    The layout of ``observations`` is from the IMU's origin in its axes. ``kinematics``: angular rate and specific force at
    the knots, (K, 3) each, biases included. ``active`` and ``rejectable``: as without an IMU.
    """
    count, size, shared = len(knots), knots.dim, gravity.dim
    earlier_part, later_part = slice(0, size), slice(size, 2 * size)
    shared_part, residual = slice(2 * size, 2 * size + shared), 2 * size + shared
    states = _as_states(knots, kinematics, gravity.vector(), with_accelerometer=factors.with_accelerometer)
    linearised = linearise(observations, states, knot_index)
    whitened = by_inertial_states(
        linearised.whitened(observations), gyro_only=not factors.with_accelerometer, dim=size
    )
    squared_distances = dot(whitened[:, :, size], whitened[:, :, size])
    weights, loss = robust_loss(squared_distances, active=active, rejectable=rejectable)
    diagonal = np.zeros((count, size, size))
    off_diagonal = np.zeros((count - 1, size, size))
    gradient, border = np.zeros((count, size)), np.zeros((count, size, shared))
    corner, corner_gradient = np.zeros((shared, shared)), np.zeros(shared)
    add_measurements(whitened, weights, knot_index, diagonal, gradient)
    cost = float(loss.sum())
    for start in range(0, count - 1, _FACTORS_PER_CHUNK):
        chunk = slice(start, min(start + _FACTORS_PER_CHUNK, count - 1))
        later = slice(chunk.start + 1, chunk.stop + 1)
        some, steps = knots.select(slice(chunk.start, later.stop)), factors.select(chunk)
        rows = linearise_inertial(some, gravity, steps)
        normal = rows.swapaxes(1, 2) @ rows
        cost += float(normal[:, residual, residual].sum())
        if steps.odometry is not None:
            rows = linearise_odometry(some, steps.odometry, shared_dim=shared)
            odometry_weights, odometry_loss = robust_loss(dot(rows[:, :, residual], rows[:, :, residual]))
            normal += (rows * odometry_weights[:, None, None]).swapaxes(1, 2) @ rows
            cost += float(odometry_loss.sum())
        diagonal[chunk] += normal[:, earlier_part, earlier_part]
        diagonal[later] += normal[:, later_part, later_part]
        off_diagonal[chunk] += normal[:, earlier_part, later_part]
        gradient[chunk] += normal[:, earlier_part, residual]
        gradient[later] += normal[:, later_part, residual]
        border[chunk] += normal[:, earlier_part, shared_part]
        border[later] += normal[:, later_part, shared_part]
        corner += normal[:, shared_part, shared_part].sum(axis=0)
        corner_gradient += normal[:, shared_part, residual].sum(axis=0)
    cost += _add_walks(knots, factors, diagonal, off_diagonal, gradient)
    if factors.odometry is not None:
        cost += add_wheel_processes(knots.wheels, factors.odometry, diagonal, off_diagonal, gradient)

    first = knots.select(slice(0, 1))
    error = anchor.errors(first, gravity.shared[None])[0]
    by_error = anchor.jacobian(first, error)
    weighted = by_error.T @ anchor.information
    information, by_anchor = weighted @ by_error, weighted @ error
    diagonal[0] += information[:size, :size]
    gradient[0] += by_anchor[:size]
    border[0] += information[:size, size:]
    corner += information[size:, size:]
    corner_gradient += by_anchor[size:]
    cost += float(error @ anchor.information @ error)
    return InertialEquations(
        diagonal,
        off_diagonal,
        gradient,
        border,
        corner,
        corner_gradient,
        cost,
        squared_distances,
        weights,
        linearised,
        whitened,
    )


def linearise_inertial(knots: InertialStates, gravity: Gravity, factors: InertialFactors) -> FloatArray:
    """Whitened rows of the K - 1 factors between knots, (K - 1, R, 2 D + S + 1), but for the walks of the biases.

    Columns: the errors of the earlier state, D, of the later one, D, of what they share, S, and the residual. D is 15 without
    wheel odometry.
    """
    size = knots.dim
    tilt_part, column = slice(2 * size, 2 * size + TILT_DIM), 2 * size + gravity.dim
    matrix_part = slice(tilt_part.stop, column)
    found = factors.preintegrated
    gyro_only = not factors.with_accelerometer
    earlier, later = knots.select(slice(None, -1)), knots.select(slice(1, None))
    error = gravity.force_error(found.force)
    position, rotation, velocity = _motion(earlier, found, error, gyro_only=gyro_only)
    R_T = earlier.rotation.swapaxes(1, 2)
    turned = R_T @ later.rotation
    residual = fast_log_so3(rotation.swapaxes(1, 2) @ turned)
    J_r_inv = inverse_right_jacobian(residual)
    by_rotation = np.zeros((len(found), 3, column + 1))
    by_rotation[:, :, 3:6] = -J_r_inv @ turned.swapaxes(1, 2)
    # The correction by the bias is applied to the preintegrated rotation on its right.
    correction = exp_so3(-residual)
    by_rotation[:, :, 9:12] = -J_r_inv @ correction @ found.by_gyro_bias[:, 3:6]
    by_rotation[:, :, size + 3 : size + 6] = J_r_inv
    by_rotation[:, :, column] = residual
    if gyro_only:
        whitened = factors.whitening @ by_rotation
        return np.concatenate([whitened, _motion_rows(earlier, later, factors, gravity.dim)], axis=1)
    duration_s = found.duration_s[:, None]
    moved, gained = _moved_and_gained(earlier, later, duration_s, gravity.vector())
    by_tilt = R_T @ gravity.by_tilt()
    rows = np.zeros((len(found), 9, column + 1))
    rows[:, 0:3, 0:3], rows[:, 0:3, size : size + 3] = -R_T, R_T
    rows[:, 0:3, 3:6] = skew(moved)
    rows[:, 0:3, 6:9] = -duration_s[..., None] * R_T
    rows[:, 0:3, tilt_part] = -0.5 * duration_s[..., None] ** 2 * by_tilt
    rows[:, 0:3, column] = moved - position
    rows[:, 6:9, 3:6] = skew(gained)
    rows[:, 6:9, 6:9], rows[:, 6:9, size + 6 : size + 9] = -R_T, R_T
    rows[:, 6:9, tilt_part] = -duration_s[..., None] * by_tilt
    rows[:, 6:9, column] = gained - velocity
    rows[:, :, 9:12] = -found.by_gyro_bias
    rows[:, :, 12:15] = -found.by_accelerometer_bias
    rows[:, :, matrix_part] = -gravity.by_matrix(found.by_accelerometer_bias, found.force)
    rows[:, 3:6] = by_rotation
    whitened_rows: FloatArray = factors.whitening @ rows
    return whitened_rows


def _motion(
    earlier: InertialStates, found: Preintegrated, force_error: FloatArray, *, gyro_only: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, rotation and velocity preintegrated from K states, with their biases."""
    if gyro_only:
        return found.corrected(earlier.gyro_bias, found.accelerometer_bias)
    return found.corrected(earlier.gyro_bias, earlier.bias_or_acceleration + force_error)


def _moved_and_gained(
    earlier: InertialStates, later: InertialStates, duration_s: FloatArray, fall: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(K, 3) each: what states say of the preintegrated position and velocity, in the axes of the earlier ones.

    ``duration_s``: (K, 1); ``fall``: acceleration of a falling body, (3,) or (K, 3).
    """
    R_T = earlier.rotation.swapaxes(1, 2)
    drifted = later.position - earlier.position - earlier.velocity * duration_s
    moved = matvec(R_T, drifted - 0.5 * duration_s**2 * fall)
    return moved, matvec(R_T, later.velocity - earlier.velocity - duration_s * fall)


def inertial_costs(
    observations: Observations,
    knot_index: NDArray[np.intp],
    trajectories: InertialStates,
    gravities: Sequence[Gravity],
    kinematics: tuple[FloatArray, FloatArray],
    factors: InertialFactors,
    anchor: InertialAnchor,
    *,
    rejectable: NDArray[np.bool_] | None = None,
) -> FloatArray:
    """Return the cost of each of N trajectories of the same knots, (N,), as :func:`assemble_inertial` gives it.

    ``trajectories``: states of the first, then of the second, and so on; ``gravities``: of each. All are computed in one pass, without Jacobians: a search along a line needs no more of the points that it rejects.
    """
    number, count = len(gravities), len(kinematics[0])
    with_accelerometer = factors.with_accelerometer
    falls = np.array([gravity.vector() for gravity in gravities])
    states = _as_states(
        trajectories,
        (np.tile(kinematics[0], (number, 1)), np.tile(kinematics[1], (number, 1))),
        np.repeat(falls, count, axis=0),
        with_accelerometer=with_accelerometer,
    )
    first_rows = count * np.arange(number)
    measured = observations.select(np.tile(np.arange(len(observations)), number))
    linearised = linearise(measured, states, (knot_index + first_rows[:, None]).ravel())
    residuals = linearised.whitened(measured)[:, :, -1]
    squares = dot(residuals, residuals).reshape(number, -1)
    if rejectable is None:
        costs: FloatArray = robust_loss(squares)[1].sum(axis=1)
    else:
        costs = np.array([robust_loss(each, rejectable=rejectable)[1].sum() for each in squares])

    rows = (np.arange(count - 1) + first_rows[:, None]).ravel()
    earlier, later = trajectories.select(rows), trajectories.select(rows + 1)
    steps = factors.select(np.tile(np.arange(count - 1), number))
    found = steps.preintegrated
    error = np.zeros((len(found), 3))
    if anchor.shared.size > TILT_DIM:
        force = factors.preintegrated.force
        error = np.concatenate([gravity.force_error(force) for gravity in gravities])
    position, rotation, velocity = _motion(earlier, found, error, gyro_only=not with_accelerometer)
    turned = fast_log_so3(rotation.swapaxes(1, 2) @ (earlier.rotation.swapaxes(1, 2) @ later.rotation))
    walks = [(earlier.gyro_bias, later.gyro_bias, steps.walk_information[:, 0])]
    if with_accelerometer:
        fall = np.repeat(falls, count - 1, axis=0)
        moved, gained = _moved_and_gained(earlier, later, found.duration_s[:, None], fall)
        residual = np.concatenate([moved - position, turned, gained - velocity], axis=1)
        squares = matvec(steps.whitening, residual) ** 2
        walks.append((earlier.bias_or_acceleration, later.bias_or_acceleration, steps.walk_information[:, 1]))
    else:
        of_motion = _motion_rows(earlier, later, steps, 0)[:, :, -1]
        squares = np.concatenate([matvec(steps.whitening, turned), of_motion], axis=1) ** 2
    costs += squares.reshape(number, -1).sum(axis=1)
    for before, after, information in walks:
        costs += (information[:, None] * (after - before) ** 2).reshape(number, -1).sum(axis=1)
    if factors.odometry is not None:
        for row, first_row in enumerate(first_rows.tolist()):
            each = trajectories.select(slice(first_row, first_row + count))
            residuals = linearise_odometry(each, factors.odometry)[:, :, -1]
            costs[row] += float(robust_loss(dot(residuals, residuals))[1].sum())
            costs[row] += wheel_process_cost(each.wheels, factors.odometry)

    shared = np.array([gravity.shared for gravity in gravities])
    errors = anchor.errors(trajectories.select(first_rows), shared)
    costs += ((errors @ anchor.information) * errors).sum(axis=1)
    return costs


def _motion_rows(
    earlier: InertialStates, later: InertialStates, factors: InertialFactors, shared: int
) -> FloatArray:
    """(K - 1, 9, 2 D + S + 1) whitened rows of the motion prior on position, velocity and acceleration, axis by axis."""
    assert factors.motion is not None  # noqa: S101 (only called without an accelerometer)
    phi, information = factors.motion
    roots = np.swapaxes(np.linalg.cholesky(information), 2, 3)
    size = earlier.dim
    rows = np.zeros((len(phi), 9, 2 * size + shared + 1))
    for axis in range(3):
        own = rows[:, 3 * axis : 3 * axis + 3]
        columns = np.array([axis, 6 + axis, 12 + axis])
        own[:, :, columns], own[:, :, size + columns] = -roots[:, axis] @ phi, roots[:, axis]
        before, after = (
            np.stack(
                [each.position[:, axis], each.velocity[:, axis], each.bias_or_acceleration[:, axis]], axis=1
            )
            for each in (earlier, later)
        )
        # Counted from the earlier position, which keeps the digits of short steps.
        after[:, 0] -= before[:, 0]
        before[:, 0] = 0.0
        own[:, :, -1] = matvec(roots[:, axis], after - matvec(phi, before))
    return rows


def _add_walks(
    knots: InertialStates,
    factors: InertialFactors,
    diagonal: FloatArray,
    off_diagonal: FloatArray,
    gradient: FloatArray,
) -> float:
    """Add the random walks of the biases, in place; return the sum of squared Mahalanobis distances."""
    number = 2 if factors.with_accelerometer else 1
    components = slice(9, 9 + 3 * number)
    bias = np.concatenate([knots.gyro_bias, knots.bias_or_acceleration], axis=1)[:, : 3 * number]
    information = np.repeat(factors.walk_information[:, :number], 3, axis=1)
    step = bias[1:] - bias[:-1]
    weighted = information * step
    of_knots, of_steps = (np.einsum("kii->ki", each)[:, components] for each in (diagonal, off_diagonal))
    of_knots[:-1] += information
    of_knots[1:] += information
    of_steps -= information
    gradient[:-1, components] -= weighted
    gradient[1:, components] += weighted
    return float((weighted * step).sum())


def _as_states(
    knots: InertialStates,
    kinematics: tuple[FloatArray, FloatArray],
    fall: FloatArray,
    *,
    with_accelerometer: bool,
) -> States:
    """States as measurement factors take them: rate and acceleration are those of the samples at the knots.

    ``fall``: acceleration of a falling body, (3,) or (K, 3).
    """
    rate, force = kinematics
    if with_accelerometer:
        acceleration = matvec(knots.rotation, force - knots.bias_or_acceleration) + fall
    else:
        acceleration = knots.bias_or_acceleration
    zero = np.zeros_like(rate)
    return States(
        knots.time_s,
        knots.position,
        knots.rotation,
        knots.velocity,
        rate - knots.gyro_bias,
        acceleration,
        zero,
    )


def by_inertial_states(rows: FloatArray, *, gyro_only: bool, dim: int = INERTIAL_STATE_DIM) -> FloatArray:
    """Rows of measurements by the 18 components of a state without IMU, (M, 3, 19), as rows by those with, (M, 3, D + 1).

    The last column of both is the residual.

    The acceleration acts over the time from the knot to the measurement, at most 10 ms, over which neither the bias of the
    accelerometer nor the rotation changes it by what could be measured.
    """
    inertial = np.zeros((*rows.shape[:2], dim + 1))
    inertial[:, :, 0:9] = rows[:, :, 0:9]
    inertial[:, :, 9:12] = -rows[:, :, 9:12]
    if gyro_only:
        inertial[:, :, 12:15] = rows[:, :, 12:15]
    inertial[:, :, dim] = rows[:, :, 18]
    return inertial
