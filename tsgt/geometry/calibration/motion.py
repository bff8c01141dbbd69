"""Calibration of station frames, latencies and prism positions from the motion of a robot that all stations track. Sans-I/O.

A wrong set-up distorts the rigid robot as it moves. Each step solves the trajectory for a fixed set-up, eliminates it from
the joint normal equations (Schur complement through its banded factor) and solves the small remaining system, whose inverse
is the covariance with the trajectory marginalised. See docs/how-to/calibrate-from-motion.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.calibration.motion_parameters import Setup, SetupParameters, SetupPrior, deformation_modes
from tsgt.geometry.calibration.timestamp_drift import SegmentInformation, eliminate_wander, estimate_wander_s
from tsgt.geometry.rigid import rotate
from tsgt.geometry.trajectory import (
    MIN_KNOT_SPACING_S,
    STATE_DIM,
    initial_guess,
    knot_times,
    overall_scale,
    scale_noise,
    solve,
    tune,
)
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations, Solution, States

SEGMENT_S = 40.0  # Length of a trajectory: bounds memory, and shows inconsistent segments
MAX_GAP_S = 5.0  # Of all stations; ends a segment, since a longer gap may prevent convergence
MIN_MEASUREMENTS = 30  # Segments with fewer are skipped
MAX_ITERATIONS = 30
STEP_TOLERANCE = 1e-3  # Squared length of a step, in sigmas of the set-up
COARSE_NOISE_SCALES = (20.0, 4.0)  # First, so that a wrong set-up makes few outliers


@dataclass(frozen=True, slots=True, eq=False)
class MotionCalibration:
    """A set-up found from motion."""

    initial: Setup  # as given
    setup: Setup
    # Parameters about the initial set-up, without its tilts if stations are levelled
    parameters: SetupParameters
    covariance: FloatArray  # (G, G) of the parameters, scaled by ``birge_ratio`` squared
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
        rows = self.parameters.prisms
        if not len(rows):
            return np.zeros_like(self.setup.layout)
        modes = deformation_modes(self.setup.layout)
        covariance = modes @ self.covariance[np.ix_(rows, rows)] @ modes.T
        return np.sqrt(np.diag(covariance)).reshape(-1, 3)


class _NormalEquations(NamedTuple):
    """Normal equations of the set-up, trajectories eliminated."""

    information: FloatArray
    gradient: FloatArray
    cost: float
    measurements: int
    outliers: int
    segment_information: list[SegmentInformation]


@dataclass(slots=True)
class _Segment:
    """One segment of measurements and its last trajectory."""

    observations: Observations
    knots: States | None = None
    latencies_s: FloatArray | float = 0.0


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
    parameters = SetupParameters.of(setup.applied(observations), setup, prior_sigmas)
    if prior_sigmas.levelled and prior_sigmas.translation_sigma_m > 0:
        setup = setup.levelled(parameters.pivot, parameters.stations)
        parameters = replace(parameters, reference=setup)
    report = on_progress or (lambda _: None)
    coarse = MotionPrior() if prior is None else prior
    for scale in COARSE_NOISE_SCALES:
        report(f"coarse, noise times {scale:g}")
        setup, _ = _search(_segments(scale_noise(observations, scale)), parameters, setup, coarse)
    if prior is None:
        report("motion prior")
        tuned = tune(setup.applied(observations), noise_scale=noise_scale)
        prior, noise_scale = tuned.prior, tuned.noise_scales
    scales = np.ones((len(observations.frames), 3)) * (1.0 if noise_scale is None else noise_scale)
    report("fine")
    segments = _segments(scale_noise(observations, scales))
    setup, system = _search(segments, parameters, setup, prior)
    prior_information = _prior_information(parameters, parameters.local_coordinates(setup))
    wander_s = estimate_wander_s(system.segment_information, prior_information, parameters.latencies)
    if wander_s > 0:
        report(f"timestamp drift {1e3 * wander_s:.1f} ms")
        setup, system = _search(segments, parameters, setup, prior, wander_s=wander_s)
    birge_ratio = _birge_ratio(system.segment_information, parameters)
    covariance = np.asarray(np.linalg.inv(system.information), np.float64)
    return MotionCalibration(
        initial,
        setup,
        parameters,
        covariance * birge_ratio**2,
        birge_ratio,
        wander_s,
        prior,
        scales,
        overall_scale(observations, scales),
        system.measurements,
        system.outliers,
    )


def _birge_ratio(segments: list[SegmentInformation], parameters: SetupParameters) -> float:
    """Birge ratio of the segments: their disagreement over what noise explains (R. T. Birge, Physical Review 40, 1932)."""
    count = len(parameters.sigmas)
    squared, expected = 0.0, -float(count)
    for information, gradient in segments:
        covariance = np.linalg.inv(information + np.diag(parameters.sigmas**-2.0))
        squared += float(gradient @ covariance @ gradient)
        expected += float(np.trace(information @ covariance))
    # Only with enough degrees of freedom.
    return max(1.0, float(np.sqrt(squared / expected))) if expected >= count else 1.0


def _search(
    segments: list[_Segment],
    parameters: SetupParameters,
    setup: Setup,
    prior: MotionPrior,
    *,
    wander_s: float = 0.0,
) -> tuple[Setup, _NormalEquations]:
    """Levenberg-Marquardt on the set-up."""
    system = _assemble(segments, parameters, setup, prior, wander_s)
    damping = 0.0
    for _ in range(MAX_ITERATIONS):
        information = system.information + damping * np.diag(np.diag(system.information))
        step = np.asarray(np.linalg.solve(information, -system.gradient), np.float64)
        if float(step @ system.information @ step) < STEP_TOLERANCE:
            break
        candidate_setup = parameters.retract(setup, step)
        candidate = _assemble(segments, parameters, candidate_setup, prior, wander_s)
        # The knots depend on the latencies, so that the cost may rise slightly.
        if candidate.cost <= system.cost + 1e-4 * abs(system.cost) + 0.1:
            setup, system = candidate_setup, candidate
            damping = 0.0 if damping < 1e-2 else damping / 10.0
        elif damping > 1e6:
            raise GeometryError("no set-up fits the motion: check which station tracks which prism")
        else:
            damping = max(10.0 * damping, 1e-2)
    return setup, system


def _segments(observations: Observations) -> list[_Segment]:
    time_s = observations.time_s
    count = max(1, round(float(time_s[-1] - time_s[0]) / SEGMENT_S)) if len(time_s) else 0
    edges = np.linspace(time_s[0], time_s[-1], count + 1)[1:-1] if count else ()
    boundaries = np.concatenate(
        [np.searchsorted(time_s, edges), np.flatnonzero(np.diff(time_s) > MAX_GAP_S) + 1]
    )
    rows = np.split(np.arange(len(time_s)), np.unique(boundaries).astype(np.intp))
    candidates = [_Segment(observations.select(some)) for some in rows if len(some) >= MIN_MEASUREMENTS]
    usable = [segment for segment in candidates if len(np.unique(segment.observations.prism)) >= 3]
    if not usable:
        raise GeometryError(
            f"too few measurements to calibrate with: no {SEGMENT_S:.0f} s of them have {MIN_MEASUREMENTS}, "
            "of at least 3 prisms"
        )
    return usable


def _prior_information(parameters: SetupParameters, deviation: FloatArray) -> SegmentInformation:
    """Prior information on the parameters, at a set-up that differs from the prior's mean by ``deviation``, (G,)."""
    return SegmentInformation(np.diag(parameters.sigmas**-2.0), deviation / parameters.sigmas**2)


def _assemble(
    segments: list[_Segment], parameters: SetupParameters, setup: Setup, prior: MotionPrior, wander_s: float
) -> _NormalEquations:
    deviation = parameters.local_coordinates(setup)
    information, gradient = _prior_information(parameters, deviation)
    cost, measurements, outliers = float(deviation @ gradient), 0, 0
    eliminated = []
    for segment in segments:
        observations = setup.applied(segment.observations)
        solution = _solve_trajectory(segment, observations, setup, prior)
        by_setup = parameters.jacobian(observations, solution.linearised, setup)
        setup_information, cross, setup_gradient = _normal_equations(observations, solution, by_setup)
        schur = setup_information - np.tensordot(cross, solution.factor.solve(cross), axes=((0, 1), (0, 1)))
        part = SegmentInformation(schur, setup_gradient)
        if wander_s > 0:
            part, cost_reduction, _ = eliminate_wander(part, parameters.latencies, wander_s)
            cost -= 2.0 * cost_reduction
        eliminated.append(part)
        information += part.information
        gradient += part.gradient
        cost += solution.cost
        measurements += len(observations)
        outliers += int(np.count_nonzero(solution.weights < 1.0))
    return _NormalEquations(
        0.5 * (information + information.T), gradient, cost, measurements, outliers, eliminated
    )


def _solve_trajectory(
    segment: _Segment, observations: Observations, setup: Setup, prior: MotionPrior
) -> Solution:
    knots = segment.knots
    # While the times hardly change, the last knots are close enough and a better initial guess.
    if knots is None or np.abs(setup.latencies_s - segment.latencies_s).max() > MIN_KNOT_SPACING_S / 2:
        knots = initial_guess(observations, knot_times(observations.time_s))
        segment.latencies_s = setup.latencies_s
    solution = solve(observations, knots, prior, reject_outliers=False)
    segment.knots = solution.knots
    return solution


def _normal_equations(
    observations: Observations, solution: Solution, by_setup: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(G, G) of the set-up, (K, 18, G) of states and set-up, (G,) gradient of the set-up; nothing eliminated."""
    linearised = solution.linearised
    whitening = np.linalg.inv(np.linalg.cholesky(linearised.covariance(observations)))
    whitening *= np.sqrt(solution.weights)[:, None, None]
    residuals = rotate(whitening, linearised.residuals_m)
    by_state, by_setup = whitening @ linearised.jacobian, whitening @ by_setup
    cross = np.zeros((len(solution.knots), STATE_DIM, by_setup.shape[2]))
    np.add.at(cross, solution.knot_index, np.swapaxes(by_state, 1, 2) @ by_setup)
    flat = by_setup.reshape(-1, by_setup.shape[2])
    return flat.T @ flat, cross, flat.T @ residuals.ravel()
