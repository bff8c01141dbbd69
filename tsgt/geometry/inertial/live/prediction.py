"""Prediction of the robot's motion beyond the newest knot: strapdown with the samples present, then the motion prior. Sans-I/O.

The state and its covariance are kept a quarter of a second apart, so that a prediction integrates few samples however long
nothing has been measured. Beyond the last sample a linear predictor turns the robot on, and it goes on with the acceleration of the
last samples, as the motion prior says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.inertial.live.rate_prediction import RotationPredictor
from tsgt.geometry.inertial.odometry import WheelsEstimate, covered_steps, linearise_odometry, rejected_steps
from tsgt.geometry.inertial.preintegration import contiguous, preintegrate
from tsgt.geometry.inertial.query import strapdown
from tsgt.geometry.inertial.states import INERTIAL_STATE_DIM, TILT_DIM, concatenate_inertial_states
from tsgt.geometry.rigid import IDENTITY, FloatArray, cross, matvec, skew
from tsgt.geometry.trajectory.gauss_newton import OUTLIER_THRESHOLD
from tsgt.geometry.trajectory.motion_prior import process_noise, transition
from tsgt.geometry.trajectory.propagation import Propagator
from tsgt.geometry.trajectory.states import POSE_DIM, STATE_DIM, States

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.live.rate_prediction import PredictedRotation
    from tsgt.geometry.inertial.odometry import Odometry, OdometrySteps
    from tsgt.geometry.inertial.preintegration import Preintegrated
    from tsgt.geometry.inertial.samples import InertialSamples
    from tsgt.geometry.inertial.states import Gravity, InertialStates, Mounting
    from tsgt.model import ImuNoise, MotionPrior

LINK_S = 0.25  # Between states that are kept
LONG_PREDICTION_S = 1.0  # Beyond the newest knot
MIN_AGREEING, AGREEING_NIS = 4, 7.8
"""Wheels that were rejected count again after as many steps in succession as were rejected, this many at least, whose NIS is within what
95 % of right ones have: the longer the IMU goes on alone, the more often wrong wheels agree with it by chance.
"""
TREND_SPAN_S = 0.1
"""Samples whose mean goes on beyond the last one: shaking of 8 to 60 Hz averages out, steering does not. On a shaken robot
50 ms of rotation were predicted to 0.09 deg; to 0.12 deg with half as long, 0.10 deg with twice as long.
"""
SHAKING_TIME_S = 0.012
"""One sigma of the angle by shaking over that of its rate, and of the velocity over that of its acceleration, between two
instants: for a spectrum that is flat from 8 to 60 Hz.
"""
PREDICTION_NOISE_SCALE = 2.0  # On the variances of the motion prior, as without an IMU


@dataclass(frozen=True, slots=True)
class _Link:
    """A predicted state; errors are those of the state and of what all states share."""

    state: InertialStates  # One
    gravity: Gravity
    covariance: FloatArray  # (D + 2, D + 2)
    by_start: FloatArray  # (D + 2, D + 2) by the error of the newest knot
    must_agree: int = 0  # Steps in which the wheels must agree before they count
    wheels_rejected: bool | None = (
        None  # Whether the wheels contradict the samples since the state before; None: no odometry
    )

    @property
    def time_s(self) -> float:
        return float(self.state.time_s[0])


class StrapdownPredictor:
    """Predicts from one state of the IMU, with the (D + S, D + S) covariance of its error and of what all states share.

    ``motion`` is the prior beyond the last sample; ``gyro_only``: for positions everywhere. ``rotation_predictor``: what has learnt from
    the samples how the robot is shaken.
    """

    def __init__(
        self,
        start: InertialStates,
        covariance: FloatArray,
        gravity: Gravity,
        noise: ImuNoise,
        mounting: Mounting,
        motion: MotionPrior,
        *,
        gyro_only: bool = False,
        rotation_predictor: RotationPredictor | None = None,
    ) -> None:
        self._rotation_predictor = rotation_predictor or RotationPredictor()
        self._dim = len(covariance)
        self._links = [_Link(start, gravity, covariance, np.eye(self._dim))]
        self._latest: _Link | None = (
            None  # Beside these: a pose and its common covariance are asked for in turn
        )
        self._gravity, self._noise, self._mounting, self._motion = gravity, noise, mounting, motion
        self._gyro_only = gyro_only

    @property
    def time_s(self) -> float:
        """Time of the state from which it predicts."""
        return self._links[0].time_s

    def discard_after(self, time_s: float) -> None:
        """Forget what was predicted beyond a time: samples there were missing."""
        self._links[1:] = [link for link in self._links[1:] if link.time_s <= time_s]
        self._latest = None

    def wheels(self, knots: InertialStates, steps: OdometrySteps, duration_s: float) -> WheelsEstimate:
        """Return what the newest state tells of the wheels, with the last steps between knots and beyond, up to a duration."""
        newest = self._links[-1]
        size = newest.state.dim
        part = slice(INERTIAL_STATE_DIM, size)
        from_s = newest.time_s - duration_s
        first = int(knots.time_s[:-1].searchsorted(from_s))
        last, covered = knots.select(slice(first, None)), steps.select(slice(first, None))
        known = covered_steps(covered)
        rejected = rejected_steps(last, covered)
        step_s = np.diff(last.time_s)
        beyond = [
            (link.time_s - before.time_s, link.wheels_rejected)
            for before, link in pairwise(self._links)
            if before.time_s >= from_s and link.wheels_rejected is not None
        ]
        return WheelsEstimate(
            newest.state.wheels[0],
            np.sqrt(np.diagonal(newest.covariance)[part]),
            float(step_s[known].sum()) + sum(each for each, _ in beyond),
            float(step_s[known & rejected].sum()) + sum(each for each, wrong in beyond if wrong),
        )

    def wheels_rejected(self, knots_s: FloatArray) -> NDArray[np.bool_]:
        """(K - 1,) whether the wheels were rejected in the steps between K knots, as far as they are those of a long prediction.

        Many wrong steps together would pull the states between them, however little each counts; shorter ones follow what is measured.
        """
        found = np.zeros(len(knots_s) - 1, np.bool_)
        if self._links[-1].time_s - self.time_s < LONG_PREDICTION_S:
            return found
        for before, link in pairwise(self._links):
            if link.wheels_rejected:
                found |= (knots_s[:-1] < link.time_s) & (knots_s[1:] > before.time_s)
        return found

    def at(
        self, time_s: float, samples: InertialSamples, odometry: Odometry | None = None
    ) -> tuple[States, FloatArray]:
        """State of the reference point and the robot's axes, and the (1, 6, 6) covariance of its pose.

        ``samples``: those present, at least from the start on and at least one; ``odometry`` where the start has wheels.
        """
        link, state, by_error, beyond = self._by_samples(time_s, samples, odometry)
        covariance = by_error @ link.covariance @ by_error.T
        if beyond is not None:
            covariance += self._noise_beyond(beyond)
            onward = Propagator(state, covariance, self._motion, process_noise_scale=PREDICTION_NOISE_SCALE)
            return onward.at(time_s, dim=POSE_DIM)
        covariance = covariance[:POSE_DIM, :POSE_DIM]
        return state, 0.5 * (covariance + covariance.T)[None]

    def by_start(
        self, time_s: float, samples: InertialSamples, odometry: Odometry | None = None
    ) -> FloatArray:
        """(6, D + S) Jacobian of the pose's error at a time by the error of the newest knot and of what all share."""
        link, state, by_error, beyond = self._by_samples(time_s, samples, odometry)
        by_start: FloatArray = by_error @ link.by_start
        if beyond is not None:
            onward = Propagator(state, np.zeros((STATE_DIM, STATE_DIM)), self._motion)
            by_start = onward.by_start(time_s) @ by_start
        return by_start[:POSE_DIM]

    def _by_samples(
        self, time_s: float, samples: InertialSamples, odometry: Odometry | None
    ) -> tuple[_Link, States, FloatArray, _Beyond | None]:
        """Predict to a time or to the last sample before it; also for the reference point, with its Jacobian.

        The last one: how it goes on from there; None: the samples reach the time.
        """
        end_s = min(max(float(samples.end_s[-1]), self.time_s), time_s)
        link = self._at(end_s, samples, odometry)
        beyond: _Beyond | None = None
        if time_s > end_s:
            onward_s = time_s - end_s
            turning = self._rotation_predictor.predict(samples, link.state.gyro_bias[0], onward_s)
            beyond = _Beyond(onward_s, _trend(samples), turning)
        return link, *self._reference_state(link.state, samples, beyond), beyond

    def _at(self, end_s: float, samples: InertialSamples, odometry: Odometry | None) -> _Link:
        """Predict to a time up to the last sample, and keep states on the way."""
        if self._latest is not None and self._latest.time_s == end_s:
            return self._latest
        while self._links[-1].time_s + LINK_S <= end_s:
            last = self._links[-1]
            self._links.append(self._onward(last, last.time_s + LINK_S, samples, odometry))
        number = min(int((end_s - self.time_s) / LINK_S), len(self._links) - 1)
        link = self._links[number]
        self._latest = link if link.time_s == end_s else self._onward(link, end_s, samples, odometry)
        return self._latest

    def _onward(
        self, link: _Link, end_s: float, samples: InertialSamples, odometry: Odometry | None
    ) -> _Link:
        """Predict from one state to a later time, by samples up to then at least."""
        first = int(samples.end_s.searchsorted(link.time_s, side="right"))
        stop = int(samples.end_s.searchsorted(end_s)) + 1
        # The sample before tells where the first one begins.
        some = samples.select(slice(max(first - 1, 0), stop))
        present = contiguous(some, self._noise, start_s=link.time_s, end_s=end_s)
        state = link.state
        bias = np.zeros(3) if self._gyro_only else state.bias_or_acceleration
        motion = preintegrate(present, state.time_s, np.array([end_s]), state.gyro_bias, bias)
        if self._gyro_only:
            moved, by_link, noise = self._turned(state, motion)
        else:
            moved, by_link, noise = self._integrated(state, link.gravity, motion)
        step_s = end_s - link.time_s
        walks = [self._noise.gyro_bias_walk, 0.0 if self._gyro_only else self._noise.accelerometer_bias_walk]
        np.einsum("ii->i", noise)[9:15] += np.repeat(np.square(walks) * step_s, 3)
        moved = replace(moved, time_s=np.array([end_s]))
        if odometry is not None:
            steps = odometry.between(present, state.time_s, np.array([end_s]), state.gyro_bias)
            return self._driven(link, moved, by_link, noise, steps)
        return _Link(
            moved,
            link.gravity,
            by_link @ link.covariance @ by_link.T + noise,
            by_link @ link.by_start,
        )

    def _driven(
        self,
        link: _Link,
        moved: InertialStates,
        by_link: FloatArray,
        noise: FloatArray,
        steps: OdometrySteps,
    ) -> _Link:
        """Predict with wheel odometry over the step: the update of a Kalman filter, whose measurement both its ends enter."""
        wheels, size = slice(INERTIAL_STATE_DIM, moved.dim), moved.dim
        np.einsum("ii->i", by_link)[wheels] = steps.kept[0]
        steps = steps.with_slip(np.repeat(link.state.wheels[0, 1], 2))
        np.einsum("ii->i", noise)[wheels] += steps.process_variances()[0]
        moved = replace(moved, wheels=steps.kept * link.state.wheels)
        rows = linearise_odometry(concatenate_inertial_states([link.state, moved]), steps)[0]
        covariance = by_link @ link.covariance @ by_link.T + noise
        by_start = by_link @ link.by_start
        by_end = np.zeros((len(rows), self._dim))
        by_end[:, :size] = rows[:, size : 2 * size]
        by_both = by_end @ by_link
        by_both[:, :size] += rows[:, :size]
        mixed = by_link @ link.covariance @ by_both.T + noise @ by_end.T
        innovation = by_both @ link.covariance @ by_both.T + by_end @ noise @ by_end.T + np.eye(len(rows))
        gain = np.linalg.solve(innovation, mixed.T).T
        residual = rows[:, -1]
        known = bool(covered_steps(steps)[0])
        nis, must_agree = float(residual @ np.linalg.solve(innovation, residual)), link.must_agree
        if known and nis > (AGREEING_NIS if must_agree else OUTLIER_THRESHOLD**2):
            must_agree = max(must_agree + 1, MIN_AGREEING)
        elif known and must_agree:
            must_agree -= 1
        if known and must_agree:  # Wheels that spin, or did a moment ago
            return _Link(moved, link.gravity, covariance, by_start, must_agree, wheels_rejected=True)
        error = -gain @ residual
        covariance -= gain @ mixed.T
        moved = moved.retract(error[None, :size])
        slips = bool(np.abs(moved.wheels[0, 1]) > OUTLIER_THRESHOLD * steps.slip_sigma)
        return _Link(
            moved,
            link.gravity.retract(error[size:]),
            0.5 * (covariance + covariance.T),
            by_start - gain @ by_both @ link.by_start,
            must_agree,
            wheels_rejected=slips if known else None,
        )

    def _integrated(
        self, state: InertialStates, gravity: Gravity, motion: Preintegrated
    ) -> tuple[InertialStates, FloatArray, FloatArray]:
        """State after a motion, Jacobian of its error, and covariance of the samples' noise, (D + S, D + S) each."""
        found = strapdown(state, gravity, motion)
        step_s = float(motion.duration_s[0])
        by_start, noise = np.eye(self._dim), np.zeros((self._dim, self._dim))
        by_start[0:9, :INERTIAL_STATE_DIM] = found.by_start[0]
        by_tilt = gravity.by_tilt()
        tilt_part = slice(state.dim, state.dim + TILT_DIM)
        by_start[0:3, tilt_part] = 0.5 * step_s**2 * by_tilt
        by_start[6:9, tilt_part] = step_s * by_tilt
        if gravity.matrix.size:
            by_bias = found.by_start[:, :, 12:15]
            by_start[0:9, tilt_part.stop :] = gravity.by_matrix(by_bias, found.force)[0]
        noise[0:9, 0:9] = found.noise[0]
        moved = replace(state, position=found.position, rotation=found.rotation, velocity=found.velocity)
        return moved, by_start, noise

    def _turned(
        self, state: InertialStates, motion: Preintegrated
    ) -> tuple[InertialStates, FloatArray, FloatArray]:
        """As with an accelerometer: rotation by the gyro, position by the motion prior."""
        prior, step_s = self._motion, motion.duration_s
        time_s = np.array(prior.acceleration_correlation_time_s)
        phi = transition(step_s, time_s)[0]
        axes = np.stack([np.zeros(3), state.velocity[0], state.bias_or_acceleration[0]])
        moved = phi @ axes
        by_start, noise = np.eye(self._dim), np.zeros((self._dim, self._dim))
        by_start[3:6, 3:6] = motion.rotation[0].T
        by_start[3:6, 9:12] = motion.by_gyro_bias[0, 3:6]
        noise[3:6, 3:6] = motion.covariance[0, 3:6, 3:6]
        rows = np.array([0, 6, 12])
        of_prior = PREDICTION_NOISE_SCALE * process_noise(step_s, time_s)[0]
        for axis, sigma in enumerate(prior.acceleration_sigma_mps2):
            block = np.ix_(rows + axis, rows + axis)
            by_start[block], noise[block] = phi, sigma**2 * of_prior
        return (
            replace(
                state,
                position=state.position + moved[0],
                rotation=state.rotation @ motion.rotation,
                velocity=moved[None, 1],
                bias_or_acceleration=moved[None, 2],
            ),
            by_start,
            noise,
        )

    def _reference_state(
        self, state: InertialStates, samples: InertialSamples, beyond: _Beyond | None
    ) -> tuple[States, FloatArray]:
        """State of the reference point, with rate and acceleration by the samples, and its Jacobian, (18, D + S).

        ``beyond``: to go on with it beyond the last sample.
        """
        turning: PredictedRotation | None = None
        if beyond is not None:
            rate, force, turning = beyond.trend.rate, beyond.trend.force, beyond.turning
        else:
            row = min(int(samples.end_s.searchsorted(state.time_s[0] - 1e-9)), len(samples) - 1)
            rate, force = samples.angular_rate_radps[row], samples.specific_force_mps2[row]
        rate = rate - state.gyro_bias[0] if turning is None else turning.rate
        rotation, arm = state.rotation[0], self._mounting.in_imu(np.zeros(3))
        circular = cross(rate, arm)
        if self._gyro_only:
            acceleration = state.bias_or_acceleration[0]
        else:
            acceleration = matvec(rotation, force - state.bias_or_acceleration[0]) + self._gravity.vector()
        to_robot = self._mounting.rotation
        by_error = np.zeros((STATE_DIM, self._dim))
        by_error[0:3, 0:3] = by_error[6:9, 6:9] = IDENTITY
        by_error[0:3, 3:6] = -rotation @ skew(arm)
        by_error[3:6, 3:6] = to_robot
        by_error[6:9, 3:6] = -rotation @ skew(circular)
        by_error[6:9, 9:12] = rotation @ skew(arm)
        by_error[9:12, 9:12] = -to_robot
        if self._gyro_only:
            by_error[12:15, 12:15] = IDENTITY
        found = States(
            state.time_s,
            state.position + matvec(rotation, arm),
            state.rotation @ to_robot.T,
            state.velocity + matvec(rotation, circular),
            (to_robot @ rate)[None],
            (acceleration + matvec(rotation, cross(rate, circular)))[None],
            np.zeros((1, 3)),
        )
        return found, by_error

    def _noise_beyond(self, beyond: _Beyond) -> FloatArray:
        """(18, 18) covariance of the motion that goes on beyond the last sample about that of the last samples."""
        onward_s, trend, turning = beyond
        rate, force = trend.rate_sigma, trend.force_sigma
        angular = np.array(self._motion.angular_acceleration_sigma_radps2)
        linear = np.array(self._motion.acceleration_sigma_mps2)
        # The mean is that of half the span ago.
        lag_s = 0.5 * TREND_SPAN_S
        sigmas = np.zeros((6, 3))
        sigmas[1] = SHAKING_TIME_S * rate
        sigmas[3] = lag_s * angular
        sigmas[5] = angular
        if turning is not None:
            # What shook it alone tells nothing of the next turn, whose angular acceleration is that of the prior.
            sigmas[1] = np.maximum(turning.sigma_rad, lag_s * onward_s * angular)
            sigmas[3] = 0.0
        if not self._gyro_only:
            sigmas[2] = SHAKING_TIME_S * force
            sigmas[4] = (
                lag_s / self._motion.acceleration_correlation_time_s * linear
                + force * SHAKING_TIME_S / TREND_SPAN_S
            )
        return np.diag(np.square(sigmas.ravel()))


class _Trend(NamedTuple):
    """Mean rate and force of the last samples, and one sigma of their components about it."""

    rate: FloatArray  # (3,)
    force: FloatArray  # (3,)
    rate_sigma: float
    force_sigma: float


class _Beyond(NamedTuple):
    """Motion beyond the last sample."""

    onward_s: float  # From the last sample on, positive
    trend: _Trend
    turning: PredictedRotation | None  # If there are enough samples to predict the rotation


def _trend(samples: InertialSamples) -> _Trend:
    first = int(samples.end_s.searchsorted(samples.end_s[-1] - TREND_SPAN_S + 1e-9))
    rates, forces = samples.angular_rate_radps[first:], samples.specific_force_mps2[first:]
    count = len(rates)
    rate, force = rates.sum(axis=0) / count, forces.sum(axis=0) / count
    rates, forces = rates - rate, forces - force
    squares = float(np.vdot(rates, rates)), float(np.vdot(forces, forces))
    return _Trend(rate, force, *((each / (3 * count)) ** 0.5 for each in squares))
