"""States of a trajectory at knots, and the process factors between neighbouring knots. Sans-I/O.

The error (local coordinates) of a state has 18 components, three each of: position (frame ``station1``), rotation (about
the axes of the robot, ``R Exp(d)``), velocity (``station1``), angular velocity (robot), and the two accelerations likewise.
The components of axis i are i, 6 + i and 12 + i.
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

STATE_DIM = 18  # Components of a state's error
POSE_DIM = 6  # The first of them: position and rotation
_MIN_WRAP_RAD = 0.3  # Smaller rotations between two states are never taken the long way round


@dataclass(frozen=True, slots=True)
class States:
    """States at K times: the motion of the layout's reference point and of the robot's rotation."""

    time_s: FloatArray  # (K,) strictly increasing, from the trajectory's time origin
    position: FloatArray  # (K, 3) in frame ``station1``, m
    rotation: FloatArray  # (K, 3, 3) ``R_station1_robot``
    velocity: FloatArray  # (K, 3) in frame ``station1``, m/s
    angular_velocity: FloatArray  # (K, 3) in the robot frame, rad/s
    acceleration: FloatArray  # (K, 3) in frame ``station1``, m/s^2
    angular_acceleration: FloatArray  # (K, 3) in the robot frame, rad/s^2

    def __len__(self) -> int:
        return len(self.time_s)

    def select(self, rows: slice | NDArray[np.intp]) -> States:
        """Return the states of some rows."""
        # Not a loop over the fields: the live estimator selects a dozen times per measurement.
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
        """Add errors, (K, 18), to the states."""
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
        """Return the errors d, (K, 18), of these states about others: ``other.retract(d)`` gives these states."""
        return self.differences_from(other, fast_log_so3(other.rotation.swapaxes(1, 2) @ self.rotation))

    def differences_from(self, other: States, rotvec: FloatArray) -> FloatArray:
        """Return :meth:`local_coordinates_about` with known rotation vectors, (K, 3), from the other rotations to these."""
        return np.concatenate(
            [
                self.position - other.position,
                rotvec,
                self.velocity - other.velocity,
                self.angular_velocity - other.angular_velocity,
                self.acceleration - other.acceleration,
                self.angular_acceleration - other.angular_acceleration,
            ],
            axis=1,
        )


def concatenate_states(parts: list[States]) -> States:
    """Concatenate states in the given order."""
    return States(*(np.concatenate([getattr(part, name) for part in parts]) for name in States.__slots__))


@dataclass(frozen=True, slots=True)
class ProcessFactors:
    """Process factors of the K - 1 steps between knots; they depend on the knots' times alone."""

    phi: FloatArray  # (K - 1, 6, 3, 3) transition matrix of each axis
    information: FloatArray  # (K - 1, 6, 3, 3) inverse of the process noise covariance
    # (K - 1, 6) information about the velocity, which is zero at rest, at either end of the step; None: nowhere at rest
    rest: FloatArray | None = None

    @classmethod
    def of(
        cls,
        time_s: FloatArray,
        prior: MotionPrior,
        sigmas: FloatArray | None = None,
        rest: FloatArray | None = None,
    ) -> ProcessFactors:
        """Make the factors between knots; ``sigmas``, (K - 1, 6), override the prior's acceleration sigmas."""
        dt_s = (time_s[1:] - time_s[:-1])[:, None]
        times_s = np.array(
            [prior.acceleration_correlation_time_s, prior.angular_acceleration_correlation_time_s]
        )
        two_phi, two_information = transition(dt_s, times_s), process_information(dt_s, times_s)
        weights = (axis_sigmas(prior)[None] if sigmas is None else sigmas) ** -2.0
        return cls(
            np.repeat(two_phi, 3, axis=1),
            np.repeat(two_information, 3, axis=1) * weights[:, :, None, None],
            rest,
        )

    def select(self, rows: slice) -> ProcessFactors:
        """Return the factors of some steps."""
        return ProcessFactors(
            self.phi[rows], self.information[rows], None if self.rest is None else self.rest[rows]
        )


@dataclass(frozen=True, slots=True)
class LinearisedProcess:
    """Residuals and Jacobians of K - 1 process factors: ``later - Phi earlier`` by axis, linear except for the rotation."""

    earlier: FloatArray  # (K - 1, 6, 3) per axis: zero, velocity and acceleration of the earlier knot
    # (K - 1, 6, 3) displacement or rotation vector from the earlier knot, velocity and acceleration of the later knot
    later: FloatArray
    residuals: FloatArray  # (K - 1, 18)
    rotation_by_earlier: FloatArray  # (K - 1, 3, 6) by the errors of rotation and angular velocity
    rotation_by_later: FloatArray  # (K - 1, 3, 6)
    # Rotation vector from a given rotation to that of the first knot, (3,), and its Jacobian by the knot's error, (3, 3)
    from_given: tuple[FloatArray, FloatArray] | None = None


def linearise_process(
    knots: States, factors: ProcessFactors, given: FloatArray | None = None
) -> LinearisedProcess:
    """Residuals and exact Jacobians of the process factors.

    With a ``given`` rotation, (1, 3, 3), also ``from_given``, in the same pass.

    The rotation vector between two knots is the integral of the angular velocity only for a fixed axis of rotation. For a
    moving axis, dt^2 / 12 times the cross product of both angular velocities is subtracted (Magnus expansion, W. Magnus,
    1954, to fourth order in dt); the rest is linear in the angular acceleration, like the prior.
    """
    count = len(knots) - 1
    before, after = knots.angular_velocity[:-1], knots.angular_velocity[1:]
    dt_s = knots.time_s[1:] - knots.time_s[:-1]
    rotvec = _unwrapped(
        fast_log_so3(knots.rotation[:-1].swapaxes(1, 2) @ knots.rotation[1:]), dt_s, before, after
    )
    rotvecs, extra = rotvec, 0
    if given is not None:
        # Not in one pass with the others: its digits must not depend on how far the robot turns in a step.
        from_given = fast_log_so3(given.swapaxes(1, 2) @ knots.rotation[:1])
        rotvecs, extra = np.concatenate([from_given, rotvec]), 1
    magnus = (dt_s**2 / 12)[:, None]
    earlier, later = _axes(knots)
    later[:, 3:, 0] = rotvec - magnus * cross(before, after)
    by_earlier, by_later = np.empty((count, 3, 6)), np.empty((count, 3, 6))
    J_r_invs = inverse_right_jacobian(rotvecs)
    J_r_inv = J_r_invs[extra:]
    # The inverse Jacobian of the opposite rotation is the transpose.
    by_earlier[:, :, :3], by_later[:, :, :3] = -J_r_inv.swapaxes(1, 2), J_r_inv
    by_earlier[:, :, 3:] = skew(magnus * after)
    by_later[:, :, 3:] = skew(-magnus * before)
    residuals = np.swapaxes(later - matvec(factors.phi, earlier), 1, 2).reshape(count, STATE_DIM)
    return LinearisedProcess(
        *(earlier, later, residuals, by_earlier, by_later),
        None if given is None else (rotvecs[0], J_r_invs[0]),
    )


def process_cost(knots: States, factors: ProcessFactors) -> float:
    """Sum of squared Mahalanobis distances of the process factors, as :func:`add_process_factors` returns it."""
    before, after = knots.angular_velocity[:-1], knots.angular_velocity[1:]
    dt_s = knots.time_s[1:] - knots.time_s[:-1]
    earlier, later = _axes(knots)
    later[:, 3:, 0] = rotation_between(knots.select(slice(None, -1)), knots.select(slice(1, None))) - (
        dt_s**2 / 12
    )[:, None] * cross(before, after)
    residuals = later - matvec(factors.phi, earlier)
    cost = float((residuals * matvec(factors.information, residuals)).sum())
    if factors.rest is not None:
        cost += float((factors.rest * (earlier[:, :, 1] ** 2 + later[:, :, 1] ** 2)).sum())
    return cost


def _axes(knots: States) -> tuple[FloatArray, FloatArray]:
    """``earlier`` and ``later`` of :class:`LinearisedProcess`, without the rotation vectors."""
    states = np.empty((len(knots), 6, 3))
    states[:, :3, 1], states[:, 3:, 1] = knots.velocity, knots.angular_velocity
    states[:, :3, 2], states[:, 3:, 2] = knots.acceleration, knots.angular_acceleration
    earlier, later = states[:-1].copy(), states[1:].copy()
    earlier[:, :, 0] = 0.0
    later[:, :3, 0] = knots.position[1:] - knots.position[:-1]
    return earlier, later


def add_process_factors(
    linearised: LinearisedProcess,
    factors: ProcessFactors,
    diagonal: FloatArray,
    off_diagonal: FloatArray,
    gradient: FloatArray,
) -> float:
    """Add the K - 1 process factors to the normal equations, in place; return the sum of squared Mahalanobis distances.

    Shapes of ``diagonal``, ``off_diagonal`` and ``gradient``: (K, 18, 18), (K - 1, 18, 18), (K, 18).
    """
    count = len(factors.phi)
    translation = slice(0, 3)
    phi, information = factors.phi[:, translation], factors.information[:, translation]
    phi_information = phi.swapaxes(2, 3) @ information
    diagonal_blocks = np.zeros((count + 1, 3, 3, 3))
    diagonal_blocks[:-1] = phi_information @ phi
    diagonal_blocks[1:] += information
    _translation_blocks(diagonal)[...] += diagonal_blocks
    _translation_blocks(off_diagonal)[...] -= phi_information
    residuals = linearised.residuals.reshape(count, 3, 2, 3)
    translation_residuals = residuals[:, :, 0].swapaxes(1, 2)
    weighted = matvec(information, translation_residuals)
    cost = float((weighted * translation_residuals).sum())
    gradient_by_kind = gradient.reshape(-1, 3, 2, 3)
    gradient_by_kind[1:, :, 0] += weighted.swapaxes(1, 2)
    gradient_by_kind[:-1, :, 0] -= np.swapaxes(matvec(phi.swapaxes(2, 3), weighted), 1, 2)

    # Jacobian of (rotation, angular velocity, angular acceleration) by the errors of both knots, 9 each; the residuals last.
    jacobian = np.zeros((count, 9, 19))
    rotational = jacobian[:, :, :9].reshape(count, 3, 3, 3, 3)
    np.einsum("niaja->naij", rotational)[...] = -factors.phi[:, 3:]
    jacobian[:, :3, :3] = 0.0
    np.einsum("nii->ni", jacobian[:, 3:, 12:18])[...] = 1.0
    jacobian[:, :3, :6] += linearised.rotation_by_earlier
    jacobian[:, :3, 9:15] = linearised.rotation_by_later
    jacobian[:, :, 18] = residuals[:, :, 1].reshape(count, 9)
    weights = np.zeros((count, 9, 9))
    np.einsum("niaja->naij", weights.reshape(count, 3, 3, 3, 3))[...] = factors.information[:, 3:]
    normal = jacobian.swapaxes(1, 2) @ (weights @ jacobian)
    for matrix, block in (
        (diagonal[:-1], normal[:, :9, :9]),
        (diagonal[1:], normal[:, 9:18, 9:18]),
        (off_diagonal, normal[:, :9, 9:18]),
    ):
        matrix.reshape(count, 3, 2, 3, 3, 2, 3)[:, :, 1, :, :, 1] += block.reshape(count, 3, 3, 3, 3)
    gradient_by_kind[:-1, :, 1] += normal[:, :9, 18].reshape(count, 3, 3)
    gradient_by_kind[1:, :, 1] += normal[:, 9:18, 18].reshape(count, 3, 3)
    cost += float(normal[:, 18, 18].sum())
    if factors.rest is not None:
        velocities = slice(6, 12)
        for end, axes in ((slice(None, -1), linearised.earlier), (slice(1, None), linearised.later)):
            np.einsum("nii->ni", diagonal[end, velocities, velocities])[...] += factors.rest
            gradient[end, velocities] += factors.rest * axes[:, :, 1]
            cost += float((factors.rest * axes[:, :, 1] ** 2).sum())
    return cost


def _translation_blocks(matrix: FloatArray) -> FloatArray:
    """(N, 3, 3, 3) view of the translational part of (N, 18, 18): axis first."""
    by_kind = matrix.reshape(-1, 3, 2, 3, 3, 2, 3)
    view: FloatArray = np.einsum("niaja->naij", by_kind[:, :, 0, :, :, 0])
    return view


def rotation_between(before: States, after: States) -> FloatArray:
    """Rotation vectors between states in rad, (N, 3), longer than pi where the angular velocities say so.

    Below 0.3 rad a whole revolution and none are indistinguishable, and the short way is taken.
    """
    rotvec = fast_log_so3(before.rotation.swapaxes(1, 2) @ after.rotation)
    return _unwrapped(rotvec, after.time_s - before.time_s, before.angular_velocity, after.angular_velocity)


def _unwrapped(
    rotvec: FloatArray, dt_s: FloatArray, rate_before: FloatArray, rate_after: FloatArray
) -> FloatArray:
    angle = np.sqrt(dot(rotvec, rotvec))[:, None]
    if not (angle > _MIN_WRAP_RAD).any():
        return rotvec
    expected = 0.5 * dt_s[:, None] * (rate_before + rate_after)
    complement = rotvec * (1.0 - 2 * np.pi / np.maximum(angle, _MIN_WRAP_RAD))
    error, complement_error = rotvec - expected, complement - expected
    longer = (angle[:, 0] > _MIN_WRAP_RAD) & (dot(complement_error, complement_error) < dot(error, error))
    return np.where(longer[:, None], complement, rotvec)


def axes_to_state(by_axis: FloatArray) -> FloatArray:
    """Expand matrices per axis, (N, 6, 3, 3), to matrices of the state's error, (N, 18, 18)."""
    matrix = np.zeros((len(by_axis), 3, 6, 3, 6))
    np.einsum("niaja->naij", matrix)[...] = by_axis
    return matrix.reshape(-1, STATE_DIM, STATE_DIM)
