"""Stations' frames, relative latencies and prism positions from the motion of a robot that they all track. Pure.

A wrong frame or a late time stamp bends the rigid robot as it drives. The same factors that give the trajectory
(:mod:`tsgt.geometry.trajectory.gauss_newton`) therefore tell how to change what is common to all measurements. Per step the trajectory is
solved with the set-up held; then all of it is eliminated from the normal equations of both (Schur complement through its
banded factor), which leaves a small system for the set-up alone, whose inverse is its covariance with an unknown trajectory
allowed for. docs/how-to/calibrate-from-motion.md says what the result is good for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.calibration.motion_parameters import Setup, SetupParameters, SetupPrior, deformation_modes
from tsgt.geometry.calibration.timestamp_drift import Part, allowed_for, likely_wander_s
from tsgt.geometry.rigid import rotate
from tsgt.geometry.trajectory import (
    MIN_KNOT_SPACING_S,
    STATE_DIM,
    initial_guess,
    knot_times,
    scale_noise,
    solve,
    tune,
)
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations, Solution, States

SEGMENT_S = 40.0
"""A recording is taken as trajectories of this length: memory stays bounded, and pieces that contradict each other show.
Their ends tell a little less."""

MAX_GAP_S = 5.0
"""Where all stations are silent for longer, a piece ends: nothing of a robot's motion lasts that long, and a trajectory that
nothing holds may not be found at all."""

MIN_MEASUREMENTS = 30
"""A piece with fewer is left out."""

MAX_ITERATIONS = 30
STEP_TOLERANCE = 1e-3
"""Squared length of a step in sigmas of the set-up: shorter ones end the search."""

COARSE_NOISE_SCALES = (20.0, 4.0)
"""Noise is taken to be so many times larger at first, so that a wrong set-up does not make everything an outlier."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionCalibration:
    """A set-up found from motion.

    Attributes
    ----------
    was
        The set-up that was given.
    setup
        The set-up.
    unknowns
        What was looked for, about the set-up that it began with: with levelled stations that which was given without tilts.
    covariance
        (G, G) of the unknowns in their order, given all measurements and what was known beforehand, times the square of
        ``birge_ratio``.
    disagreement
        1, or how many times more than noise and wandering time stamps explain the pieces of the recording contradict each
        other: a tripod that sinks.
    wander_s
        One sigma of how much later or earlier than its latency each station's stamps are from one piece of the recording
        to the next; it is in the covariance.
    prior
        How the robot moves.
    noise_scale
        The measurements scatter by so many times the stated noise.
    measurements, outliers
        How many were used, and how many of these lie further out than noise explains.
    """

    initial: Setup
    setup: Setup
    unknowns: SetupParameters
    covariance: FloatArray
    birge_ratio: float
    wander_s: float
    prior: MotionPrior
    noise_scale: float
    measurements: int
    outliers: int

    def corrections(self) -> tuple[FloatArray, FloatArray]:
        """How far each station's frame has moved, (S, 3) at the pivot in m, and turned, (S, 3) in rad."""
        return self.setup.corrections(self.initial, self.unknowns.pivot)

    def prism_sigmas_m(self) -> FloatArray:
        """(P, 3) one sigma of each prism against the others, 0 where they are held."""
        places = self.unknowns.prisms
        if not len(places):
            return np.zeros_like(self.setup.layout)
        by_unknown = deformation_modes(self.setup.layout)
        covariance = by_unknown @ self.covariance[np.ix_(places, places)] @ by_unknown.T
        return np.sqrt(np.diag(covariance)).reshape(-1, 3)


class _System(NamedTuple):
    """Normal equations of the set-up, trajectories eliminated, at some set-up."""

    information: FloatArray
    gradient: FloatArray
    cost: float
    measurements: int
    outliers: int
    parts: list[Part]


@dataclass(slots=True)
class _Piece:
    """One stretch of measurements, and where its trajectory was last."""

    observations: Observations
    knots: States | None = None
    latencies_s: FloatArray | float = 0.0


def calibrate_motion(
    observations: Observations,
    known: SetupPrior,
    *,
    start: Setup | None = None,
    prior: MotionPrior | None = None,
    noise_scale: float | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> MotionCalibration:
    """Find a set-up from motion.

    Parameters
    ----------
    observations
        Polar measurements with the set-up in force, in the order of time, with the stated noise.
    known
        What to find, and what is known of it beforehand.
    start
        The set-up to begin with, about which ``known`` holds; that of the observations when not given.
    prior, noise_scale
        How the robot moves and how noisy its measurements are; tuned from the measurements when not given.
    on_progress
        Called with a few words now and then.

    Raises
    ------
    GeometryError
        Nothing to find, or the measurements do not determine a trajectory.
    """
    initial = setup = Setup.of(observations) if start is None else start
    unknowns = SetupParameters.of(setup.applied(observations), setup, known)
    if known.levelled and known.translation_sigma_m > 0:
        setup = setup.levelled(unknowns.pivot, unknowns.stations)
        unknowns = replace(unknowns, reference=setup)
    tell = on_progress or (lambda _: None)
    coarse = MotionPrior() if prior is None else prior
    for scale in COARSE_NOISE_SCALES:
        tell(f"coarse, noise times {scale:g}")
        setup, _ = _search(_pieces(scale_noise(observations, scale)), unknowns, setup, coarse)
    if prior is None:
        tell("how the robot moves")
        tuned = tune(setup.applied(observations), noise_scale=noise_scale)
        prior, noise_scale = tuned.prior, tuned.noise_scale
    noise_scale = 1.0 if noise_scale is None else noise_scale
    tell("fine")
    pieces = _pieces(scale_noise(observations, noise_scale))
    setup, system = _search(pieces, unknowns, setup, prior)
    beforehand = _known(unknowns, unknowns.local_coordinates(setup))
    wander_s = likely_wander_s(system.parts, beforehand, unknowns.latencies)
    if wander_s > 0:
        tell(f"time stamps that wander by {1e3 * wander_s:.1f} ms")
        setup, system = _search(pieces, unknowns, setup, prior, wander_s=wander_s)
    birge_ratio = _disagreement(system.parts, unknowns)
    covariance = np.asarray(np.linalg.inv(system.information), np.float64)
    return MotionCalibration(
        initial,
        setup,
        unknowns,
        covariance * birge_ratio**2,
        birge_ratio,
        wander_s,
        prior,
        noise_scale,
        system.measurements,
        system.outliers,
    )


def _disagreement(parts: list[Part], unknowns: SetupParameters) -> float:
    """Ratio of what pieces contradict each other by to what noise explains (R. T. Birge, Physical Review 40, 1932)."""
    count = len(unknowns.sigmas)
    squared, expected = 0.0, -float(count)
    for information, gradient in parts:
        covariance = np.linalg.inv(information + np.diag(unknowns.sigmas**-2.0))
        squared += float(gradient @ covariance @ gradient)
        expected += float(np.trace(information @ covariance))
    # A few left over would tell little.
    return max(1.0, float(np.sqrt(squared / expected))) if expected >= count else 1.0


def _search(
    pieces: list[_Piece],
    unknowns: SetupParameters,
    setup: Setup,
    prior: MotionPrior,
    *,
    wander_s: float = 0.0,
) -> tuple[Setup, _System]:
    """Gauss and Newton's method with Levenberg's damping."""
    system = _assemble(pieces, unknowns, setup, prior, wander_s)
    damping = 0.0
    for _ in range(MAX_ITERATIONS):
        information = system.information + damping * np.diag(np.diag(system.information))
        move = np.asarray(np.linalg.solve(information, -system.gradient), np.float64)
        if float(move @ system.information @ move) < STEP_TOLERANCE:
            break
        following = unknowns.retract(setup, move)
        tried = _assemble(pieces, unknowns, following, prior, wander_s)
        # Which knots there are changes with the latencies, and with it the cost, by next to nothing.
        if tried.cost <= system.cost + 1e-4 * abs(system.cost) + 0.1:
            setup, system = following, tried
            damping = 0.0 if damping < 1e-2 else damping / 10.0
        elif damping > 1e6:
            raise GeometryError("no set-up fits the motion: check which station tracks which prism")
        else:
            damping = max(10.0 * damping, 1e-2)
    return setup, system


def _pieces(observations: Observations) -> list[_Piece]:
    time_s = observations.time_s
    count = max(1, round(float(time_s[-1] - time_s[0]) / SEGMENT_S)) if len(time_s) else 0
    edges = np.linspace(time_s[0], time_s[-1], count + 1)[1:-1] if count else ()
    ends = np.concatenate([np.searchsorted(time_s, edges), np.flatnonzero(np.diff(time_s) > MAX_GAP_S) + 1])
    rows = np.split(np.arange(len(time_s)), np.unique(ends).astype(np.intp))
    found = [_Piece(observations.select(some)) for some in rows if len(some) >= MIN_MEASUREMENTS]
    usable = [piece for piece in found if len(np.unique(piece.observations.prism)) >= 3]
    if not usable:
        raise GeometryError(
            f"too few measurements to calibrate with: no {SEGMENT_S:.0f} s of them have {MIN_MEASUREMENTS}, "
            "of at least 3 prisms"
        )
    return usable


def _known(unknowns: SetupParameters, away: FloatArray) -> Part:
    """Give what is known beforehand of a set-up that is so far away from that."""
    return Part(np.diag(unknowns.sigmas**-2.0), away / unknowns.sigmas**2)


def _assemble(
    pieces: list[_Piece], unknowns: SetupParameters, setup: Setup, prior: MotionPrior, wander_s: float
) -> _System:
    away = unknowns.local_coordinates(setup)
    information, gradient = _known(unknowns, away)
    cost, measurements, outliers = float(away @ gradient), 0, 0
    parts = []
    for piece in pieces:
        observations = setup.applied(piece.observations)
        solution = _solved(piece, observations, setup, prior)
        by_setup = unknowns.jacobian(observations, solution.linearised, setup)
        own, mixed, slope = _normal_equations(observations, solution, by_setup)
        told = own - np.tensordot(mixed, solution.factor.solve(mixed), axes=((0, 1), (0, 1)))
        part = Part(told, slope)
        if wander_s > 0:
            part, gained, _ = allowed_for(part, unknowns.latencies, wander_s)
            cost -= 2.0 * gained
        parts.append(part)
        information += part.information
        gradient += part.gradient
        cost += solution.cost
        measurements += len(observations)
        outliers += int(np.count_nonzero(solution.weights < 1.0))
    return _System(0.5 * (information + information.T), gradient, cost, measurements, outliers, parts)


def _solved(piece: _Piece, observations: Observations, setup: Setup, prior: MotionPrior) -> Solution:
    knots = piece.knots
    # While the times have hardly moved the knots of the last step are near enough, and begin closer to the solution.
    if knots is None or np.abs(setup.latencies_s - piece.latencies_s).max() > MIN_KNOT_SPACING_S / 2:
        knots = initial_guess(observations, knot_times(observations.time_s))
        piece.latencies_s = setup.latencies_s
    solution = solve(observations, knots, prior, reject_outliers=False)
    piece.knots = solution.knots
    return solution


def _normal_equations(
    observations: Observations, solution: Solution, by_setup: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(G, G) of the set-up, (K, 18, G) of states with set-up, (G,) gradient; none eliminated yet."""
    linearised = solution.linearised
    whiten = np.linalg.inv(np.linalg.cholesky(linearised.covariance(observations)))
    whiten *= np.sqrt(solution.weights)[:, None, None]
    residuals = rotate(whiten, linearised.residuals_m)
    by_state, by_setup = whiten @ linearised.jacobian, whiten @ by_setup
    mixed = np.zeros((len(solution.knots), STATE_DIM, by_setup.shape[2]))
    np.add.at(mixed, solution.at, np.swapaxes(by_state, 1, 2) @ by_setup)
    flat = by_setup.reshape(-1, by_setup.shape[2])
    return flat.T @ flat, mixed, flat.T @ residuals.ravel()
