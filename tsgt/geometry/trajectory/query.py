"""Query of a trajectory at any time: states and covariances. Sans-I/O.

Between two knots the motion prior interpolates, conditioned on both (S. Anderson et al., "Batch nonlinear continuous-time
trajectory estimation as exactly sparse Gaussian process regression", Autonomous Robots 39, 2015; Barfoot, section 3.4);
outside the knots it extrapolates, and the covariance grows with the process noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

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

_CHUNK = 512  # Times per pass; stays in the cache, a third faster than passes of 4096
_IDENTITY_18 = np.eye(STATE_DIM)[None]


class QueriedTrajectory(Protocol):
    """A trajectory with its uncertainty, over the times of a window."""

    @property
    def unchanged_until_s(self) -> float:
        """Time up to which states stay the same, whatever arrives."""
        ...

    def at(self, time_s: FloatArray, *, dim: int) -> tuple[States, FloatArray]:
        """Return states at N times, and the (N, dim, dim) covariance of their leading error components."""
        ...

    def common_at(self, time_s: FloatArray, *, dim: int) -> FloatArray | None:
        """Return the (N, dim, dim) covariance that the set-up's uncertainty adds; None: unknown."""
        ...


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A continuous-time trajectory with its uncertainty."""

    knots: States  # States at K times
    prior: MotionPrior
    covariance: FloatArray  # (K, 18, 18) of the knots' errors
    cross_covariance: FloatArray  # (K - 1, 18, 18) of each knot's error (rows) with the next one's (columns)
    # (K - 1, 6) acceleration sigmas of each step where they differ from those of ``prior``
    sigmas: FloatArray | None = None
    # The same two covariances from the uncertainty of the set-up alone, which all states share; None: unknown
    common: tuple[FloatArray, FloatArray] | None = None
    process_noise_share: float = 1.0  # Of the prior's variances between the knots

    @property
    def unchanged_until_s(self) -> float:
        """Time of the last knot."""
        return float(self.knots.time_s[-1])

    def common_at(self, time_s: FloatArray, *, dim: int = STATE_DIM) -> FloatArray | None:
        """Return the (N, dim, dim) covariance of states at N times that the set-up's uncertainty adds; None: unknown."""
        if self.common is None:
            return None
        covariance, cross_covariance = self.common
        alone = replace(
            self, covariance=covariance, cross_covariance=cross_covariance, process_noise_share=0.0
        )
        return alone.at(time_s, dim=dim)[1]

    def at(self, time_s: FloatArray, *, dim: int = STATE_DIM) -> tuple[States, FloatArray]:
        """Return states at N times, and the (N, dim, dim) covariance of their leading error components; 6 is faster than 18."""
        found = [self._at(time_s[i : i + _CHUNK], dim) for i in range(0, len(time_s), _CHUNK)]
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
            return self._interpolate(time_s, later, dim)
        states, covariance = self._extrapolate(time_s, np.clip(later - 1, 0, None), dim)
        if inside.any():
            some, some_covariance = self._interpolate(time_s[inside], later[inside], dim)
            for name in States.__slots__:
                getattr(states, name)[inside] = getattr(some, name)
            covariance[inside] = some_covariance
        return states, covariance

    def _extrapolate(self, time_s: FloatArray, knot: np.ndarray, dim: int) -> tuple[States, FloatArray]:
        """Extrapolate from one knot, forwards or backwards: the prior is symmetric in time."""
        start = self.knots.select(knot)
        dt_s = time_s - start.time_s
        step_s = np.abs(dt_s)[:, None]
        times_s, sigmas = self._times_s(), axis_sigmas(self.prior)
        phi = np.repeat(transition(step_s, times_s), 3, axis=1)
        noise = (
            np.repeat(process_noise(step_s, times_s), 3, axis=1)
            * (self.process_noise_share * sigmas**2)[:, None, None]
        )
        # Backwards, velocity changes its sign, and with it its coupling to position and acceleration.
        flip = np.where(dt_s < 0, -1.0, 1.0)[:, None]
        for row, column in ((0, 1), (1, 0), (1, 2), (2, 1)):
            phi[..., row, column] *= flip
            noise[..., row, column] *= flip
        zero = np.zeros((len(time_s), 6))
        propagated = phi @ np.stack([zero, _velocities(start), _accelerations(start)], axis=-1)[..., None]
        propagated = propagated[..., 0]
        magnus, rate, rate_here = (dt_s**2 / 12)[:, None], start.angular_velocity, propagated[:, 3:, 1]
        rotvec = propagated[:, 3:, 0] + magnus * cross(rate, rate_here)
        delta_R, J_r = exp_and_right_jacobian(rotvec)
        states = _states(time_s, start.position + propagated[:, :3, 0], start.rotation @ delta_R, propagated)
        to_error = _linear_to_error(J_r, magnus, rate)
        by_start = to_error @ axes_to_state(phi)
        by_start[:, 3:6, 9:12] -= J_r @ (magnus[..., None] * skew(rate_here))
        by_start[:, 3:6, 3:6] = delta_R.swapaxes(1, 2)
        by_start, to_error = by_start[:, :dim], to_error[:, :dim]
        covariance = by_start @ self.covariance[knot] @ by_start.swapaxes(1, 2)
        return states, _symmetric(covariance + to_error @ axes_to_state(noise) @ to_error.swapaxes(1, 2))

    def _interpolate(self, time_s: FloatArray, later: np.ndarray, dim: int) -> tuple[States, FloatArray]:
        count = len(time_s)
        # Calls of numpy cost more than their arithmetic here: both knots of each interval, and both weights, go together.
        both = self.knots.select(np.concatenate([later - 1, later]))
        before, after = both.select(slice(count)), both.select(slice(count, None))
        dt_s, step_s = time_s - before.time_s, after.time_s - before.time_s
        # Linear and angular weights, each for three axes.
        weights = np.repeat(
            interpolation_weights(dt_s[:, None], (step_s - dt_s)[:, None], self._times_s()), 3, axis=2
        )
        magnus, magnus_here = (step_s**2 / 12)[:, None], (dt_s**2 / 12)[:, None]
        earlier_rate, later_rate = before.angular_velocity, after.angular_velocity
        full_rotvec = rotation_between(before, after)
        known = np.zeros((2 * count, 6, 3))
        known[:, :3, 0], known[count:, 3:, 0] = (
            both.position,
            full_rotvec - magnus * cross(earlier_rate, later_rate),
        )
        known[:, :3, 1], known[:, 3:, 1] = both.velocity, both.angular_velocity
        known[:, :3, 2], known[:, 3:, 2] = both.acceleration, both.angular_acceleration
        by_knot = matvec(weights[:2], known.reshape(2, count, 6, 3))
        axes = by_knot[0] + by_knot[1]
        rate_here = axes[:, 3:, 1]
        rotvec = axes[:, 3:, 0] + magnus_here * cross(earlier_rate, rate_here)
        delta_R, J_r = exp_and_right_jacobian(rotvec)
        states = _states(time_s, axes[:, :3, 0], before.rotation @ delta_R, axes)
        sigmas = axis_sigmas(self.prior)[None] if self.sigmas is None else self.sigmas[later - 1]
        weights[2] *= (self.process_noise_share * sigmas**2)[:, :, None, None]
        by_earlier, by_later, conditional = axes_to_state(weights.reshape(-1, 6, 3, 3)).reshape(
            3, count, STATE_DIM, STATE_DIM
        )
        # The later rotation enters as the rotation vector from the earlier one minus its Magnus term.
        by_rotation, J_r_inv = by_later[:, :, 3:6].copy(), inverse_right_jacobian(full_rotvec)
        by_later[:, :, 3:6] = by_rotation @ J_r_inv
        by_later[:, :, 9:12] -= by_rotation @ (magnus[..., None] * skew(earlier_rate))
        # The inverse Jacobian of the opposite rotation is the transpose.
        by_earlier[:, :, 3:6] = -by_rotation @ J_r_inv.swapaxes(1, 2)
        by_earlier[:, :, 9:12] += by_rotation @ (magnus[..., None] * skew(later_rate))
        to_error = _linear_to_error(J_r, magnus_here, earlier_rate)[:, :dim]
        by_earlier, by_later = to_error @ by_earlier, to_error @ by_later
        by_earlier[:, 3:6, 9:12] -= J_r @ (magnus_here[..., None] * skew(rate_here))
        by_earlier[:, 3:6, 3:6] += delta_R.swapaxes(1, 2)
        to_later = by_later.swapaxes(1, 2)
        coupling = by_earlier @ self.cross_covariance[later - 1] @ to_later
        covariance = (
            by_earlier @ self.covariance[later - 1] @ by_earlier.swapaxes(1, 2)
            + by_later @ self.covariance[later] @ to_later
            + coupling
            + coupling.swapaxes(1, 2)
        )
        return states, _symmetric(covariance + to_error @ conditional @ to_error.swapaxes(1, 2))

    def _times_s(self) -> FloatArray:
        """(2,) correlation times of the linear and the angular axes in s."""
        return np.array(
            [self.prior.acceleration_correlation_time_s, self.prior.angular_acceleration_correlation_time_s]
        )


def _linear_to_error(right_jacobian: FloatArray, magnus: FloatArray, rate: FloatArray) -> FloatArray:
    """(N, 18, 18) Jacobian of a state's error by the quantities in which the prior is linear."""
    matrix = np.repeat(_IDENTITY_18, len(right_jacobian), axis=0)
    matrix[:, 3:6, 3:6] = right_jacobian
    matrix[:, 3:6, 9:12] = right_jacobian @ (magnus[..., None] * skew(rate))
    return matrix


def _states(time_s: FloatArray, position: FloatArray, rotation: FloatArray, axes: FloatArray) -> States:
    return States(time_s, position, rotation, axes[:, :3, 1], axes[:, 3:, 1], axes[:, :3, 2], axes[:, 3:, 2])


def _velocities(knots: States) -> FloatArray:
    return np.concatenate([knots.velocity, knots.angular_velocity], axis=1)


def _accelerations(knots: States) -> FloatArray:
    return np.concatenate([knots.acceleration, knots.angular_acceleration], axis=1)


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.swapaxes(1, 2))


def ros_covariance(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Pose covariances in ROS order, (N, 6, 6): x, y, z, rotation about the fixed axes x, y, z of ``station1``.

    From ``R_station1_robot``, (N, 3, 3), and the covariance of states' errors, (N, d, d), d >= 6.
    """
    to_fixed_axes = np.zeros((len(rotation), 6, 6))
    to_fixed_axes[:, :3, :3] = IDENTITY
    to_fixed_axes[:, 3:, 3:] = rotation
    return _symmetric(to_fixed_axes @ covariance[:, :6, :6] @ to_fixed_axes.swapaxes(1, 2))


def state_at_point(
    states: States, covariance: FloatArray, lever_arm: FloatArray
) -> tuple[States, FloatArray]:
    """Motion of another point of the rigid robot, and the (N, 6, 6) covariance of its position's and rotation's errors.

    ``covariance``: of the states' errors, (N, d, d), d >= 6. ``lever_arm``: from their reference point, (3,) in the robot
    frame.
    """
    rotation, rate = states.rotation, states.angular_velocity
    lever_velocity = cross(rate, lever_arm)
    moved = replace(
        states,
        position=states.position + matvec(rotation, lever_arm),
        velocity=states.velocity + matvec(rotation, lever_velocity),
        acceleration=states.acceleration
        + matvec(rotation, cross(states.angular_acceleration, lever_arm) + cross(rate, lever_velocity)),
    )
    by_error = np.repeat(_IDENTITY_18[:, :6, :6], len(states), axis=0)
    by_error[:, :3, 3:] = -rotation @ skew(lever_arm)
    return moved, _symmetric(by_error @ covariance[:, :6, :6] @ by_error.swapaxes(1, 2))


def with_second_order_terms(rotation: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Add the second-order effect of an uncertain rotation to the position covariance of a point.

    Two prisms leave a rotation by an angle θ about the line through them unobserved: it displaces a point at the distance r
    from that line by rθ along its circle and by rθ²/2 towards the line, where the first-order sigma may be a millimetre. The
    mean square of the latter is 3 σ⁴ r² / 4, with σ² the variance of θ. One prism alone leaves rotations about three axes,
    each of which moves the point closer; the mean product of two of them is σ₁² σ₂² / 4.

    From rotations, (N, 3, 3), and (N, 6, 6) of :func:`state_at_point`. Returns the covariance with these terms and one sigma
    of θ in rad, (N,), the least certain rotation; NaN where rounding made its variance negative.
    """
    variance, axes = np.linalg.eigh(covariance[:, 3:, 3:])
    # The displacement per rad is the covariance with the rotation over its variance; the variance cancels in the square.
    displacement = np.swapaxes(covariance[:, :3, 3:] @ axes, 1, 2)
    curvature = cross(displacement, np.swapaxes(rotation @ axes, 1, 2))
    total_curvature = curvature.sum(axis=1)
    with_curvature: FloatArray = covariance.copy()
    with_curvature[:, :3, :3] += 0.5 * (curvature.swapaxes(1, 2) @ curvature)
    with_curvature[:, :3, :3] += 0.25 * total_curvature[:, :, None] * total_curvature[:, None, :]
    return with_curvature, np.sqrt(np.where(variance[:, -1] >= 0, variance[:, -1], np.nan))
