"""Hyperparameters of the estimator: motion prior, noise, and a floor for the process noise. Sans-I/O.

:func:`tune` maximises the evidence (type-II maximum likelihood); its gradient is that of the expected complete-data log
likelihood (Fisher's identity). :func:`with_noise_floor` bounds the process noise of a tuned prior: one tuned to minutes of
straight driving makes the next bend impossible. See docs/explanation/continuous-trajectory.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.batch.adaptive_noise import ADAPTATIONS, adapted_sigmas
from tsgt.geometry.batch.average_information import (
    AverageInformation,
    measurement_variates,
    process_variates,
)
from tsgt.geometry.batch.evidence_search import Curved, maximise
from tsgt.geometry.batch.knots import shared_knot_times
from tsgt.geometry.batch.noise_scales import (
    MIN_SCALE,
    SCALE_SPREAD,
    log_scale_gradient,
    min_scales,
    overall_scale,
)
from tsgt.geometry.batch.process_moments import (
    ProcessMoments,
    expected_moments,
    expected_squared_distances,
)
from tsgt.geometry.rest import find_rest, in_rest, rest_factors, steps_in_rest, with_vibration
from tsgt.geometry.trajectory.gauss_newton import (
    LOOSE_GAIN_TOLERANCE,
    REJECTION_THRESHOLD,
    log_evidence,
    solve,
)
from tsgt.geometry.trajectory.initialisation import initial_guess
from tsgt.geometry.trajectory.motion_prior import (
    axis_correlation_times_s,
    axis_sigmas,
    prior_from_axes,
    process_information,
    transition,
)
from tsgt.model import MIN_PRISMS, MotionPrior

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.geometry.trajectory.states import States

SEGMENT_S = 40.0
SEGMENTS = 4  # Evenly spread segments that represent a long recording
MIN_MEASUREMENTS = 30  # Per segment
_SIGMA_PARAMETERS = np.array([0, 0, 1, 3, 3, 4])  # By axis; x and y share one, roll and pitch too
_TIME_PARAMETERS = (2, 5)
_SCALE_PARAMETERS = slice(6, -1)  # Factors on the noise by station and component
_LOWER = np.log([3e-3, 3e-3, 0.03, 3e-3, 3e-3, 0.03])
_MIN_SIGMA = 3e-3
_UPPER = np.log([30.0, 30.0, 10.0, 30.0, 30.0, 10.0])
# A prior of white acceleration follows every measurement if it may, and then there seems to be no noise.
_SCALE_LIMITS = np.log([MIN_SCALE, 30.0])
_ADAPTED_ITERATIONS = 2  # The next adaptation need not wait for convergence
_TIME_SCALE_LIMITS = np.log([0.05, 1.0])
_MEDIAN_SQUARED_DISTANCE = 2.37  # Of the chi-square distribution with 3 degrees of freedom
_DIFFERENCE_STEP = 1e-3


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """Maximum-evidence hyperparameters."""

    prior: MotionPrior
    noise_scales: (
        FloatArray  # (S, 3) factors on the stated noise by station (row of the frames) and component
    )
    noise_scale: float  # Their root mean square over all measurements and components
    log_evidence: float  # Up to a constant; of the measurements and of the deviations of the factors


class _Segment:
    """One segment of measurements and its most probable trajectory so far, the initial guess of the next evaluation."""

    def __init__(self, observations: Observations) -> None:
        self.observations, self.knots = _without_blunders(observations)
        self.rest = find_rest(observations)
        self.moving = ~steps_in_rest(self.rest, self.knots.time_s)
        self.measured_moving = in_rest(self.rest, self.observations.time_s) < 0
        self.local = np.ones((len(self.moving), 6))  # Factors on the variance of the accelerations
        self.log_evidence = -np.inf
        self.at: tuple[FloatArray, AverageInformation] | None = None  # Parameters of the trajectory

    def factors(self, prior: MotionPrior) -> tuple[FloatArray, FloatArray | None]:
        """Acceleration sigmas of each step, (K - 1, 6), and what :func:`rest_factors` gives at rest."""
        moving = axis_sigmas(prior) * np.sqrt(self.local)
        return rest_factors(self.rest, self.knots.time_s, moving, self.observations.layout)

    def with_noise(self, parameters: FloatArray) -> Observations:
        """Return the measurements with the noise of given parameters; at rest with their own."""
        stated = self.observations
        _, scales = _from_log_parameters(parameters)
        factors = np.where(self.measured_moving[:, None], scales[stated.station], 1.0)
        time_sigma_s = stated.time_sigma_s * float(np.exp(parameters[-1]))
        scaled = replace(stated, sigmas_m=stated.sigmas_m * factors, time_sigma_s=time_sigma_s)
        return with_vibration(scaled, self.rest, stated.sigmas_m)

    def adapt(self, parameters: FloatArray) -> None:
        """Let the process noise follow the motion, with given parameters."""
        prior, _ = _from_log_parameters(parameters)
        observations = self.with_noise(parameters)
        self.local = np.ones_like(self.local)
        initial, rest = self.factors(prior)
        sigmas = initial
        for _ in range(ADAPTATIONS):
            solution = solve(
                observations,
                self.knots,
                prior,
                sigmas=sigmas,
                rest=rest,
                max_iterations=_ADAPTED_ITERATIONS,
                gain_tolerance=LOOSE_GAIN_TOLERANCE,
                reject_outliers=False,
            )
            self.knots = solution.knots
            sigmas = adapted_sigmas(
                solution,
                *solution.factor.marginals(),
                sigmas=sigmas,
                initial_sigmas=initial,
                adaptable=self.moving,
            )
        self.local = (np.maximum(sigmas, np.minimum(initial, _MIN_SIGMA)) / initial) ** 2
        self.log_evidence, self.at = -np.inf, None

    def guess(self, parameters: FloatArray) -> States:
        """Guess the trajectory that is most probable with other parameters."""
        if self.at is None:
            return self.knots
        at, information = self.at
        return self.knots.retract(information.displacement(parameters - at))

    def record(
        self, knots: States, log_evidence: float, parameters: FloatArray, information: AverageInformation
    ) -> None:
        """Keep a trajectory if it is more probable."""
        if log_evidence > self.log_evidence:
            self.knots, self.log_evidence = knots, log_evidence
            self.at = parameters, information


def tune(
    observations: Observations,
    *,
    start: MotionPrior | None = None,
    noise_scale: FloatArray | float | None = None,
    noise_only: bool = False,
) -> Hyperparameters:
    """Find the maximum-evidence hyperparameters.

    Raises GeometryError: no segment has enough measurements of three prisms.

    Parameters
    ----------
    observations : In the order of time, with the stated noise.
    start : Initial prior; hardly affects the result.
    noise_scale : Kept at this value, or these of (S, 3); estimated as well when not given.
    noise_only : Keep the prior and estimate only the noise.
    """
    scales = np.ones((len(observations.frames), 3)) * (1.0 if noise_scale is None else noise_scale)
    initial = log_parameters(MotionPrior() if start is None else start, scales)
    lowest, highest = np.repeat(_SCALE_LIMITS[:, None], scales.size, axis=1)
    lower = np.minimum(np.concatenate([_LOWER, lowest, _TIME_SCALE_LIMITS[:1]]), initial)
    upper = np.maximum(np.concatenate([_UPPER, highest, _TIME_SCALE_LIMITS[1:]]), initial)
    if noise_scale is not None:
        lower[len(_LOWER) :] = upper[len(_LOWER) :] = initial[len(_LOWER) :]
    if noise_only:
        lower[: len(_LOWER)] = upper[: len(_LOWER)] = initial[: len(_LOWER)]
    return maximise_evidence(observations, initial, lower, upper)


def maximise_evidence(
    observations: Observations,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
) -> Hyperparameters:
    """Maximise the evidence; bounds and start: (P,) each, in the order of :func:`log_parameters`; as :func:`tune`.

    The process noise varies along the drive, and the evidence is that with its estimate.
    """
    segments = _segments(observations)
    least = np.full_like(lower, -np.inf)
    rest = [interval for segment in segments for interval in segment.rest]
    least[_SCALE_PARAMETERS] = np.log(min_scales(observations, rest)).ravel()
    lower = np.where(lower < upper, np.clip(least, lower, upper), lower)
    start = np.clip(start, lower, upper)

    def evidence(parameters: FloatArray) -> Curved:
        total = _log_hyperprior(parameters)
        for segment in segments:
            part = _evidence(segment, parameters)
            total = Curved(
                total.value + part.value,
                total.gradient + part.gradient,
                total.information + part.information,
            )
        return total

    found, value = maximise(evidence, start, lower, upper)
    try:
        for segment in segments:
            segment.adapt(found)
        found, value = maximise(evidence, found, lower, upper)
    except GeometryError:
        # Next to no process noise in a calm second, at the lower limit: singular to rounding. The first result holds.
        pass
    prior, scales = _from_log_parameters(found)
    return Hyperparameters(prior, scales, overall_scale(observations, scales), value)


def _segments(observations: Observations) -> list[_Segment]:
    time_s = observations.time_s
    span_s = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    count = 1 if span_s <= SEGMENT_S * SEGMENTS else SEGMENTS
    length_s = span_s if count == 1 else SEGMENT_S
    # Long recordings often begin and end with a stationary robot surrounded by people.
    starts = time_s[0] + (np.arange(count) + 0.5) / count * span_s - length_s / 2 if len(time_s) else ()
    found = []
    for start_s in starts:
        rows = (time_s >= start_s - 1e-9) & (time_s <= start_s + length_s + 1e-9)
        if np.count_nonzero(rows) >= MIN_MEASUREMENTS:
            try:
                found.append(_Segment(observations.select(rows)))
            except GeometryError:
                continue
    if not found:
        raise GeometryError(
            f"too few measurements to tune the motion prior: no {length_s:.0f} s of them have "
            f"{MIN_MEASUREMENTS}, of at least 3 prisms"
        )
    return found


def _without_blunders(observations: Observations) -> tuple[Observations, States]:
    """Remove measurements of something else, which say nothing about the noise: a few of them would double a factor.

    Return a first trajectory as well.
    """
    guess = initial_guess(observations, shared_knot_times(observations.time_s))
    solution = solve(
        observations, guess, MotionPrior(), gain_tolerance=LOOSE_GAIN_TOLERANCE, reject_outliers=False
    )
    squared = solution.squared_distances
    scale_squared = max(float(np.median(squared)) / _MEDIAN_SQUARED_DISTANCE, 1.0)
    kept = squared <= REJECTION_THRESHOLD**2 * scale_squared
    if kept.all():
        return observations, solution.knots
    observations = observations.select(kept)
    return observations, initial_guess(observations, shared_knot_times(observations.time_s))


def log_parameters(prior: MotionPrior, scales: FloatArray) -> FloatArray:
    """(7 + 3 S,) logarithms of prior and noise scales, (S, 3).

    Acceleration sigmas x and z and correlation time, the same of the rotation, the factors on the noise, and one on the time
    sigmas. These allow for errors that measurements share for minutes, which do not scatter: with all of them as white noise,
    there would seem to be less noise of the instruments. The factor is for the tuning only.
    """
    sigmas = axis_sigmas(prior)
    x, _, z, roll, _, yaw = sigmas
    times_s = prior.acceleration_correlation_time_s, prior.angular_acceleration_correlation_time_s
    motion = np.log([x, z, times_s[0], roll, yaw, times_s[1]])
    return np.concatenate([motion, np.log(scales).ravel(), [0.0]])


def _from_log_parameters(parameters: FloatArray) -> tuple[MotionPrior, FloatArray]:
    values = np.exp(parameters)
    scales = values[_SCALE_PARAMETERS].reshape(-1, 3)
    return prior_from_axes(list(values[_SIGMA_PARAMETERS]), list(values[list(_TIME_PARAMETERS)])), scales


def _log_hyperprior(parameters: FloatArray) -> Curved:
    """Log density of the factors' deviations from the most probable common one, their mean."""
    factors = parameters[_SCALE_PARAMETERS]
    deviations = (factors - factors.mean()) / SCALE_SPREAD
    gradient, precision = np.zeros_like(parameters), np.zeros((len(parameters), len(parameters)))
    gradient[_SCALE_PARAMETERS] = -deviations / SCALE_SPREAD
    precision[_SCALE_PARAMETERS, _SCALE_PARAMETERS] = (
        np.eye(len(factors)) - 1.0 / len(factors)
    ) / SCALE_SPREAD**2
    return Curved(-0.5 * float(deviations @ deviations), gradient, precision)


def _evidence(segment: _Segment, parameters: FloatArray) -> Curved:
    """Log evidence of one segment by the log parameters."""
    prior, _ = _from_log_parameters(parameters)
    observations = segment.with_noise(parameters)
    step_sigmas, rest = segment.factors(prior)
    guess = segment.guess(parameters)
    solution = solve(
        observations,
        guess,
        prior,
        sigmas=step_sigmas,
        rest=rest,
        gain_tolerance=LOOSE_GAIN_TOLERANCE,
        reject_outliers=False,
    )
    value = log_evidence(solution, observations, prior, step_sigmas)
    information = _average_information(segment, parameters, solution, observations, step_sigmas)
    segment.record(solution.knots, value, parameters, information)
    covariance, cross_covariance = solution.factor.marginals()
    gradient = np.zeros(len(parameters))
    by_scale, gradient[-1] = log_scale_gradient(solution, observations, covariance, segment.measured_moving)
    gradient[_SCALE_PARAMETERS] = by_scale.ravel()
    moments = expected_moments(solution, covariance, cross_covariance)
    sigmas, dt_s = axis_sigmas(prior), np.diff(solution.knots.time_s)
    energies = expected_squared_distances(moments, solution.process.phi, solution.process.information)
    for axis, parameter in enumerate(_SIGMA_PARAMETERS):
        gradient[parameter] += float((energies[:, axis] - 3.0)[segment.moving].sum())
    for axes, parameter, time in zip(
        (slice(0, 3), slice(3, 6)), _TIME_PARAMETERS, np.exp(parameters[list(_TIME_PARAMETERS)]), strict=True
    ):
        axis_moments = moments[0][:, axes], moments[1][:, axes], moments[2][:, axes]
        up, down = (
            _expected_log_density(
                axis_moments, dt_s, time * np.exp(sign * _DIFFERENCE_STEP), step_sigmas[:, axes]
            )
            for sign in (1, -1)
        )
        gradient[parameter] = (up - down) / (2 * _DIFFERENCE_STEP)
    # The prior on the first knot's accelerations.
    first = np.concatenate([solution.knots.acceleration[0], solution.knots.angular_acceleration[0]])
    expected = (first**2 + np.diag(covariance[0])[12:]) / sigmas**2 - 1.0
    np.add.at(gradient, _SIGMA_PARAMETERS, expected)
    return Curved(value, gradient, information.information)


def _average_information(
    segment: _Segment,
    parameters: FloatArray,
    solution: Solution,
    observations: Observations,
    step_sigmas: FloatArray,
) -> AverageInformation:
    """Average information of the log parameters at a solution."""
    sigma_parameters, sigma_of_axis = np.unique(_SIGMA_PARAMETERS, return_inverse=True)
    process = process_variates(
        solution,
        step_sigmas,
        np.exp(parameters[list(_TIME_PARAMETERS)]),
        sigma_of_axis=sigma_of_axis.tolist(),
        scaled=segment.moving,
    )
    noise = measurement_variates(solution, observations, segment.measured_moving)
    mixing = np.zeros((len(process.products) + len(noise.products), len(parameters)))
    count = len(process.products)
    mixing[np.arange(count), [*sigma_parameters, *_TIME_PARAMETERS]] = 1.0
    mixing[count:, len(_LOWER) :] = np.eye(len(mixing) - count)
    return AverageInformation.of(solution, (process, noise), mixing)


def _expected_log_density(
    moments: ProcessMoments, dt_s: FloatArray, time_s: float, sigmas: FloatArray
) -> float:
    """Return the expected log density of the process residuals, as far as it depends on the correlation time."""
    phi, information = transition(dt_s, time_s), process_information(dt_s, time_s)
    squared_distances = expected_squared_distances(moments, phi[:, None], information[:, None]) / sigmas**2
    _, logdet = np.linalg.slogdet(information)
    return -0.5 * float(squared_distances.sum()) + 0.5 * float(sigmas.shape[1] * logdet.sum())


NOISE_FLOOR_SHARE = 1.0 / 3.0  # Of the configured prior's process noise
OUTAGE_S = 2.0  # Longest gap between measurements of a prism that counts as observed

_MANOEUVRE_RADPS = 1.0  # Accelerating and braking, or turning there and back: six seconds


def with_noise_floor(prior: MotionPrior, floor: MotionPrior, share: float = 1.0) -> MotionPrior:
    """Raise the process noise of a prior to that of ``share`` times the sigmas of ``floor``, axis by axis.

    Priors are compared by the power spectral density of the acceleration at the frequency of manoeuvres, ``sigma^2 time /
    (1 + (frequency time)^2)``: a sigma means little if the acceleration is too short or too long for a manoeuvre.
    Correlation times are kept.
    """
    times_s = axis_correlation_times_s(prior)
    min_sigmas = (
        share
        * axis_sigmas(floor)
        * np.sqrt(_relative_power(axis_correlation_times_s(floor)) / _relative_power(times_s))
    )
    return prior_from_axes(np.maximum(axis_sigmas(prior), min_sigmas), times_s[[0, 3]])


def _relative_power(time_s: FloatArray) -> FloatArray:
    """Power spectral density of an acceleration with unit sigma at the frequency of manoeuvres, up to a factor."""
    return time_s / (1.0 + (_MANOEUVRE_RADPS * time_s) ** 2)


def partially_occluded(time_s: FloatArray, prism: NDArray[np.intp], at_s: FloatArray) -> NDArray[np.bool_]:
    """Whether fewer than three prisms are observed at times ``at_s``, (N,).

    That is while their measurements (M increasing times, M prisms) before and after are at most :data:`OUTAGE_S` apart.
    """
    observed = np.zeros(len(at_s), np.intp)
    for each in np.unique(prism):
        own_s = np.concatenate([[-np.inf], time_s[prism == each], [np.inf]])
        after = np.searchsorted(own_s, at_s)
        observed += own_s[after] - own_s[after - 1] <= OUTAGE_S
    return observed < MIN_PRISMS
