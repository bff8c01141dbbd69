"""Normal equations of the states of an IMU and of its set-up, which borders them. Sans-I/O.

Knots are instants of the IMU's own stamps, at the ends of samples, so that no sample is cut: a latency moves the measurements of
the prisms against them. Of the set-up, mounting, latency and delays enter the rows of the prisms alone, and the matrices those
of the preintegrated motion. docs/explanation/imu.md derives the Jacobians.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.inertial import InertialAnchor, InertialStates, inertial_knot_times
from tsgt.geometry.inertial.factors import (
    InertialEquations,
    InertialFactors,
    assemble_inertial,
    linearise_inertial,
)
from tsgt.geometry.inertial.preintegration import preintegrate_with_matrices
from tsgt.geometry.inertial.states import TILT_DIM
from tsgt.geometry.inertial_calibration.setup import (
    ACCELEROMETER_MATRIX,
    DELAYS,
    GYRO_MATRIX,
    LATENCY,
    POSITION,
    ROTATION,
    accelerometer_directions,
    gyro_directions,
)
from tsgt.geometry.rigid import FloatArray, exp_so3, fast_log_so3, inverse_right_jacobian, matvec, skew
from tsgt.geometry.trajectory import coupling, nearest_knots

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial import ContiguousSamples, Gravity
    from tsgt.geometry.inertial_calibration.setup import ImuSetup, SetupPrior
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations
    from tsgt.model import ImuNoise

MAX_SNAP_S = 0.01  # Knots farther than this from the end of a sample stay where they are: samples are missing


@dataclass(frozen=True, slots=True)
class JointProblem:
    """What a calibration is given, and its knots."""

    observations: Observations  # Times of the stations, layout in the axes of the robot
    samples: ContiguousSamples  # At their stamps; neither latency nor matrices applied
    noise: ImuNoise
    knot_index: NDArray[np.intp]  # (M,)
    anchor: InertialAnchor  # On the first state; none on the tilt
    prior: SetupPrior
    tilt_sigma_rad: float
    rejectable: NDArray[np.bool_] | None = None

    @property
    def prior_sigmas(self) -> FloatArray:
        """(2 + D,) of tilt and set-up."""
        return np.concatenate([np.full(TILT_DIM, self.tilt_sigma_rad), self.prior.sigmas])


class JointPoint(NamedTuple):
    """A point at which the problem is linearised."""

    knots: InertialStates
    setup: ImuSetup
    gravity: Gravity

    def retract(self, states: FloatArray, shared: FloatArray) -> JointPoint:
        """Add errors of states, (K, 15), and of tilt and set-up, (2 + D,)."""
        return JointPoint(
            self.knots.retract(states),
            self.setup.retract(shared[TILT_DIM:]),
            replace(self.gravity, tilt=self.gravity.tilt + shared[:TILT_DIM]),
        )


class JointEquations(NamedTuple):
    """Normal equations at a point, without those of the border."""

    states: InertialEquations
    observations: Observations  # As they are seen from the IMU
    factors: InertialFactors
    by_matrices: tuple[
        FloatArray, FloatArray
    ]  # (K - 1, 9, 3, 3) each: the motion's error by those of gyro and accelerometer
    samples: ContiguousSamples  # With the matrices applied
    deviation: FloatArray  # (2 + D,) of tilt and set-up from their prior, in sigmas
    cost: float


class Border(NamedTuple):
    """Blocks of the normal equations that tilt and set-up, 2 + D, have in common with the states, and their own."""

    mixed: FloatArray  # (K, 15, 2 + D)
    corner: FloatArray  # (2 + D, 2 + D) without their prior
    gradient: FloatArray  # (2 + D,) without their prior


def stamp_times(observations: Observations, setup: ImuSetup) -> FloatArray:
    """(M,) stamps of samples at the instants of measurements."""
    delays = np.append(setup.delays_s, np.zeros(len(observations.frames) - len(setup.delays_s)))
    times_s: FloatArray = observations.time_s + setup.latency_s + delays[observations.station]
    return times_s


def knots_at_samples(stamps_s: FloatArray, samples: ContiguousSamples) -> tuple[FloatArray, NDArray[np.intp]]:
    """Knots for measurements at stamps, (M,), at the ends of samples, and the knot of each measurement."""
    times_s = inertial_knot_times(np.sort(stamps_s))
    bounds_s = samples.bounds_s
    near_s = bounds_s[nearest_knots(bounds_s, times_s)]
    times_s = np.unique(np.where(np.abs(near_s - times_s) < MAX_SNAP_S, near_s, times_s))
    return times_s, nearest_knots(times_s, stamps_s)


def assemble_states(problem: JointProblem, point: JointPoint) -> JointEquations:
    """Assemble the states' part of the normal equations."""
    setup = point.setup
    observations = replace(
        problem.observations,
        time_s=stamp_times(problem.observations, setup),
        layout=setup.mounting.in_imu(problem.observations.layout),
    )
    samples = replace(
        problem.samples,
        angular_rate_radps=problem.samples.angular_rate_radps @ setup.gyro_matrix.T,
        specific_force_mps2=problem.samples.specific_force_mps2 @ setup.accelerometer_matrix.T,
    )
    earlier, later_s = point.knots.select(slice(None, -1)), point.knots.time_s[1:]
    motion, *by_matrices = preintegrate_with_matrices(
        samples, earlier.time_s, later_s, earlier.gyro_bias, earlier.bias_or_acceleration
    )
    factors = InertialFactors.between(samples, earlier, later_s, problem.noise, found=motion)
    states = assemble_inertial(
        observations,
        problem.knot_index,
        point.knots,
        samples.at(point.knots.time_s),
        point.gravity,
        factors,
        problem.anchor,
        rejectable=problem.rejectable,
    )
    errors = np.concatenate([point.gravity.tilt, setup.local_coordinates_about(problem.prior.mean)])
    deviation = errors / problem.prior_sigmas
    cost = states.cost + float(deviation @ deviation)
    return JointEquations(
        states, observations, factors, (by_matrices[0], by_matrices[1]), samples, deviation, cost
    )


def assemble_border(problem: JointProblem, point: JointPoint, found: JointEquations) -> Border:
    """Assemble the border of the normal equations."""
    states, knots, setup = found.states, point.knots, point.setup
    count, shared = len(knots), TILT_DIM + setup.dim
    mixed, corner, gradient = np.zeros((count, 15, shared)), np.zeros((shared, shared)), np.zeros(shared)
    mixed[:, :, :TILT_DIM] = states.border
    corner[:TILT_DIM, :TILT_DIM], gradient[:TILT_DIM] = states.corner, states.corner_gradient

    by_setup = measurements_by_setup(found.observations, states.linearised, setup)
    of_setup = slice(TILT_DIM, None)
    of_states = coupling(
        found.observations, states.linearised, states.weights, problem.knot_index, count, by_setup
    )
    mixed[:, 0:9, of_setup] += of_states[:, 0:9]
    mixed[:, 9:12, of_setup] -= of_states[:, 9:12]  # A bias reduces the rate
    information = np.linalg.inv(states.linearised.covariance(found.observations))
    weighted = np.swapaxes(by_setup, 1, 2) @ (information * states.weights[:, None, None])
    corner[of_setup, of_setup] += (weighted @ by_setup).sum(axis=0)
    gradient[of_setup] += matvec(weighted, states.linearised.residuals_m).sum(axis=0)

    rows = linearise_inertial(knots, point.gravity, found.factors)
    by_matrices = motion_by_matrices(knots, setup, found.factors, found.by_matrices)
    own = slice(TILT_DIM + GYRO_MATRIX.start, TILT_DIM + ACCELEROMETER_MATRIX.stop)
    products = np.swapaxes(rows, 1, 2) @ by_matrices
    mixed[:-1, :, own] += products[:, 0:15]
    mixed[1:, :, own] += products[:, 15:30]
    with_tilt = products[:, 30:32].sum(axis=0)
    corner[:TILT_DIM, own] += with_tilt
    corner[own, :TILT_DIM] += with_tilt.T
    corner[own, own] += (np.swapaxes(by_matrices, 1, 2) @ by_matrices).sum(axis=0)
    gradient[own] += products[:, 32].sum(axis=0)
    return Border(mixed, corner, gradient)


def measurements_by_setup(
    observations: Observations, linearised: LinearisedMeasurements, setup: ImuSetup
) -> FloatArray:
    """(M, 3, D) Jacobian of the residuals of the prisms by the error of the set-up."""
    in_axes = linearised.by_point @ linearised.rotation
    jacobian = np.zeros((len(observations), 3, setup.dim))
    jacobian[:, :, ROTATION] = in_axes @ skew(observations.layout[observations.prism])
    jacobian[:, :, POSITION] = -in_axes @ setup.mounting.rotation.T
    by_time = matvec(linearised.by_point, linearised.velocity_mps)
    jacobian[:, :, LATENCY] = by_time
    own = observations.station[:, None] == np.arange(len(setup.delays_s))
    jacobian[:, :, DELAYS] = by_time[:, :, None] * own[:, None]
    return jacobian


def motion_by_matrices(
    knots: InertialStates,
    setup: ImuSetup,
    factors: InertialFactors,
    by_matrices: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """(K - 1, 9, 15) whitened rows of the preintegrated motion by the errors of the gyro's and accelerometer's matrices."""
    found = factors.preintegrated
    # From errors by which values are multiplied to those that are added to the matrices.
    parts = zip(
        by_matrices,
        (setup.gyro_matrix, setup.accelerometer_matrix),
        (gyro_directions(setup.vertical), accelerometer_directions(setup.vertical)),
        strict=True,
    )
    by_error = np.concatenate(
        [
            by_matrix.reshape(len(found), 9, 9) @ (directions @ np.linalg.inv(matrix)).reshape(-1, 9).T
            for by_matrix, matrix, directions in parts
        ],
        axis=2,
    )
    earlier, later = knots.select(slice(None, -1)), knots.select(slice(1, None))
    _, rotation, _ = found.corrected(earlier.gyro_bias, earlier.bias_or_acceleration)
    turned = np.swapaxes(earlier.rotation, 1, 2) @ later.rotation
    residual = fast_log_so3(np.swapaxes(rotation, 1, 2) @ turned)
    by_error[:, 3:6] = inverse_right_jacobian(residual) @ exp_so3(-residual) @ by_error[:, 3:6]
    whitened: FloatArray = -factors.whitening @ by_error
    return whitened
