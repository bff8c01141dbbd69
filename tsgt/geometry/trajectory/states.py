"""A trajectory as its states at some instants, and what the motion prior says of neighbours. Pure.

The error of a state has 18 parts, in this order, three of each: position (frame ``station1``), rotation (about the axes of
the robot, ``R Exp(d)``), velocity (frame ``station1``), angular velocity (robot), and the two accelerations likewise. So the
parts of axis i are i, 6 + i and 12 + i.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import (
    FloatArray,
    cross,
    dot,
    exp_so3,
    fast_log_so3,
    inverse_right_jacobian,
    matvec,
    skew,
)
from tsgt.geometry.trajectory.motion_prior import axis_sigmas, process_information, transition

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.model import MotionPrior

STATE_DIM = 18

_LEAST_LONG_WAY_RAD = 0.3


@dataclass(frozen=True, slots=True)
class States:
    """States at K instants.

    Attributes
    ----------
    time_s
        (K,) strictly increasing, from the trajectory's origin of time.
    position, velocity, acceleration
        (K, 3) of that point of the robot from which its prisms are counted, in frame ``station1``: m, m/s, m/s^2.
    rotation
        (K, 3, 3) ``R_station1_robot``.
    angular_velocity, angular_acceleration
        (K, 3) in the frame of the robot: rad/s, rad/s^2.
    """

    time_s: FloatArray
    position: FloatArray
    rotation: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    acceleration: FloatArray
    angular_acceleration: FloatArray

    def __len__(self) -> int:
        return len(self.time_s)

    def select(self, rows: slice | NDArray[np.intp]) -> States:
        """Return some of them."""
        return States(
            self.time_s[rows],
            self.position[rows],
            self.rotation[rows],
            self.velocity[rows],
            self.angular_velocity[rows],
            self.acceleration[rows],
            self.angular_acceleration[rows],
        )

    def retract(self, error: FloatArray) -> States:
        """Return the states with errors, shape (K, 18), added."""
        return States(
            self.time_s,
            self.position + error[:, 0:3],
            self.rotation @ exp_so3(error[:, 3:6]),
            self.velocity + error[:, 6:9],
            self.angular_velocity + error[:, 9:12],
            self.acceleration + error[:, 12:15],
            self.angular_acceleration + error[:, 15:18],
        )

    def local_coordinates_about(self, other: States) -> FloatArray:
        """Return the errors, shape (K, 18), that :meth:`retract` would have to add to ``other`` to get these states."""
        return np.concatenate(
            [
                self.position - other.position,
                fast_log_so3(np.swapaxes(other.rotation, 1, 2) @ self.rotation),
                self.velocity - other.velocity,
                self.angular_velocity - other.angular_velocity,
                self.acceleration - other.acceleration,
                self.angular_acceleration - other.angular_acceleration,
            ],
            axis=1,
        )


def concatenate_states(parts: list[States]) -> States:
    """Return the states of all parts in their order."""
    return States(*(np.concatenate([getattr(part, name) for part in parts]) for name in States.__slots__))


@dataclass(frozen=True, slots=True)
class ProcessFactors:
    """What the prior says of the K - 1 steps from knot to knot; depends on their times alone.

    Attributes
    ----------
    phi
        (K - 1, 6, 3, 3) transition of each axis.
    information
        (K - 1, 6, 3, 3) inverse of the covariance of what is added on the way.
    """

    phi: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, time_s: FloatArray, prior: MotionPrior, sigmas: FloatArray | None = None) -> ProcessFactors:
        """Make them for K instants; ``sigmas``, (K - 1, 6), are those of the accelerations in each step, if not the prior's."""
        dt_s = (time_s[1:] - time_s[:-1])[:, None]
        times_s = np.array([prior.acceleration_correlation_time_s, prior.angular_acceleration_correlation_time_s])
        two_phi, two_information = transition(dt_s, times_s), process_information(dt_s, times_s)
        weights = (axis_sigmas(prior)[None] if sigmas is None else sigmas) ** -2.0
        return cls(
            np.repeat(two_phi, 3, axis=1),
            np.repeat(two_information, 3, axis=1) * weights[:, :, None, None],
        )

    def select(self, rows: slice) -> ProcessFactors:
        """Return some of them."""
        return ProcessFactors(self.phi[rows], self.information[rows])


@dataclass(frozen=True, slots=True)
class LinearisedProcess:
    """How far K - 1 steps are from what the prior expects.

    A step's residuals are ``later - Phi earlier`` on each axis. All of it is linear in the states, but for the turn: that
    alone has derivatives that depend on them.

    Attributes
    ----------
    earlier, later
        (K - 1, 6, 3) by axis: velocity and acceleration of the earlier knot, with zero for its position; the later
        knot's position or turn counted from there, its velocity and acceleration.
    residuals
        (K - 1, 18) later state less what is expected of the earlier one.
    turn_by_earlier, turn_by_later
        (K - 1, 3, 6) derivatives of the turn counted from the earlier knot by the errors of rotation and angular
        velocity of both knots.
    """

    earlier: FloatArray
    later: FloatArray
    residuals: FloatArray
    turn_by_earlier: FloatArray
    turn_by_later: FloatArray


def linearise_process(knots: States, steps: ProcessFactors) -> LinearisedProcess:
    """Compare neighbours with the motion prior; exact derivatives.

    The rotation from one knot to the next, as a vector, is the sum of the turns on the way only where the axis stands
    still. Where it wanders, dt^2 / 12 of the cross product of both angular velocities is taken off (W. Magnus, 1954, to
    fourth order in dt); the rest is linear in the angular acceleration, as the prior has it.
    """
    count = len(knots) - 1
    turn = rotation_between(knots.select(slice(None, -1)), knots.select(slice(1, None)))
    before, after = knots.angular_velocity[:-1], knots.angular_velocity[1:]
    wander = ((knots.time_s[1:] - knots.time_s[:-1]) ** 2 / 12)[:, None]
    states = np.empty((count + 1, 6, 3))
    states[:, :3, 1], states[:, 3:, 1] = knots.velocity, knots.angular_velocity
    states[:, :3, 2], states[:, 3:, 2] = knots.acceleration, knots.angular_acceleration
    earlier, later = states[:-1].copy(), states[1:].copy()
    earlier[:, :, 0] = 0.0
    later[:, :3, 0] = knots.position[1:] - knots.position[:-1]
    later[:, 3:, 0] = turn - wander * cross(before, after)
    by_earlier, by_later = np.empty((count, 3, 6)), np.empty((count, 3, 6))
    by_turn = inverse_right_jacobian(turn)
    # Of the opposite turn it is the transpose.
    by_earlier[:, :, :3], by_later[:, :, :3] = -np.swapaxes(by_turn, 1, 2), by_turn
    by_earlier[:, :, 3:] = skew(wander * after)
    by_later[:, :, 3:] = skew(-wander * before)
    residuals = np.swapaxes(later - matvec(steps.phi, earlier), 1, 2).reshape(count, STATE_DIM)
    return LinearisedProcess(earlier, later, residuals, by_earlier, by_later)


def add_process_factors(
    between: LinearisedProcess,
    steps: ProcessFactors,
    diagonal: FloatArray,
    off_diagonal: FloatArray,
    gradient: FloatArray,
) -> float:
    """Add what the prior says to the normal equations; only derivatives of turns make more of it than constants.

    Parameters
    ----------
    between, steps
        The K - 1 steps.
    diagonal, beside, gradient
        (K, 18, 18), (K - 1, 18, 18), (K, 18); changed.

    Returns
    -------
    float
        The squared length of all steps, in sigmas.
    """
    count = len(steps.phi)
    straight = slice(0, 3)
    phi, information = steps.phi[:, straight], steps.information[:, straight]
    weighed = np.swapaxes(phi, 2, 3) @ information
    own = np.zeros((count + 1, 3, 3, 3))
    own[:-1] = weighed @ phi
    own[1:] += information
    _place_by_axis(diagonal)[...] += own
    _place_by_axis(off_diagonal)[...] -= weighed
    residuals = between.residuals.reshape(count, 3, 2, 3)
    off = np.swapaxes(residuals[:, :, 0], 1, 2)
    pull = matvec(information, off)
    cost = float((pull * off).sum())
    by_order = gradient.reshape(-1, 3, 2, 3)
    by_order[1:, :, 0] += np.swapaxes(pull, 1, 2)
    by_order[:-1, :, 0] -= np.swapaxes(matvec(np.swapaxes(phi, 2, 3), pull), 1, 2)

    # Turn, angular velocity and acceleration by the errors of both knots, 9 each, and the residuals beside them.
    jacobian = np.zeros((count, 9, 19))
    turning = jacobian[:, :, :9].reshape(count, 3, 3, 3, 3)
    np.einsum("niaja->naij", turning)[...] = -steps.phi[:, 3:]
    jacobian[:, :3, :3] = 0.0
    np.einsum("nii->ni", jacobian[:, 3:, 12:18])[...] = 1.0
    jacobian[:, :3, :6] += between.turn_by_earlier
    jacobian[:, :3, 9:15] = between.turn_by_later
    jacobian[:, :, 18] = residuals[:, :, 1].reshape(count, 9)
    weights = np.zeros((count, 9, 9))
    np.einsum("niaja->naij", weights.reshape(count, 3, 3, 3, 3))[...] = steps.information[:, 3:]
    normal = np.swapaxes(jacobian, 1, 2) @ (weights @ jacobian)
    for matrix, part in (
        (diagonal[:-1], normal[:, :9, :9]),
        (diagonal[1:], normal[:, 9:18, 9:18]),
        (off_diagonal, normal[:, :9, 9:18]),
    ):
        matrix.reshape(count, 3, 2, 3, 3, 2, 3)[:, :, 1, :, :, 1] += part.reshape(count, 3, 3, 3, 3)
    by_order[:-1, :, 1] += normal[:, :9, 18].reshape(count, 3, 3)
    by_order[1:, :, 1] += normal[:, 9:18, 18].reshape(count, 3, 3)
    return cost + float(normal[:, 18, 18].sum())


def _place_by_axis(matrix: FloatArray) -> FloatArray:
    """View what belongs to one axis of the place in (N, 18, 18): (N, 3, 3, 3), axis first."""
    by_order = matrix.reshape(-1, 3, 2, 3, 3, 2, 3)
    view: FloatArray = np.einsum("niaja->naij", by_order[:, :, 0, :, :, 0])
    return view


def rotation_between(before: States, after: States) -> FloatArray:
    """Turn from some states to others in rad, (N, 3): by more than pi where the angular velocities say so.

    A robot that goes on turning while nothing is seen of it comes back farther round than the shortest way. Less than
    0.3 rad from where it was it may have made a whole turn or none: then the shortest way stands.
    """
    turn = fast_log_so3(np.swapaxes(before.rotation, 1, 2) @ after.rotation)
    dt_s = (after.time_s - before.time_s)[:, None]
    expected = 0.5 * dt_s * (before.angular_velocity + after.angular_velocity)
    angle = np.sqrt(dot(turn, turn))[:, None]
    if not (angle > _LEAST_LONG_WAY_RAD).any():
        return turn
    the_other_way = turn * (1.0 - 2 * np.pi / np.maximum(angle, _LEAST_LONG_WAY_RAD))
    off, other_off = turn - expected, the_other_way - expected
    longer = (angle[:, 0] > _LEAST_LONG_WAY_RAD) & (dot(other_off, other_off) < dot(off, off))
    return np.where(longer[:, None], the_other_way, turn)


def axes_to_state(by_axis: FloatArray) -> FloatArray:
    """Return matrices of the six axes, (N, 6, 3, 3), as one of the state, (N, 18, 18)."""
    matrix = np.zeros((len(by_axis), 3, 6, 3, 6))
    axes = np.arange(6)
    matrix[:, :, axes, :, axes] = by_axis.transpose(1, 0, 2, 3)
    return matrix.reshape(-1, STATE_DIM, STATE_DIM)
