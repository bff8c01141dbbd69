"""Calibration of an IMU from the motion of a robot that stations measure, without a first guess. Sans-I/O.

The stations' trajectory and the IMU's rates give mounting and latency roughly; then states and set-up are estimated jointly. The
covariance is that of the set-up with the states marginalised, scaled by the disagreement of parts of the drive. See
docs/how-to/calibrate-the-imu.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.inertial import InertialStates, Mounting, contiguous
from tsgt.geometry.inertial.solver import diffuse_inertial_prior
from tsgt.geometry.inertial.states import TILT_DIM
from tsgt.geometry.inertial_calibration.alignment import (
    Alignment,
    align,
    series_of_samples,
    series_of_trajectory,
)
from tsgt.geometry.inertial_calibration.joint_solver import (
    JointSolution,
    minimise,
    solve_jointly,
    states_of_imu,
    without_tilt,
)
from tsgt.geometry.inertial_calibration.joint_system import assemble_border, assemble_states, stamp_times
from tsgt.geometry.inertial_calibration.setup import (
    GYRO_MATRIX,
    POSE_AND_LATENCY_DIM,
    ROTATION,
    ImuSetup,
    SetupPrior,
)
from tsgt.geometry.motion_calibration.timestamp_drift import SegmentInformation, birge_ratio
from tsgt.geometry.trajectory.block_tridiagonal import factorise

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.inertial import Gravity, InertialSamples
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import ImuNoise

MIN_DURATION_S = 60.0
SEGMENT_S = 30.0  # Of the drive, whose disagreement is compared with what noise explains
FACTORY_CALIBRATED, UNCALIBRATED = 1e-3, 1e-2
"""One sigma of the entries of the matrices of scale and misalignment, of two classes of IMUs; the data choose one."""

_EXPECTED_ITERATIONS = 8


@dataclass(frozen=True, slots=True, eq=False)
class ImuCalibration:
    """A set-up found from motion."""

    setup: ImuSetup  # Mounting from the reference point of the layout
    covariance: FloatArray  # (D, D) of its error, scaled by ``birge_ratio``
    prior: SetupPrior
    alignment: Alignment  # The first guess
    matrix_sigma: float  # Of the class of IMUs that the data chose
    log_bayes_factor: float  # Of uncalibrated matrices against those of a factory calibration
    birge_ratio: float  # Factor by which parts of the drive disagree more than noise explains, at least 1
    # (7,) set-up of the first half of the drive less that of the second: rotation in rad, position in m, latency in s
    halves: FloatArray
    halves_sigmas: FloatArray  # (7,) of that difference, by noise alone
    noise_scale: float  # rms of the normalised residuals of the prisms; 1 if their noise explains them
    measurements: int
    outliers: int
    duration_s: float

    @property
    def sigmas(self) -> FloatArray:
        """(D,) of the error."""
        return np.sqrt(np.diag(self.covariance))


def calibrate_imu(
    observations: Observations,
    samples: InertialSamples,
    noise: ImuNoise,
    gravity: Gravity,
    *,
    on_progress: Callable[[float], None] | None = None,
) -> ImuCalibration:
    """Find mounting, latency and gyro matrix.

    Raises GeometryError: too short a drive, one that hardly turns, samples of another one, or measurements that determine no
    trajectory.

    Parameters
    ----------
    observations : In the order of time, with the layout in the axes of the robot and the stated noise.
    samples : At their stamps, neither latency nor matrix applied.
    noise : Of the data sheet.
    on_progress : Called with the completed share of the work, 0 to 1.
    """
    report = on_progress or (lambda _: None)
    check_duration(observations, samples)
    fit = fit_trajectory(observations, on_progress=lambda share: report(0.5 * share))
    alignment = align(series_of_trajectory(fit.trajectory, gravity), series_of_samples(samples))
    filled = contiguous(samples, noise)
    initial = ImuSetup.initial(
        Mounting(alignment.rotation, np.zeros(3)), alignment.latency_s, int(observations.station.max()) + 1
    )
    stamps_s = stamp_times(fit.observations, initial)
    inside = (stamps_s > filled.bounds_s[0] + 1.0) & (stamps_s < filled.bounds_s[-1] - 1.0)
    measured = fit.observations.select(inside)
    if not inside.any() or np.ptp(measured.time_s) < MIN_DURATION_S:
        raise GeometryError(f"samples and measurements have less than {MIN_DURATION_S:g} s in common")

    def guess(times_s: FloatArray, setup: ImuSetup) -> InertialStates:
        return states_of_imu(fit.trajectory.knots, times_s, setup, alignment.gyro_bias)

    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        report(0.5 + 0.4 * min(done / _EXPECTED_ITERATIONS, 1.0))

    solution = solve_jointly(
        measured, filled, noise, guess, SetupPrior.wide(initial, UNCALIBRATED), gravity, on_iteration=count
    )
    narrow = SetupPrior.wide(initial, FACTORY_CALIBRATED)
    log_bayes_factor = _evidence(solution, solution.problem.prior) - _evidence(solution, narrow)
    if log_bayes_factor < 0:
        solution = minimise(replace(solution.problem, prior=narrow), solution.point, count)
    report(0.95)
    return _judged(solution, alignment, log_bayes_factor)


def check_duration(observations: Observations, samples: InertialSamples) -> None:
    """Raise GeometryError if a calibration has too little data."""
    for name, times_s in (("measurements", observations.time_s), ("samples of the IMU", samples.end_s)):
        duration_s = float(np.ptp(times_s)) if len(times_s) else 0.0
        if duration_s < MIN_DURATION_S:
            raise GeometryError(
                f"{duration_s:.0f} s of {name} are too short: drive curves, slopes and bumps for two to five minutes"
            )


def _judged(solution: JointSolution, alignment: Alignment, log_bayes_factor: float) -> ImuCalibration:
    """Compare parts of the drive, and scale the covariance by their disagreement."""
    problem, setup = solution.problem, solution.point.setup
    sigmas = problem.prior_sigmas
    segments = segment_information(solution)
    ratio = birge_ratio(segments, np.diag(sigmas))
    information = np.linalg.inv(solution.factor.shared_covariance) - np.diag(sigmas**-2.0)
    covariance = np.linalg.inv(information / ratio**2 + np.diag(sigmas**-2.0))[TILT_DIM:, TILT_DIM:]
    deviation = solution.equations.deviation / sigmas
    difference, uncertainty = np.zeros(len(sigmas)), np.zeros((len(sigmas), len(sigmas)))
    for sign, half in ((1.0, segments[: len(segments) // 2]), (-1.0, segments[len(segments) // 2 :])):
        own = np.linalg.inv(np.diag(sigmas**-2.0) + sum(each.information for each in half))
        difference -= sign * (own @ (deviation + sum(each.gradient for each in half)))
        uncertainty += own
    of_setup = slice(TILT_DIM, TILT_DIM + POSE_AND_LATENCY_DIM)
    difference, uncertainty = difference[of_setup], uncertainty[of_setup, of_setup]
    covariance[ROTATION, ROTATION] += variation(difference[ROTATION], uncertainty[ROTATION, ROTATION])
    states = solution.equations.states
    used = states.weights > 0
    # The median of a chi-square distribution with three degrees of freedom is 2.366.
    noise_scale = float(np.sqrt(np.median(states.squared_distances[used]) / 2.366))
    return ImuCalibration(
        setup,
        0.5 * (covariance + covariance.T),
        problem.prior,
        alignment,
        float(problem.prior.sigmas[GYRO_MATRIX][0]),
        log_bayes_factor,
        ratio,
        difference,
        np.sqrt(np.diag(uncertainty)),
        noise_scale,
        len(problem.observations),
        int(np.count_nonzero(states.weights < 1.0)),
        float(np.ptp(problem.observations.time_s)),
    )


def variation(difference: FloatArray, covariance: FloatArray) -> FloatArray:
    """(3, 3) covariance of a rotation at any time of a drive, during which it changes, beside that of its mean.

    The scale factors of a gyro change with its temperature, and so do its axes. ``difference``: (3,) of the halves, with
    its covariance by noise. A uniform change by d from half to half has the variance d^2 / 3; no change is assumed unless
    noise explains half of the square at most.
    """
    squares = float(difference @ np.linalg.solve(covariance, difference))
    share = max(0.0, 1.0 - 2.0 * len(difference) / max(squares, 1e-12))
    return share * np.outer(difference, difference) / 3.0


def segment_information(solution: JointSolution) -> list[SegmentInformation]:
    """Information of parts of the drive on tilt and set-up, states eliminated, without the prior; at least two parts."""
    problem, knots = solution.problem, solution.point.knots
    times_s = knots.time_s
    count = max(round(float(times_s[-1] - times_s[0]) / SEGMENT_S), 2)
    edges = np.searchsorted(times_s, np.linspace(times_s[0], times_s[-1], count + 1)[1:-1])
    found = []
    for start, stop in zip([0, *edges], [*edges, len(times_s)], strict=True):
        rows = np.flatnonzero((problem.knot_index >= start) & (problem.knot_index < stop))
        part = knots.select(slice(start, stop))
        own = replace(
            problem,
            observations=problem.observations.select(rows),
            knot_index=problem.knot_index[rows] - start,
            anchor=without_tilt(
                diffuse_inertial_prior(part.select(slice(0, 1)), solution.point.gravity, problem.noise)
            ),
            rejectable=None if problem.rejectable is None else problem.rejectable[rows],
        )
        point = solution.point._replace(knots=part)
        equations = assemble_states(own, point)
        border = assemble_border(own, point, equations)
        factor = factorise(equations.states.diagonal, equations.states.off_diagonal)
        solved = factor.solve(np.concatenate([border.mixed, equations.states.gradient[:, :, None]], axis=2))
        eliminated = np.einsum("kbs,kbt->st", border.mixed, solved)
        information = border.corner - eliminated[:, :-1]
        found.append(
            SegmentInformation(0.5 * (information + information.T), border.gradient - eliminated[:, -1])
        )
    return found


def _evidence(solution: JointSolution, prior: SetupPrior) -> float:
    """Log marginal likelihood of the data under a prior, up to a constant."""
    fitted = solution.problem.prior_sigmas
    information = np.linalg.inv(solution.factor.shared_covariance) - np.diag(fitted**-2.0)
    deviation = solution.equations.deviation
    at_mean = -deviation / fitted - information @ (deviation * fitted)
    sigmas = replace(solution.problem, prior=prior).prior_sigmas
    normal = np.eye(len(sigmas)) + sigmas[:, None] * information * sigmas
    scaled = sigmas * at_mean
    return 0.5 * float(scaled @ np.linalg.solve(normal, scaled) - np.linalg.slogdet(normal)[1])
