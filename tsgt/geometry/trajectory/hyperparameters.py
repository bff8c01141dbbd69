"""How a robot moves and how noisy its measurements are, found from the measurements themselves. Pure.

The motion prior's parameters and one factor on the instruments' noise are those that make the measurements most probable
when all trajectories are allowed for (maximum evidence, type-II maximum likelihood), so nobody has to guess them. The
gradient is exact for the linearised problem: that of the complete-data likelihood, in expectation over the trajectory
(Fisher's identity), from the marginal covariances that the solution has anyway.
docs/explanation/continuous-trajectory.md has the formulas.

How lively a robot must be taken to be, whatever its measurements show of it. Pure.

Driving is not Gaussian: straight for minutes, then a bend. A motion prior that was tuned to the straights calls the bend
impossible. While all prisms are seen the measurements overrule it; while one is hidden they do not.
docs/explanation/continuous-trajectory.md has what follows from that, and what was measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize

from tsgt.errors import GeometryError
from tsgt.geometry.trajectory.gauss_newton import knot_times, log_evidence, solve
from tsgt.geometry.trajectory.initialisation import initial_guess
from tsgt.geometry.trajectory.motion_prior import (
    axis_correlation_times_s,
    axis_sigmas,
    prior_from_axes,
    process_information,
    transition,
)
from tsgt.geometry.trajectory.states import linearise_process
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.geometry.trajectory.states import States

WINDOW_S = 40.0
WINDOWS = 4
"""A long recording is judged by so many stretches of it, evenly spread."""

MIN_MEASUREMENTS = 30
"""Fewer in a stretch tell nothing of how a robot moves."""

_ROWS = np.array([0, 0, 1, 3, 3, 4])
"""Which parameter is the sigma of each axis: x and y of a ground robot are alike, and so are roll and pitch."""

_TIMES = (2, 5)
_SCALE = 6
_LEAST = np.log([3e-3, 3e-3, 0.03, 3e-3, 3e-3, 0.03, 0.5])
_MOST = np.log([30.0, 30.0, 10.0, 30.0, 30.0, 10.0, 20.0])
_TOLERANCE = 1e-5
_MOST_STEPS = 40
_STEP = 1e-3


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """Parameters that explain the measurements best.

    Attributes
    ----------
    prior
        How the robot moves.
    noise_scale
        The measurements scatter by so many times the stated noise of their instruments.
    log_evidence
        Natural logarithm of the measurements' density, up to a constant.
    """

    prior: MotionPrior
    noise_scale: float
    log_evidence: float


class _Stretch:
    """One stretch of measurements, and the best explained trajectory so far, where the next search begins."""

    def __init__(self, observations: Observations) -> None:
        self.observations = observations
        self.knots: States = initial_guess(observations, knot_times(observations.time_s))
        self.log_evidence = -np.inf

    def found(self, knots: States, log_evidence: float) -> None:
        """Take note of a trajectory."""
        if log_evidence > self.log_evidence:
            self.knots, self.log_evidence = knots, log_evidence


def tune(
    observations: Observations,
    *,
    start: MotionPrior | None = None,
    noise_scale: float | None = None,
    fixed: bool = False,
    on_progress: Callable[[int], None] | None = None,
) -> Hyperparameters:
    """Find the parameters.

    Parameters
    ----------
    observations
        In the order of time, with the stated noise.
    start
        Where to begin; the result depends on it very little.
    noise_scale
        Kept at this; found as well when not given.
    fixed
        The prior stays as it is; only the noise is found.
    on_progress
        Called with the number of evaluations so far.

    Raises
    ------
    GeometryError
        No stretch has enough measurements of three prisms.
    """
    at = log_parameters(
        MotionPrior() if start is None else start, 1.0 if noise_scale is None else noise_scale
    )
    least, most = np.minimum(_LEAST, at), np.maximum(_MOST, at)
    if noise_scale is not None:
        least[_SCALE] = most[_SCALE] = at[_SCALE]
    if fixed:
        least[:_SCALE] = most[:_SCALE] = at[:_SCALE]
    return maximise_evidence(observations, at, least, most, on_progress=on_progress)


def maximise_evidence(
    observations: Observations,
    start: FloatArray,
    least: FloatArray,
    most: FloatArray,
    *,
    on_progress: Callable[[int], None] | None = None,
) -> Hyperparameters:
    """Find the parameters within limits.

    Parameters
    ----------
    observations, on_progress
        As for :func:`tune`.
    start, least, most
        Where to begin and what to keep to, (7,) each, as :func:`log_parameters` gives them.

    Raises
    ------
    GeometryError
        No stretch has enough measurements of three prisms.
    """
    stretches = _stretches(observations)
    evaluations = 0
    # In units in which the first step of the search is of the size of one: a factor of e in some parameter.
    share = 1.0 / sum(len(stretch.observations) for stretch in stretches)

    def negative(parameters: FloatArray) -> tuple[float, FloatArray]:
        nonlocal evaluations
        evaluations += 1
        if on_progress is not None:
            on_progress(evaluations)
        parts = [_evidence(stretch, parameters) for stretch in stretches]
        return -share * sum(value for value, _ in parts), -share * np.sum([part for _, part in parts], axis=0)

    found = minimize(
        negative,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(least, most, strict=True)),
        options={"maxiter": _MOST_STEPS, "ftol": _TOLERANCE},
    )
    prior, scale = _meaning(found.x)
    return Hyperparameters(prior, scale, -float(found.fun) / share)


def scale_noise(observations: Observations, scale: float) -> Observations:
    """Return measurements whose noise is so many times the stated one."""
    return replace(observations, sigmas_m=observations.sigmas_m * scale)


def _stretches(observations: Observations) -> list[_Stretch]:
    time_s = observations.time_s
    span_s = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    count = 1 if span_s <= WINDOW_S * WINDOWS else WINDOWS
    length_s = span_s if count == 1 else WINDOW_S
    # Long recordings often begin and end with people around a robot that stands still.
    starts = time_s[0] + (np.arange(count) + 0.5) / count * span_s - length_s / 2 if len(time_s) else ()
    found = []
    for start_s in starts:
        rows = (time_s >= start_s - 1e-9) & (time_s <= start_s + length_s + 1e-9)
        if np.count_nonzero(rows) >= MIN_MEASUREMENTS:
            try:
                found.append(_Stretch(observations.select(rows)))
            except GeometryError:
                continue
    if not found:
        raise GeometryError(
            f"too few measurements to tell how the robot moves: no {length_s:.0f} s of them have "
            f"{MIN_MEASUREMENTS}, of at least 3 prisms"
        )
    return found


def log_parameters(prior: MotionPrior, scale: float) -> FloatArray:
    """Parameters as they are searched for: acceleration sigmas x and z, its time, the same of the rotation, noise's scale."""
    sigmas = axis_sigmas(prior)
    x, _, z, roll, _, yaw = sigmas
    return np.log(
        [x, z, prior.acceleration_correlation_time_s, roll, yaw, prior.angular_acceleration_correlation_time_s, scale]
    )


def _meaning(parameters: FloatArray) -> tuple[MotionPrior, float]:
    values = np.exp(parameters)
    return prior_from_axes(list(values[_ROWS]), list(values[list(_TIMES)])), float(values[_SCALE])


def _evidence(stretch: _Stretch, parameters: FloatArray) -> tuple[float, FloatArray]:
    """Log evidence of one stretch and its gradient by the parameters."""
    prior, scale = _meaning(parameters)
    observations = scale_noise(stretch.observations, scale)
    solution = solve(observations, stretch.knots, prior, reject_outliers=False)
    value = log_evidence(solution, observations, prior)
    stretch.found(solution.knots, value)
    covariance, cross_covariance = solution.factor.marginals()
    gradient = np.zeros(len(parameters))
    gradient[_SCALE] = _by_scale(solution, observations, covariance)
    steps = _expected_steps(solution, covariance, cross_covariance)
    sigmas, dt_s = axis_sigmas(prior), np.diff(solution.knots.time_s)
    energies = _energy(steps, solution.steps.phi, solution.steps.information)
    for axis, row in enumerate(_ROWS):
        gradient[row] += float(energies[:, axis].sum()) - 3.0 * len(energies)
    for axes, row, time in zip(
        (slice(0, 3), slice(3, 6)), _TIMES, np.exp(parameters[list(_TIMES)]), strict=True
    ):
        some = steps[0][:, axes], steps[1][:, axes], steps[2][:, axes]
        up, down = (
            _expected_log_density(some, dt_s, time * np.exp(sign * _STEP), sigmas[axes]) for sign in (1, -1)
        )
        gradient[row] = (up - down) / (2 * _STEP)
    # The first knot's accelerations, too, are of that size.
    first = np.concatenate([solution.knots.acceleration[0], solution.knots.angular_acceleration[0]])
    expected = (first**2 + np.diag(covariance[0])[12:]) / sigmas**2 - 1.0
    np.add.at(gradient, _ROWS, expected)
    return value, gradient


def _by_scale(solution: Solution, observations: Observations, covariance: FloatArray) -> float:
    """Differentiate by the logarithm of the noise's scale: expected squared distances less how many there are."""
    linearised = solution.linearised
    information = np.linalg.inv(linearised.covariance(observations))
    by_state = linearised.jacobian
    spread_m2 = by_state @ covariance[solution.at] @ np.swapaxes(by_state, 1, 2)
    expected = solution.squared_distances + np.einsum("mij,mji->m", information, spread_m2)
    # What an uncertain time adds does not grow with the instrument's noise.
    share = np.einsum("mii,mi->m", information, observations.sigmas_m**2) / 3.0
    return float((share * (solution.weights * expected - 3.0)).sum())


_Moments = tuple["FloatArray", "FloatArray", "FloatArray"]


def _expected_steps(solution: Solution, covariance: FloatArray, cross_covariance: FloatArray) -> _Moments:
    """Second moments of what each step connects, by axis, (K - 1, 6, 3, 3): later with later, with earlier, earlier with it."""
    between = linearise_process(solution.knots, solution.steps)
    count = len(cross_covariance)
    earlier, later = between.earlier, between.later
    moments = later[..., :, None] * later[..., None, :]
    crossed = later[..., :, None] * earlier[..., None, :]
    before = earlier[..., :, None] * earlier[..., None, :]
    # A step is later - Phi earlier; place and turn count from the earlier knot's.
    by_earlier, by_later = np.zeros((2, count, 9, 9)), np.zeros((2, count, 9, 9))
    by_earlier[0, :, range(3), range(3)] = -1.0
    by_earlier[1, :, :3, :6] = between.turn_by_earlier
    by_later[:, :, range(9), range(9)] = 1.0
    by_later[1, :, :3, :6] = between.turn_by_later
    for kind, axes in ((0, slice(0, 3)), (1, slice(3, 6))):
        first, last, shared = (
            matrix.reshape(count, 3, 2, 3, 3, 2, 3)[:, :, kind, :, :, kind].reshape(count, 9, 9)
            for matrix in (covariance[:-1], covariance[1:], cross_covariance)
        )
        with_earlier = by_earlier[kind] @ first + by_later[kind] @ np.swapaxes(shared, 1, 2)
        with_later = by_earlier[kind] @ shared + by_later[kind] @ last
        own = with_earlier @ np.swapaxes(by_earlier[kind], 1, 2) + with_later @ np.swapaxes(
            by_later[kind], 1, 2
        )
        moments[:, axes] += _by_axis(own)
        crossed[:, axes] += _by_axis(with_earlier)
        before[:, axes] += _by_axis(first)
    crossed[..., :, 0] = 0.0
    before[..., :, 0] = before[..., 0, :] = 0.0
    return moments, crossed, before


def _by_axis(matrix: FloatArray) -> FloatArray:
    """(N, 3, 3, 3) what belongs to one axis of (N, 9, 9)."""
    by_axis: FloatArray = np.einsum("niaja->naij", matrix.reshape(-1, 3, 3, 3, 3))
    return by_axis


def _energy(steps: _Moments, phi: FloatArray, information: FloatArray) -> FloatArray:
    """(K - 1, A) expected squared length of the steps, whose transition and information are (K - 1, A or 1, 3, 3)."""
    moments, crossed, before = steps
    mixed = phi @ np.swapaxes(crossed, -1, -2)
    left = moments - mixed - np.swapaxes(mixed, -1, -2) + phi @ before @ np.swapaxes(phi, -1, -2)
    energy: FloatArray = (information * left).sum(axis=(2, 3))
    return energy


def _expected_log_density(steps: _Moments, dt_s: FloatArray, time_s: float, sigmas: FloatArray) -> float:
    """Give the expected log density of all steps of some axes, as far as it depends on their correlation time."""
    phi, information = transition(dt_s, time_s), process_information(dt_s, time_s)
    energies = _energy(steps, phi[:, None], information[:, None]) / sigmas**2
    _, logdet = np.linalg.slogdet(information)
    return -0.5 * float(energies.sum()) + 0.5 * len(sigmas) * float(logdet.sum())


NOISE_FLOOR_SHARE = 1.0 / 3.0
"""No axis of a tuned prior is calmer than this share of the configured one's."""

OUTAGE_S = 2.0
"""A prism that was not measured for longer is hidden."""

_LEAST_PRISMS = 3

_PACE_RADPS = 1.0
"""To speed up and to brake, or to turn there and back, takes about six seconds."""


def with_noise_floor(prior: MotionPrior, other: MotionPrior, share: float = 1.0) -> MotionPrior:
    """Make a prior livelier where it is calmer than another.

    What a robot may do unseen is the power of its acceleration at the pace of manoeuvres, ``sigma^2 time / (1 + (pace
    time)^2)``: a sigma counts for little where an acceleration lasts too short, or too long, for one. Correlation times stay.

    Parameters
    ----------
    prior, other
        Both are compared axis by axis.
    share
        The least is the sigma that, with the correlation time of ``prior``, has the power of this share of ``other``'s.
    """
    times_s = axis_correlation_times_s(prior)
    least = share * axis_sigmas(other) * np.sqrt(_power(axis_correlation_times_s(other)) / _power(times_s))
    return prior_from_axes(np.maximum(axis_sigmas(prior), least), times_s[[0, 3]])


def _power(time_s: FloatArray) -> FloatArray:
    """Power of an acceleration with a sigma of 1 at the pace of manoeuvres, up to a factor."""
    return time_s / (1.0 + (_PACE_RADPS * time_s) ** 2)


def partially_occluded(time_s: FloatArray, prism: NDArray[np.intp], at_s: FloatArray) -> NDArray[np.bool_]:
    """Tell when fewer than three prisms were seen.

    Parameters
    ----------
    time_s, prism
        (M,) when which prism was measured, in the order of time.
    at_s
        (N,) instants that are asked for.

    Returns
    -------
    NDArray[np.bool_]
        (N,) at most two prisms have measurements no more than :data:`OUTAGE_S` apart before and after it.
    """
    seen = np.zeros(len(at_s), np.intp)
    for each in np.unique(prism):
        own_s = np.concatenate([[-np.inf], time_s[prism == each], [np.inf]])
        after = np.searchsorted(own_s, at_s)
        seen += own_s[after] - own_s[after - 1] <= OUTAGE_S
    return seen < _LEAST_PRISMS
