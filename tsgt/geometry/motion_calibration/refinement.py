"""Refinement of a calibrated set-up: what of it a drive contradicts, by evidence, and the estimate. Sans-I/O.

Each hypothesis widens the calibration's covariance in a few directions. Its log Bayes factor follows from the joint normal
equations with the trajectories eliminated, linearised once at the set-up that fits best if everything may be wrong, with the
noise and the weights of that set-up: a wrong frame must not pass for noise. Hypotheses are added one by one while the evidence
for the next one is strong. docs/explanation/refinement.md derives it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from tsgt.geometry.batch import tune
from tsgt.geometry.motion_calibration.hypotheses import Hypothesis, hypotheses
from tsgt.geometry.motion_calibration.information import Information
from tsgt.geometry.motion_calibration.joint_system import Segment, linearise_jointly, split_segments
from tsgt.geometry.motion_calibration.setup_parameters import deformation_modes
from tsgt.geometry.motion_calibration.setup_prior import factor_of
from tsgt.geometry.motion_calibration.timestamp_drift import (
    SegmentInformation,
    birge_ratio,
    eliminate_wander,
    estimate_wander_s,
)

if TYPE_CHECKING:
    from tsgt.geometry.motion_calibration.setup_parameters import Setup, SetupParameters
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import MotionPrior

MAX_SEGMENTS = 24  # A quarter of an hour: more would not change the choice, only its time
MAX_ITERATIONS = 4
STEP_TOLERANCE = 0.1  # Squared length of a step, in sigmas of the set-up
MIN_LOG_BAYES_FACTOR = 3.0  # Beyond the logarithm of the number of hypotheses
ABSORBED = 1e-6  # Share of a parameter's own information below which a direction carries none
MIN_LOG_BAYES_FACTOR_OF_USE = 20.0
"""Drives with an exact set-up, whose motion is not that of the prior, reached 15; the published ones have 120 and 320."""

RETUNED_LOG_BAYES_FACTOR = 0.5 * MIN_LOG_BAYES_FACTOR_OF_USE
"""Noise and prior are tuned again, with the set-up that fits best, if the evidence may exceed this with those of the reference. If
it cannot, no set-up explains enough of the residuals to have passed for noise, and tuning them again would change neither."""

GROSS_ERROR = 4.0
"""Sigmas of a hypothesis or of the calibration beyond which the data are not those of this set-up: another robot's layout, or
swapped prisms. The set-up stays as it is then, and its residuals show it."""


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisEvidence:
    """What the data say about one hypothesis."""

    hypothesis: Hypothesis  # Its prior odds are not part of the Bayes factors
    log_bayes_factor: float  # Against the set-up as calibrated, if this alone is wrong
    selected: bool
    estimate: FloatArray  # (m,) if this alone is wrong
    sigma: FloatArray  # (m,)


@dataclass(frozen=True, slots=True, eq=False)
class RefinedSetup:
    """A set-up, refined where the data contradict it."""

    setup: Setup
    parameters: SetupParameters  # about the calibrated set-up
    covariance: FloatArray  # (G, G) of the parameters: posterior if used, otherwise the calibration's
    used: bool  # Whether the set-up differs from the calibrated one
    log_bayes_factor: (
        float  # Of the calibration's covariance and what was selected, against a set-up that is exact
    )
    p_value: float  # Of data that agree as little with the calibration and its covariance, if both are right
    evidence: tuple[HypothesisEvidence, ...]
    birge_ratio: float  # Factor by which segments disagree more than noise explains; in the covariance
    wander_s: float  # One sigma of each station's latency from segment to segment
    motion_prior: (
        MotionPrior  # Tuned with the set-up that fits best if everything may be wrong, if that may differ
    )


def refine_setup(
    observations: Observations,
    parameters: SetupParameters,
    covariance: FloatArray,
    prior: MotionPrior,
    noise_scales: FloatArray,
    *,
    prisms: bool = False,
) -> RefinedSetup:
    """Refine the parameters' reference set-up where the data contradict it.

    Raises GeometryError: too few measurements, or they determine no trajectory.

    Parameters
    ----------
    observations : Polar measurements in the order of time, with the reference set-up and the stated noise.
    covariance : (G, G) of the reference set-up, as its calibration states it.
    prior, noise_scales : Tuned with the reference set-up.
    prisms : Whether prism positions may be refined; their evidence is computed in any case.
    """
    segments = split_segments(observations, max_segments=MAX_SEGMENTS)
    nominal = factor_of(covariance)
    tested = hypotheses(parameters)
    wide = np.concatenate([nominal, *(each.factor for each in tested)], axis=1)
    model = prior, noise_scales
    setup, information = _fit(segments, parameters, wide, parameters.reference, *model)
    if _total(information, 1.0).max_evidence(nominal, wide) > RETUNED_LOG_BAYES_FACTOR:
        tuned = tune(setup.applied(observations), start=prior)
        model = tuned.prior, tuned.noise_scales
        setup, information = _fit(segments, parameters, wide, setup, *model)
    wander_s = estimate_wander_s(*_at_optimum(information, wide), parameters.latencies)
    information = _without_wander(information, parameters, wander_s)
    birge = birge_ratio(_at_optimum(information, wide)[0], wide)
    total = _total(information, birge)
    allowed = [each for each in tested if prisms or each.kind != "prism"]
    selected = _select(total, nominal, allowed)
    factor = _widened(nominal, *selected)
    # Against a set-up that is exact: its evidence is the constant that the others leave out.
    gain = total.evidence(factor)
    used = gain > MIN_LOG_BAYES_FACTOR_OF_USE
    evidence = tuple(
        HypothesisEvidence(
            each,
            total.evidence(_widened(nominal, each)) - total.evidence(nominal),
            used and each in selected,
            *_estimate(total, nominal, each),
        )
        for each in tested
    )
    p_value = _p_value(total, nominal, wide)
    setup, posterior = parameters.reference, covariance
    if used:
        considered = np.empty(0, np.intp) if prisms else parameters.prisms.ravel()
        estimated = factor.copy()
        estimated[considered] = 0.0
        setup = parameters.retract(parameters.reference, total.posterior(estimated)[0])
        setup, information = _fit(segments, parameters, estimated, setup, *model, wander_s=wander_s)
        final = _total(information, birge)
        used = float(np.abs(final.coordinates(estimated)).max()) < GROSS_ERROR
        mean, refined = final.posterior(estimated)
        setup = parameters.retract(parameters.reference, mean) if used else parameters.reference
    if used:
        # Schmidt: what is not estimated displaces the estimate, by its own uncertainty.
        displaced = refined @ final.matrix[:, considered] - np.eye(parameters.count)[:, considered]
        displaced = displaced @ factor[considered]
        posterior = refined + displaced @ displaced.T
    return RefinedSetup(
        setup, parameters, posterior, used, gain, p_value, evidence, birge, wander_s, model[0]
    )


def _fit(
    segments: list[Segment],
    parameters: SetupParameters,
    factor: FloatArray,
    setup: Setup,
    prior: MotionPrior,
    noise_scales: FloatArray,
    *,
    wander_s: float = 0.0,
) -> tuple[Setup, list[SegmentInformation]]:
    """Gauss-Newton on the set-up; return the last one, and the segments there, linearised, with gradients at the reference."""
    # A rigid displacement of all prisms changes the motion prior's reference point alone, which is no information on it.
    observable = np.eye(parameters.count)
    modes, at_prisms = deformation_modes(setup.layout), parameters.prisms.ravel()
    observable[np.ix_(at_prisms, at_prisms)] = modes @ modes.T
    for iteration in range(MAX_ITERATIONS):
        system = linearise_jointly(segments, parameters, setup, prior, noise_scale=noise_scales)
        at = parameters.local_coordinates(setup)
        found = [
            SegmentInformation(
                observable @ information @ observable, observable @ (gradient - information @ at)
            )
            for information, gradient in map(_without_rounding, system.segments)
        ]
        found = _without_wander(found, parameters, wander_s)
        total = _total(found, 1.0)
        mean, _ = total.posterior(factor)
        if iteration == MAX_ITERATIONS - 1 or (mean - at) @ total.matrix @ (mean - at) < STEP_TOLERANCE:
            break
        setup = parameters.retract(parameters.reference, mean)
    return setup, found


def _without_rounding(segment: SegmentInformation) -> SegmentInformation:
    """Remove what rounding leaves in directions that the trajectory absorbs."""
    variances = np.diag(segment.information)
    informed = variances > 0
    scale = np.sqrt(np.where(informed, variances, 1.0))
    normalised = 0.5 * (segment.information + segment.information.T) / np.outer(scale, scale)
    normalised[~informed] = normalised[:, ~informed] = 0.0
    values, vectors = np.linalg.eigh(normalised)
    seen = values > ABSORBED
    kept = scale[:, None] * vectors[:, seen]
    # The search for the trajectory ends at a tolerance, which leaves a gradient in those directions.
    gradient = kept @ (vectors[:, seen].T @ (segment.gradient / scale))
    return SegmentInformation((kept * values[seen]) @ kept.T, gradient)


def _without_wander(
    segments: list[SegmentInformation], parameters: SetupParameters, wander_s: float
) -> list[SegmentInformation]:
    if wander_s == 0:
        return segments
    return [eliminate_wander(each, parameters.latencies, wander_s).segment for each in segments]


def _total(segments: list[SegmentInformation], birge: float) -> Information:
    information = np.sum([each.information for each in segments], axis=0) / birge**2
    vector = -np.sum([each.gradient for each in segments], axis=0) / birge**2
    return Information(0.5 * (information + information.T), vector)


def _at_optimum(
    segments: list[SegmentInformation], factor: FloatArray
) -> tuple[list[SegmentInformation], FloatArray, FloatArray]:
    """Segments with gradients at the joint optimum under a prior, the prior's factor, and that optimum in its coordinates."""
    total = _total(segments, 1.0)
    deviation = total.coordinates(factor)
    mean = factor @ deviation
    moved = [
        SegmentInformation(each.information, each.gradient + each.information @ mean) for each in segments
    ]
    return moved, factor, deviation


def _widened(factor: FloatArray, *added: Hypothesis) -> FloatArray:
    return np.concatenate([factor, *(each.factor for each in added)], axis=1)


def _select(total: Information, nominal: FloatArray, allowed: list[Hypothesis]) -> list[Hypothesis]:
    """Select hypotheses one by one, and return them in that order."""
    selected: list[Hypothesis] = []
    factor, remaining = nominal, list(allowed)
    threshold = MIN_LOG_BAYES_FACTOR + math.log(len(allowed))
    while remaining:
        base = total.evidence(factor)
        odds = [each.log_prior + (total.evidence(_widened(factor, each)) - base) for each in remaining]
        best = int(np.argmax(odds))
        if odds[best] < threshold:
            break
        selected.append(remaining.pop(best))
        factor = _widened(factor, selected[-1])
    return selected


def _estimate(
    total: Information, nominal: FloatArray, hypothesis: Hypothesis
) -> tuple[FloatArray, FloatArray]:
    """Estimate and sigma, (m,) each, of a hypothesis alone."""
    factor = _widened(nominal, hypothesis)
    m = len(hypothesis.sigmas)
    variances = np.diag(np.linalg.inv(total.normal(factor)))[-m:]
    return hypothesis.sigmas * total.coordinates(factor)[-m:], hypothesis.sigmas * np.sqrt(variances)


def _p_value(total: Information, nominal: FloatArray, wide: FloatArray) -> float:
    """Probability of data that agree less with the reference, given its covariance, by chi-square of their gradient.

    Only directions on which the data say more than the wide prior count.
    """
    values, vectors = np.linalg.eigh(wide.T @ total.matrix @ wide)
    directions = wide @ vectors[:, values > 1.0]
    gradient = directions.T @ total.vector
    projected = directions.T @ total.matrix
    covariance = projected @ directions + projected @ nominal @ (projected @ nominal).T
    return float(chdtrc(len(gradient), gradient @ np.linalg.solve(covariance, gradient)))
