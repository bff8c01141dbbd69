"""Query of a trajectory with an IMU at any time: strapdown from the earlier knot, corrected to the later. Sans-I/O.

The samples give the motion from the earlier knot to the time, with its noise; the later knot says how much of the noise of the
whole step there was, and the part before the time takes its share (the conditional mean and covariance of a Gaussian). Without
an accelerometer the motion prior interpolates positions, and the gyro rotations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.inertial.preintegration import Preintegrated, preintegrate
from tsgt.geometry.inertial.sensitivity import by_mounting
from tsgt.geometry.inertial.states import INERTIAL_STATE_DIM, concatenate_inertial_states
from tsgt.geometry.rigid import (
    IDENTITY,
    FloatArray,
    cross,
    exp_so3,
    fast_log_so3,
    matvec,
    skew,
)
from tsgt.geometry.trajectory import POSE_DIM, States, concatenate_states
from tsgt.geometry.trajectory.motion_prior import interpolation_weights

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.preintegration import ContiguousSamples
    from tsgt.geometry.inertial.states import Gravity, InertialStates, Mounting
    from tsgt.model import MotionPrior

_CHUNK = 512  # Times per pass; stays in the cache


class Predicted(NamedTuple):
    """States reached from others by the samples in between, but for their biases, which stay."""

    position: FloatArray  # (N, 3) in frame ``station1``
    rotation: FloatArray  # (N, 3, 3) ``R_station1_imu``
    velocity: FloatArray  # (N, 3)
    by_start: FloatArray  # (N, 9, 15) Jacobian of the error of position, rotation and velocity
    noise: FloatArray  # (N, 9, 9) covariance of that error from the samples' noise
    force: FloatArray  # (N, 3) mean specific force in between, where the accelerometer's matrix is unknown


def strapdown(start: InertialStates, gravity: Gravity, motion: Preintegrated) -> Predicted:
    """Propagate N states by motions that begin at their times; biases are those of the states, to first order."""
    bias = force = start.bias_or_acceleration
    if gravity.matrix.size:
        force = motion.force
        bias = bias + gravity.force_error(force)
    delta_p, delta_R, delta_v = motion.corrected(start.gyro_bias, bias)
    R, duration_s = start.rotation, motion.duration_s[:, None]
    fall = gravity.vector()
    by_start = np.zeros((len(start), 9, INERTIAL_STATE_DIM))
    by_start[:, 0:3, 0:3] = by_start[:, 6:9, 6:9] = IDENTITY
    by_start[:, 0:3, 6:9] = duration_s[..., None] * IDENTITY
    by_start[:, 3:6, 3:6] = delta_R.swapaxes(1, 2)
    by_start[:, 0:3, 3:6], by_start[:, 6:9, 3:6] = -R @ skew(delta_p), -R @ skew(delta_v)
    to_station = _to_station(R)
    by_start[:, :, 9:12] = to_station @ motion.by_gyro_bias
    by_start[:, :, 12:15] = to_station @ motion.by_accelerometer_bias
    return Predicted(
        start.position + duration_s * start.velocity + 0.5 * duration_s**2 * fall + matvec(R, delta_p),
        R @ delta_R,
        start.velocity + duration_s * fall + matvec(R, delta_v),
        by_start,
        to_station @ motion.covariance @ to_station.swapaxes(1, 2),
        force,
    )


def _to_station(rotation: FloatArray) -> FloatArray:
    """(N, 9, 9) matrices that turn errors of position and velocity from the axes of the IMU to ``station1``."""
    matrix = np.zeros((len(rotation), 9, 9))
    matrix[:, 0:3, 0:3] = matrix[:, 6:9, 6:9] = rotation
    matrix[:, 3:6, 3:6] = IDENTITY
    return matrix


@dataclass(frozen=True, slots=True)
class InertialTrajectory:
    """A trajectory with an IMU, with its uncertainty; it answers for the reference point of the robot's layout."""

    knots: InertialStates  # States of the IMU at K times
    gravity: Gravity
    samples: ContiguousSamples
    mounting: Mounting
    covariance: FloatArray  # (K, 15, 15) of the knots' errors
    cross_covariance: FloatArray  # (K - 1, 15, 15) of each knot's error (rows) with the next one's (columns)
    gyro_only: MotionPrior | None = None
    # (K, 15, r) displacement of the knots by what is uncertain of the set-up, which all states share; None: unknown
    displacement: FloatArray | None = None
    # (7, r) errors of the mounting in the same columns (sensitivity.MOUNTING_DIM); None: it is exact
    mounting_factor: FloatArray | None = None

    def at(self, time_s: FloatArray, *, dim: int = POSE_DIM) -> tuple[States, FloatArray]:
        """Return states of the reference point and of the robot's axes at N times, and the (N, 6, 6) covariance of their poses.

        ``dim``: 6. Angular accelerations are zero: no sample tells them. Raises GeometryError: a time is outside the knots.
        """
        states, covariance, _ = self._in_chunks(time_s, common=False)
        return states, covariance[:, :dim, :dim]

    def common_at(self, time_s: FloatArray, *, dim: int = POSE_DIM) -> FloatArray | None:
        """Return the (N, 6, 6) covariance of poses at N times that the set-up's uncertainty adds; None: unknown."""
        if self.displacement is None:
            return None
        _, _, common = self._in_chunks(time_s, random=False)
        return common[:, :dim, :dim]

    def poses_at(self, time_s: FloatArray) -> tuple[States, FloatArray, FloatArray | None]:
        """Return what :meth:`at` and :meth:`common_at` do, in half the time."""
        if self.displacement is None:
            return (*self.at(time_s), None)
        return self._in_chunks(time_s)

    def _in_chunks(
        self, time_s: FloatArray, *, random: bool = True, common: bool = True
    ) -> tuple[States, FloatArray, FloatArray]:
        knots_s = self.knots.time_s
        if len(time_s) and not (knots_s[0] <= time_s.min() and time_s.max() <= knots_s[-1]):
            raise GeometryError(
                f"the trajectory covers {knots_s[0]:.3f} to {knots_s[-1]:.3f} s, "
                f"asked for {time_s.min():.3f} to {time_s.max():.3f} s"
            )
        found = [
            self._at(time_s[i : i + _CHUNK], random=random, common=common)
            for i in range(0, max(len(time_s), 1), _CHUNK)
        ]
        if len(found) == 1:
            return found[0]
        states, covariances, commons = zip(*found, strict=True)
        return concatenate_states(list(states)), np.concatenate(covariances), np.concatenate(commons)

    def _at(self, time_s: FloatArray, *, random: bool, common: bool) -> tuple[States, FloatArray, FloatArray]:
        knot = self.knots.time_s.searchsorted(time_s, side="right") - 1
        knot = np.minimum(np.maximum(knot, 0), len(self.knots) - 2)
        rows, index = (knot, np.zeros(1, np.intp)) if len(knot) == 1 else np.unique(knot, return_inverse=True)
        earlier, later = self.knots.select(knot), self.knots.select(knot + 1)
        between = self._inertial if self.gyro_only is None else self._gyro_only
        position, rotation, velocity, acceleration, by_earlier, by_later, noise = between(
            time_s, earlier, later, rows, index
        )
        by_error = self._to_reference(rotation)
        by_earlier, by_later = by_error @ by_earlier, by_error @ by_later
        rate = self.samples.at(time_s)[0] - earlier.gyro_bias
        states = self._reference_states(time_s, position, rotation, velocity, acceleration, rate)
        covariance = by_common = np.zeros((len(time_s), 0, 0))
        if common:
            assert self.displacement is not None  # noqa: S101 (the caller checks)
            displaced = by_earlier @ self.displacement[knot] + by_later @ self.displacement[knot + 1]
            if self.mounting_factor is not None:
                displaced += by_mounting(states, self.mounting) @ self.mounting_factor
            by_common = displaced @ displaced.swapaxes(1, 2)
        if random:
            coupling = by_earlier @ self.cross_covariance[knot] @ by_later.swapaxes(1, 2)
            covariance = (
                by_earlier @ self.covariance[knot] @ by_earlier.swapaxes(1, 2)
                + by_later @ self.covariance[knot + 1] @ by_later.swapaxes(1, 2)
                + coupling
                + coupling.swapaxes(1, 2)
                + by_error @ noise @ by_error.swapaxes(1, 2)
            )
            covariance = 0.5 * (covariance + covariance.swapaxes(1, 2))
        return states, covariance, by_common

    def _inertial(
        self,
        time_s: FloatArray,
        earlier: InertialStates,
        later: InertialStates,
        rows: NDArray[np.intp],
        index: NDArray[np.intp],
    ) -> tuple[FloatArray, ...]:
        """Motion at times between two knots, and its error by theirs, (N, 6, 15) each; see the module."""
        # In one pass: to the times, and each step once to its end.
        start = concatenate_inertial_states([earlier, self.knots.select(rows)])
        end_s = np.concatenate([time_s, self.knots.time_s[rows + 1]])
        motion = preintegrate(self.samples, start.time_s, end_s, start.gyro_bias, start.bias_or_acceleration)
        found, count = strapdown(start, self.gravity, motion), len(time_s)
        here = Predicted(*(each[:count] for each in found))
        there = Predicted(*(each[count:][index] for each in found))
        # From here to the later knot.
        remaining_s = (later.time_s - time_s)[:, None]
        fall = self.gravity.vector()
        by_here = np.zeros((len(time_s), 9, 9))
        by_here[:, 0:3, 0:3] = by_here[:, 6:9, 6:9] = IDENTITY
        by_here[:, 0:3, 6:9] = remaining_s[..., None] * IDENTITY
        by_here[:, 3:6, 3:6] = there.rotation.swapaxes(1, 2) @ here.rotation
        moved = there.position - here.position - remaining_s * here.velocity - 0.5 * remaining_s**2 * fall
        gained = there.velocity - here.velocity - remaining_s * fall
        by_here[:, 0:3, 3:6], by_here[:, 6:9, 3:6] = (
            -skew(moved) @ here.rotation,
            -skew(gained) @ here.rotation,
        )
        gain = here.noise @ by_here.swapaxes(1, 2) @ np.linalg.inv(there.noise)
        error = np.concatenate(
            [
                later.position - there.position,
                fast_log_so3(there.rotation.swapaxes(1, 2) @ later.rotation),
                later.velocity - there.velocity,
            ],
            axis=1,
        )
        correction = matvec(gain, error)
        by_earlier = here.by_start - gain @ there.by_start
        by_later = np.zeros((len(time_s), 9, INERTIAL_STATE_DIM))
        by_later[:, :, 0:9] = gain
        noise = here.noise - gain @ by_here @ here.noise
        rotation = here.rotation @ exp_so3(correction[:, 3:6])
        force = self.samples.at(time_s)[1] - earlier.bias_or_acceleration
        return (
            here.position + correction[:, 0:3],
            rotation,
            here.velocity + correction[:, 6:9],
            matvec(rotation, force) + fall,
            by_earlier[:, :6],
            by_later[:, :6],
            noise[:, :6, :6],
        )

    def _gyro_only(
        self,
        time_s: FloatArray,
        earlier: InertialStates,
        later: InertialStates,
        rows: NDArray[np.intp],
        index: NDArray[np.intp],
    ) -> tuple[FloatArray, ...]:
        """As with an accelerometer, from the motion prior for positions."""
        assert self.gyro_only is not None  # noqa: S101 (the caller checks)
        part = preintegrate(self.samples, earlier.time_s, time_s, earlier.gyro_bias, np.zeros(3))
        start, end = self.knots.select(rows), self.knots.time_s[rows + 1]
        step = preintegrate(self.samples, start.time_s, end, start.gyro_bias, np.zeros(3)).select(index)
        share = (part.covariance[:, 3, 3] / step.covariance[:, 3, 3])[:, None]
        error = fast_log_so3((earlier.rotation @ step.rotation).swapaxes(1, 2) @ later.rotation)
        onward = step.rotation.swapaxes(1, 2) @ part.rotation
        # Isotropic noise, in the axes at this time.
        correction = share * matvec(onward.swapaxes(1, 2), error)
        rotation = earlier.rotation @ part.rotation @ exp_so3(correction)
        by_earlier, by_later = np.zeros((2, len(time_s), POSE_DIM, INERTIAL_STATE_DIM))
        weight = share[..., None]
        by_earlier[:, 3:6, 3:6] = (1.0 - weight) * part.rotation.swapaxes(1, 2)
        by_later[:, 3:6, 3:6] = weight * onward.swapaxes(1, 2)
        by_earlier[:, 3:6, 9:12] = part.by_gyro_bias[:, 3:6] - weight * (
            onward.swapaxes(1, 2) @ step.by_gyro_bias[:, 3:6]
        )
        noise = np.zeros((len(time_s), POSE_DIM, POSE_DIM))
        noise[:, 3:6, 3:6] = ((1.0 - share) * part.covariance[:, 3, 3, None])[..., None] * IDENTITY
        from_earlier, from_later, conditional = interpolation_weights(
            time_s - earlier.time_s,
            later.time_s - time_s,
            np.array(self.gyro_only.acceleration_correlation_time_s),
        )
        axes = np.zeros((3, len(time_s), 3))
        variances = np.array(self.gyro_only.acceleration_sigma_mps2) ** 2
        diagonal = np.arange(3)
        for kind in range(3):
            components = slice((0, 6, 12)[kind], (0, 6, 12)[kind] + 3)
            for state, weights in ((earlier, from_earlier), (later, from_later)):
                values = (state.position, state.velocity, state.bias_or_acceleration)[kind]
                axes += weights[:, :, kind].swapaxes(0, 1)[..., None] * values
            np.einsum("nii->ni", by_earlier[:, 0:3, components])[...] = from_earlier[:, 0, kind, None]
            np.einsum("nii->ni", by_later[:, 0:3, components])[...] = from_later[:, 0, kind, None]
        noise[:, diagonal, diagonal] = conditional[:, 0, 0, None] * variances
        return axes[0], rotation, axes[1], axes[2], by_earlier, by_later, noise

    def _to_reference(self, rotation: FloatArray) -> FloatArray:
        """(N, 6, 6) Jacobian of the errors of the reference point and the robot's axes by those of the IMU's pose."""
        by_error = np.zeros((len(rotation), POSE_DIM, POSE_DIM))
        by_error[:, 0:3, 0:3] = IDENTITY
        by_error[:, 0:3, 3:6] = -rotation @ skew(self.mounting.in_imu(np.zeros(3)))
        by_error[:, 3:6, 3:6] = self.mounting.rotation
        return by_error

    def _reference_states(
        self,
        time_s: FloatArray,
        position: FloatArray,
        rotation: FloatArray,
        velocity: FloatArray,
        acceleration: FloatArray,
        rate: FloatArray,
    ) -> States:
        arm = np.broadcast_to(self.mounting.in_imu(np.zeros(3)), position.shape)
        turning = cross(rate, arm)
        return States(
            time_s,
            position + matvec(rotation, arm),
            rotation @ self.mounting.rotation.T,
            velocity + matvec(rotation, turning),
            rate @ self.mounting.rotation.T,
            acceleration + matvec(rotation, cross(rate, turning)),
            np.zeros_like(position),
        )
