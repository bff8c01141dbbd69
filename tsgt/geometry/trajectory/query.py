"""A fitted trajectory at any instant: pose, velocity, covariance. Pure.

Between two knots the motion prior interpolates, given both (S. Anderson and others, "Batch nonlinear continuous-time
trajectory estimation as exactly sparse Gaussian process regression", Autonomous Robots 39, 2015); before the first and after
the last one it predicts, and the covariance grows as it honestly must.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import (
    IDENTITY,
    FloatArray,
    cross,
    exp_and_right_jacobian,
    inverse_right_jacobian,
    matvec,
    skew,
)
from tsgt.geometry.trajectory.motion_prior import (
    axis_sigmas,
    interpolation_weights,
    process_noise,
    transition,
)
from tsgt.geometry.trajectory.states import (
    STATE_DIM,
    States,
    axes_to_state,
    concatenate_states,
    rotation_between,
)

if TYPE_CHECKING:
    from tsgt.model import MotionPrior

_AT_ONCE = 512
"""What is made of so many instants stays in the cache: a third faster than eight times as many."""

_EYE = np.eye(STATE_DIM)[None]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A robot's motion with its uncertainty.

    Attributes
    ----------
    knots
        States at K instants.
    prior
        How the robot moves between them.
    covariance
        (K, 18, 18) of the states' errors.
    beside
        (K - 1, 18, 18) covariance of each state's error (rows) with the next one's (columns).
    sigmas
        (K - 1, 6) one sigma of the acceleration of each axis in each step, where it is not that of ``prior``.
    """

    knots: States
    prior: MotionPrior
    covariance: FloatArray
    cross_covariance: FloatArray
    sigmas: FloatArray | None = None

    def at(self, time_s: FloatArray, *, dim: int = STATE_DIM) -> tuple[States, FloatArray]:
        """Return the states at N instants, in any order, and the covariance of their errors.

        Parameters
        ----------
        time_s
            (N,).
        parts
            So many of the first parts of the errors are told of: all 18, or 6 for poses, which is much faster.

        Returns
        -------
        states : Knots
        covariance : FloatArray
            (N, dim, dim).
        """
        found = [self._at(time_s[i : i + _AT_ONCE], dim) for i in range(0, len(time_s), _AT_ONCE)]
        if len(found) == 1:
            return found[0]
        if not found:
            return self.knots.select(slice(0, 0)), np.empty((0, dim, dim))
        return concatenate_states([states for states, _ in found]), np.concatenate(
            [covariance for _, covariance in found]
        )

    def _at(self, time_s: FloatArray, dim: int) -> tuple[States, FloatArray]:
        later = np.searchsorted(self.knots.time_s, time_s, side="left")
        inside = (later > 0) & (later < len(self.knots))
        if inside.all():
            return self._between(time_s, later, dim)
        states, covariance = self._beyond(time_s, np.clip(later - 1, 0, None), dim)
        if inside.any():
            some, some_covariance = self._between(time_s[inside], later[inside], dim)
            for name in States.__slots__:
                getattr(states, name)[inside] = getattr(some, name)
            covariance[inside] = some_covariance
        return states, covariance

    def _beyond(self, time_s: FloatArray, knot: np.ndarray, dim: int) -> tuple[States, FloatArray]:
        """Predict from one knot, forwards or backwards: the prior's process looks the same either way."""
        start = self.knots.select(knot)
        dt_s = time_s - start.time_s
        ahead_s = np.abs(dt_s)[:, None]
        times_s, sigmas = self._times_s(), axis_sigmas(self.prior)
        phi = np.repeat(transition(ahead_s, times_s), 3, axis=1)
        noise = np.repeat(process_noise(ahead_s, times_s), 3, axis=1) * (sigmas**2)[:, None, None]
        # Backwards a velocity has the other sign, and with it what couples it with position and acceleration.
        flip = np.where(dt_s < 0, -1.0, 1.0)[:, None]
        for row, column in ((0, 1), (1, 0), (1, 2), (2, 1)):
            phi[..., row, column] *= flip
            noise[..., row, column] *= flip
        zero = np.zeros((len(time_s), 6))
        moved = phi @ np.stack([zero, _velocities(start), _accelerations(start)], axis=-1)[..., None]
        moved = moved[..., 0]
        wander, before, here = (dt_s**2 / 12)[:, None], start.angular_velocity, moved[:, 3:, 1]
        turn = moved[:, 3:, 0] + wander * cross(before, here)
        turned, by_turn = exp_and_right_jacobian(turn)
        states = _states(time_s, start.position + moved[:, :3, 0], start.rotation @ turned, moved)
        to_error = _to_error(by_turn, wander, before)
        by_start = to_error @ axes_to_state(phi)
        by_start[:, 3:6, 9:12] -= by_turn @ (wander[..., None] * skew(here))
        by_start[:, 3:6, 3:6] = np.swapaxes(turned, 1, 2)
        by_start, to_error = by_start[:, :dim], to_error[:, :dim]
        covariance = by_start @ self.covariance[knot] @ np.swapaxes(by_start, 1, 2)
        return states, _symmetric(covariance + to_error @ axes_to_state(noise) @ np.swapaxes(to_error, 1, 2))

    def _between(self, time_s: FloatArray, later: np.ndarray, dim: int) -> tuple[States, FloatArray]:
        before, after = self.knots.select(later - 1), self.knots.select(later)
        dt_s, step_s = time_s - before.time_s, after.time_s - before.time_s
        # Both kinds of axes, each for its three.
        from_earlier, from_later, left = (
            np.repeat(matrix, 3, axis=1)
            for matrix in interpolation_weights(dt_s[:, None], (step_s - dt_s)[:, None], self._times_s())
        )
        wander, rate, later_rate = (step_s**2 / 12)[:, None], before.angular_velocity, after.angular_velocity
        full_turn = rotation_between(before, after)
        turn = full_turn - wander * cross(rate, later_rate)
        zero = np.zeros((len(time_s), 3))
        earlier = np.stack(
            [np.concatenate([before.position, zero], axis=1), _velocities(before), _accelerations(before)],
            axis=-1,
        )
        at_later = np.stack(
            [np.concatenate([after.position, turn], axis=1), _velocities(after), _accelerations(after)],
            axis=-1,
        )
        found = (from_earlier @ earlier[..., None] + from_later @ at_later[..., None])[..., 0]
        wander_here, here = (dt_s**2 / 12)[:, None], found[:, 3:, 1]
        found_turn = found[:, 3:, 0] + wander_here * cross(rate, here)
        turned, by_found_turn = exp_and_right_jacobian(found_turn)
        states = _states(time_s, found[:, :3, 0], before.rotation @ turned, found)
        by_earlier, by_later = axes_to_state(from_earlier), axes_to_state(from_later)
        # The later rotation enters by the turn from the earlier one, less its wander; the result's by the turn to it.
        by_turn, turn_by_later = by_later[:, :, 3:6].copy(), inverse_right_jacobian(full_turn)
        by_later[:, :, 3:6] = by_turn @ turn_by_later
        by_later[:, :, 9:12] -= by_turn @ (wander[..., None] * skew(rate))
        # Of the opposite turn it is the transpose.
        by_earlier[:, :, 3:6] = -by_turn @ np.swapaxes(turn_by_later, 1, 2)
        by_earlier[:, :, 9:12] += by_turn @ (wander[..., None] * skew(later_rate))
        to_error = _to_error(by_found_turn, wander_here, rate)[:, :dim]
        by_earlier, by_later = to_error @ by_earlier, to_error @ by_later
        by_earlier[:, 3:6, 9:12] -= by_found_turn @ (wander_here[..., None] * skew(here))
        by_earlier[:, 3:6, 3:6] += np.swapaxes(turned, 1, 2)
        sigmas = axis_sigmas(self.prior)[None] if self.sigmas is None else self.sigmas[later - 1]
        added = to_error @ axes_to_state(left * (sigmas**2)[:, :, None, None])
        mixed = by_earlier @ self.cross_covariance[later - 1] @ np.swapaxes(by_later, 1, 2)
        covariance = (
            by_earlier @ self.covariance[later - 1] @ np.swapaxes(by_earlier, 1, 2)
            + by_later @ self.covariance[later] @ np.swapaxes(by_later, 1, 2)
            + mixed
            + np.swapaxes(mixed, 1, 2)
        )
        return states, _symmetric(covariance + added @ np.swapaxes(to_error, 1, 2))

    def _times_s(self) -> FloatArray:
        """Correlation times of both kinds of axes in s, shape (2,)."""
        return np.array([self.prior.acceleration_correlation_time_s, self.prior.angular_acceleration_correlation_time_s])


def _to_error(by_turn: FloatArray, wander: FloatArray, rate: FloatArray) -> FloatArray:
    """How errors in what the prior is linear in, turn less wander among it, become errors of a state; (N, 18, 18)."""
    matrix = np.repeat(_EYE, len(by_turn), axis=0)
    matrix[:, 3:6, 3:6] = by_turn
    matrix[:, 3:6, 9:12] = by_turn @ (wander[..., None] * skew(rate))
    return matrix


def _states(time_s: FloatArray, position: FloatArray, rotation: FloatArray, axes: FloatArray) -> States:
    return States(time_s, position, rotation, axes[:, :3, 1], axes[:, 3:, 1], axes[:, :3, 2], axes[:, 3:, 2])


def _velocities(knots: States) -> FloatArray:
    return np.concatenate([knots.velocity, knots.angular_velocity], axis=1)


def _accelerations(knots: States) -> FloatArray:
    return np.concatenate([knots.acceleration, knots.angular_acceleration], axis=1)


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + np.swapaxes(matrix, 1, 2))


def ros_covariance(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Pose covariances as they leave the program.

    Parameters
    ----------
    rotation
        ``R_station1_robot``, (N, 3, 3).
    covariance
        Of states' errors, (N, 18, 18), or their first six parts.

    Returns
    -------
    FloatArray
        (N, 6, 6): x, y, z, rotation about the fixed axes x, y, z of ``station1``.
    """
    turned = np.zeros((len(rotation), 6, 6))
    turned[:, :3, :3] = IDENTITY
    turned[:, 3:, 3:] = rotation
    return _symmetric(turned @ covariance[:, :6, :6] @ np.swapaxes(turned, 1, 2))


def state_at_point(states: States, covariance: FloatArray, arm: FloatArray) -> tuple[States, FloatArray]:
    """Tell the motion of another point of the robot.

    Parameters
    ----------
    states
        N states.
    covariance
        Of their errors, (N, 18, 18), or of the first six parts of them.
    arm
        (3,) from the point that the states are of to the other one, in the robot frame, in m.

    Returns
    -------
    states : Knots
        Of the other point; the rotation is that of the whole robot.
    covariance : FloatArray
        (N, 6, 6) of the errors of its position and of the rotation.
    """
    rotation, rate = states.rotation, states.angular_velocity
    swing = cross(rate, arm)
    moved = replace(
        states,
        position=states.position + matvec(rotation, arm),
        velocity=states.velocity + matvec(rotation, swing),
        acceleration=states.acceleration
        + matvec(rotation, cross(states.angular_acceleration, arm) + cross(rate, swing)),
    )
    by_error = np.repeat(_EYE[:, :6, :6], len(states), axis=0)
    by_error[:, :3, 3:] = -rotation @ skew(arm)
    return moved, _symmetric(by_error @ covariance[:, :6, :6] @ np.swapaxes(by_error, 1, 2))


def with_second_order_terms(rotation: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Add what linear errors leave out of a position that turns with the robot about a line or a point.

    What two prisms do not tell is a turn by some angle θ about the line through them: it moves a point at the distance r
    from that line by rθ along its circle, and by rθ²/2 towards the line, where the sigma of the position is perhaps a
    millimetre. That is squared on average 3 σ⁴ r² / 4, with σ² the variance of θ. One prism alone leaves turns about
    three axes, each of which takes the point nearer; of two, the products are on average σ₁² σ₂² / 4.

    Parameters
    ----------
    rotation
        (N, 3, 3).
    covariance
        (N, 6, 6) of the errors of position and rotation, as :func:`state_at_point` has it.

    Returns
    -------
    covariance : FloatArray
        (N, 6, 6).
    sigma_rad : FloatArray
        (N,) one sigma of θ, the rotation in the direction in which it is known worst; NaN where rounding has spoilt it.
    """
    variance, axes = np.linalg.eigh(covariance[:, 3:, 3:])
    # What a turn moves the point by is its covariance with that over the variance, which stands before the square anyway.
    moved = np.swapaxes(covariance[:, :3, 3:] @ axes, 1, 2)
    towards = cross(moved, np.swapaxes(rotation @ axes, 1, 2))
    all_turns = towards.sum(axis=1)
    curved: FloatArray = covariance.copy()
    curved[:, :3, :3] += 0.5 * (np.swapaxes(towards, 1, 2) @ towards)
    curved[:, :3, :3] += 0.25 * all_turns[:, :, None] * all_turns[:, None, :]
    return curved, np.sqrt(np.where(variance[:, -1] >= 0, variance[:, -1], np.nan))
