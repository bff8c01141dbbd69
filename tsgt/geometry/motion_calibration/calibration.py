"""Calibration of station frames, latencies and prism positions from the motion of a robot that all stations track. Sans-I/O.

Each step solves the joint normal equations of the set-up, trajectories eliminated, whose inverse is the covariance with the
trajectory marginalised. See docs/how-to/calibrate-from-motion.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.batch import overall_scale, scale_noise, tune
from tsgt.geometry.motion_calibration.joint_system import (
    JointSystem,
    Segment,
    linearise_jointly,
    split_segments,
)
from tsgt.geometry.motion_calibration.setup_parameters import Setup, SetupParameters
from tsgt.geometry.motion_calibration.timestamp_drift import birge_ratio, eliminate_wander, estimate_wander_s
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.motion_calibration.setup_prior import SetupPrior
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations

MAX_ITERATIONS = 30
STEP_TOLERANCE = 1e-3  # Squared length of a step, in sigmas of the set-up
COARSE_NOISE_SCALES = (20.0, 4.0)  # First, so that a wrong set-up makes few outliers

TRUNCATION_SIGMA_S = 1e-3 / np.sqrt(12)
"""Of an instrument's times, which are whole milliseconds: each drive truncates another part of one, the same throughout."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionCalibration:
    """A set-up found from motion."""

    initial: Setup  # as given
    setup: Setup
    # About the initial set-up, without its tilts if stations are levelled
    parameters: SetupParameters
    covariance: FloatArray  # (G, G) of the parameters, scaled by ``birge_ratio`` squared; zero for what is fixed  # That of the latencies contains the truncation of times
    prior_sigmas: FloatArray  # (G,) of the prior, 0 for what is fixed
    # How much more the segments of the recording disagree than noise and timestamp drift explain, at least 1: a
    # sinking tripod
    birge_ratio: float
    wander_s: float  # One sigma of each station's latency from segment to segment; included in the covariance
    prior: MotionPrior
    noise_scales: FloatArray  # (S, 3) factors on the stated noise by station and component
    noise_scale: float  # Their root mean square over all measurements and components
    measurements: int
    outliers: int

    def corrections(self) -> tuple[FloatArray, FloatArray]:
        """Corrections of each station's frame: (S, 3) translation at the pivot in m and (S, 3) rotation in rad."""
        return self.setup.corrections(self.initial, self.parameters.pivot)

    def prism_sigmas_m(self) -> FloatArray:
        """(P, 3) one sigma of each prism relative to the others, 0 where they are fixed."""
        variances_m2 = np.diag(self.covariance)[self.parameters.prisms]
        return np.sqrt(np.maximum(variances_m2, 0.0))


class _NormalEquations(NamedTuple):
    """Normal equations of the set-up, trajectories eliminated, in the coordinates of the prior's factor."""

    information: FloatArray  # (r, r)
    gradient: FloatArray  # (r,)
    cost: float
    system: JointSystem


def calibrate_motion(
    observations: Observations,
    prior_sigmas: SetupPrior,
    *,
    start: Setup | None = None,
    prior: MotionPrior | None = None,
    noise_scale: FloatArray | float | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> MotionCalibration:
    """Find a set-up from motion.

    Raises GeometryError: nothing to estimate, or the measurements do not determine a trajectory.

    Parameters
    ----------
    observations : Polar measurements in the order of time, with the current set-up and the stated noise.
    prior_sigmas : What to estimate, and its prior.
    start : Initial set-up, about which the prior holds; that of the observations when not given.
    prior, noise_scale : Tuned on the measurements when not given.
    on_progress : Called with the name of each stage.
    """
    initial = setup = Setup.of(observations) if start is None else start
    parameters = SetupParameters.of_observations(setup.applied(observations), setup)
    factor = prior_sigmas.factor(parameters)
    if prior_sigmas.levelled and prior_sigmas.translation_sigma_m > 0:
        setup = setup.levelled(parameters.pivot, parameters.stations)
        parameters = replace(parameters, reference=setup)
    report = on_progress or (lambda _: None)
    coarse = MotionPrior() if prior is None else prior
    for scale in COARSE_NOISE_SCALES:
        report(f"coarse, noise times {scale:g}")
        segments = split_segments(scale_noise(observations, scale))
        setup, _ = _search(segments, parameters, factor, setup, coarse)
    if prior is None:
        report("motion prior")
        tuned = tune(setup.applied(observations), noise_scale=noise_scale)
        prior, noise_scale = tuned.prior, tuned.noise_scales
    scales = np.ones((len(observations.frames), 3)) * (1.0 if noise_scale is None else noise_scale)
    report("fine")
    segments = split_segments(scale_noise(observations, scales))
    setup, found = _search(segments, parameters, factor, setup, prior)
    deviation = np.linalg.pinv(factor) @ parameters.local_coordinates(setup)
    wander_s = estimate_wander_s(found.system.segments, factor, deviation, parameters.latencies)
    if wander_s > 0:
        report(f"timestamp drift {1e3 * wander_s:.1f} ms")
        setup, found = _search(segments, parameters, factor, setup, prior, wander_s=wander_s)
    ratio = birge_ratio(found.system.segments, factor)
    covariance = factor @ np.linalg.inv(found.information) @ factor.T
    covariance = 0.5 * (covariance + covariance.T) * ratio**2
    deviations = np.sqrt((factor**2).sum(axis=1))
    estimated = parameters.latencies[deviations[parameters.latencies] > 0]
    # Relative to station 1, whose own truncation shifts all others alike.
    covariance[np.ix_(estimated, estimated)] += TRUNCATION_SIGMA_S**2 * (np.eye(len(estimated)) + 1.0)
    return MotionCalibration(
        initial,
        setup,
        parameters,
        covariance,
        deviations,
        ratio,
        wander_s,
        prior,
        scales,
        overall_scale(observations, scales),
        found.system.measurements,
        found.system.outliers,
    )


def _search(
    segments: list[Segment],
    parameters: SetupParameters,
    factor: FloatArray,
    setup: Setup,
    prior: MotionPrior,
    *,
    wander_s: float = 0.0,
) -> tuple[Setup, _NormalEquations]:
    """Levenberg-Marquardt on the set-up."""
    system = _assemble(segments, parameters, factor, setup, prior, wander_s)
    damping = 0.0
    for _ in range(MAX_ITERATIONS):
        information = system.information + damping * np.diag(np.diag(system.information))
        step = np.asarray(np.linalg.solve(information, -system.gradient), np.float64)
        if float(step @ system.information @ step) < STEP_TOLERANCE:
            break
        candidate_setup = parameters.retract(setup, factor @ step)
        candidate = _assemble(segments, parameters, factor, candidate_setup, prior, wander_s)
        # The knots depend on the latencies, so that the cost may rise slightly.
        if candidate.cost <= system.cost + 1e-4 * abs(system.cost) + 0.1:
            setup, system = candidate_setup, candidate
            damping = 0.0 if damping < 1e-2 else damping / 10.0
        elif damping > 1e6:
            raise GeometryError("no set-up fits the motion: check which station tracks which prism")
        else:
            damping = max(10.0 * damping, 1e-2)
    return setup, system


def _assemble(
    segments: list[Segment],
    parameters: SetupParameters,
    factor: FloatArray,
    setup: Setup,
    prior: MotionPrior,
    wander_s: float,
) -> _NormalEquations:
    deviation = np.linalg.pinv(factor) @ parameters.local_coordinates(setup)
    system = linearise_jointly(segments, parameters, setup, prior)
    cost = system.cost + float(deviation @ deviation)
    if wander_s > 0:
        eliminated = [eliminate_wander(each, parameters.latencies, wander_s) for each in system.segments]
        cost -= 2.0 * sum(each.cost_reduction for each in eliminated)
        system = system._replace(segments=[each.segment for each in eliminated])
    information = np.eye(factor.shape[1]) + factor.T @ system.information() @ factor
    return _NormalEquations(information, deviation + factor.T @ system.gradient(), cost, system)
