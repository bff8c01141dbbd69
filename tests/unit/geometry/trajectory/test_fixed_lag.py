"""Fixed-lag smoother: constant cost per measurement, results close to those of the batch solution."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.drives.prior_motion import draw_motions, measure, rows_at, sorted_by_time

from tsgt.geometry.trajectory import (
    FixedLagSmoother,
    Observations,
    Trajectory,
    fixed_lag,
    initial_guess,
    knot_times,
    solve,
)
from tsgt.geometry.trajectory.fixed_lag import BRIEF_ITERATIONS, MAX_FAILED_SEARCHES, RETRY_S
from tsgt.geometry.trajectory.innovation_monitor import AMBIGUITY_MARGIN_S
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution

PRIOR = MotionPrior()
LAG_S = 3.0


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Twelve seconds of a robot that moves as the prior says."""
    return drawn(1)


def drawn(seed: int, until_s: float = 12.0) -> Observations:
    """Measurements of a motion drawn from the prior, in the order of time."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=until_s, seed=seed)
    return sorted_by_time(measure(motion, until_s=until_s, seed=seed))


def batch(observations: Observations) -> Trajectory:
    """Trajectory of all measurements in one solution."""
    found = solve(observations, initial_guess(observations, knot_times(observations.time_s)), PRIOR)
    return Trajectory(found.knots, PRIOR, *found.factor.marginals())


def run_smoother(observations: Observations, *, lag_s: float = LAG_S) -> FixedLagSmoother:
    """Update measurement by measurement, with a fixed lag."""
    window = FixedLagSmoother(PRIOR)
    for row in range(len(observations)):
        window.update(observations.select(slice(row, row + 1)))
        window.marginalise_before(observations.time_s[row] - lag_s)
    return window


@pytest.mark.slow
def test_newest_state_agrees_with_batch(observations: Observations) -> None:
    """Marginalisation keeps the information: state and covariance at the end are those of all measurements."""
    at_s = np.array([observations.time_s[-1] + 0.3])
    state, covariance = run_smoother(observations).trajectory().at(at_s)
    expected, expected_covariance = batch(observations).at(at_s)
    sigmas = np.sqrt(np.diagonal(expected_covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas).max() < 0.05
    np.testing.assert_allclose(covariance, expected_covariance, rtol=0.05, atol=1e-3 * sigmas.max() ** 2)


@pytest.mark.slow
def test_smoothed_state_agrees_with_batch(observations: Observations) -> None:
    """A few seconds of later measurements are as good as all."""
    window = FixedLagSmoother(PRIOR)
    whole = batch(observations)
    for row in range(len(observations)):
        window.update(observations.select(slice(row, row + 1)))
        now_s = observations.time_s[row]
        if now_s > 2 * LAG_S:
            at_s = np.array([now_s - LAG_S])
            state, covariance = window.trajectory().at(at_s)
            expected, expected_covariance = whole.at(at_s)
            sigmas = np.sqrt(np.diagonal(expected_covariance, axis1=1, axis2=2))
            assert np.abs(state.local_coordinates_about(expected) / sigmas)[:, :6].max() < 0.3
            assert np.trace(covariance[0, :6, :6]) < 1.05 * np.trace(expected_covariance[0, :6, :6])
        window.marginalise_before(now_s - LAG_S)


@pytest.mark.slow
def test_the_window_does_not_grow(observations: Observations) -> None:
    """The number of measurements in the window is bounded."""
    window = run_smoother(observations)
    assert window.observations is not None
    assert len(window.observations) < 1.5 * LAG_S * 7.5
    assert window.horizon_s > observations.time_s[-1] - 1.5 * LAG_S


@pytest.mark.slow
def test_late_measurement_within_the_lag_counts(observations: Observations) -> None:
    """Within the lag the order of arrival does not matter."""
    order = np.arange(len(observations))
    late = len(order) - 8
    order = np.concatenate([order[:late], order[late + 1 :], [late]])
    in_order, out_of_order = run_smoother(observations), run_smoother(observations.select(order))
    at_s = observations.time_s[-1:]
    state, covariance = out_of_order.trajectory().at(at_s)
    expected, expected_covariance = in_order.trajectory().at(at_s)
    sigmas = np.sqrt(np.diagonal(expected_covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas).max() < 0.05
    np.testing.assert_allclose(covariance, expected_covariance, rtol=0.02, atol=1e-3 * sigmas.max() ** 2)


def test_horizon_stays_behind_the_lag(observations: Observations) -> None:
    """The horizon is never after the time up to which states were marginalised."""
    window = FixedLagSmoother(PRIOR)
    for row in range(len(observations)):
        window.update(observations.select(slice(row, row + 1)))
        window.marginalise_before(observations.time_s[row] - LAG_S)
        assert window.horizon_s <= observations.time_s[row] - LAG_S


def test_initialisation_needs_three_prisms(observations: Observations) -> None:
    """Two prisms do not determine the rotation."""
    two = observations.select(observations.prism != 2)
    assert not run_smoother(two).initialised
    assert run_smoother(observations).initialised


@pytest.mark.parametrize("off_m", [0.2, 1.0, 30.0])
@pytest.mark.slow
def test_single_outlier_is_rejected(observations: Observations, off_m: float) -> None:
    """One wrong distance moves the trajectory by less than its sigmas."""
    row = len(observations) - 12
    points = observations.points_m.copy()
    points[row] *= 1 + off_m / np.linalg.norm(points[row])
    wrong = run_smoother(replace(observations, points_m=points))
    without = run_smoother(observations.select(np.arange(len(observations)) != row))
    at_s = float(observations.time_s[-1])
    state, covariance = wrong.predict(at_s)
    expected, _ = without.predict(at_s)
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas)[:, :6].max() < 1.0


def test_inconsistent_prism_is_ambiguous_until_others_agree(observations: Observations) -> None:
    """Wrong measurements of one prism make the state ambiguous; good ones of all prisms resolve it."""
    rows = np.flatnonzero(observations.time_s < 6.0)
    window = run_smoother(observations.select(rows))
    assert not window.ambiguous
    later = observations.select(slice(len(rows), None))
    at = int(np.flatnonzero(later.prism == 0)[0])
    wrong = later.select(slice(at, at + 1))
    for after_s in (0.0, 0.1):
        points = wrong.points_m + np.array([0.5, 0.0, 0.0])
        window.update(replace(wrong, points_m=points, time_s=wrong.time_s + after_s))
        assert window.ambiguous_from_s == wrong.time_s[0] - AMBIGUITY_MARGIN_S
    for row in np.flatnonzero(later.time_s > wrong.time_s[0] + 0.1):
        window.update(later.select(slice(row, row + 1)))
    assert window.ambiguous_from_s == np.inf


@pytest.mark.slow
def test_reinitialised_after_an_outage(observations: Observations) -> None:
    """After half a minute without measurements the smoother converges within a second."""
    later = drawn(2, 3.0)
    again = replace(later, time_s=later.time_s + observations.time_s[-1] + 30.0)
    window = run_smoother(observations)
    for row in range(len(again)):
        window.update(again.select(slice(row, row + 1)))
        window.marginalise_before(again.time_s[row] - LAG_S)
    state, covariance = window.predict(float(again.time_s[-1]))
    expected, _ = batch(again).at(again.time_s[-1:])
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas).max() < 0.3


def test_measurements_that_fit_no_robot_are_searched_once_a_second(
    observations: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Distances in another unit, or a station that was carried away: a search takes a tenth of a second, a dozen would come each second."""
    searches: list[float] = []

    def counting(measured: Observations, *args: Any, max_iterations: int, **kwargs: Any) -> Solution:
        if max_iterations > BRIEF_ITERATIONS:
            searches.append(float(measured.time_s[-1]))
        return solve(measured, *args, max_iterations=max_iterations, **kwargs)

    monkeypatch.setattr(fixed_lag, "solve", counting)
    wrong = observations.time_s < 8.0
    stretched = np.where((wrong & (observations.station == 1))[:, None], 1000.0, 1.0) * observations.points_m
    window, regained_s = FixedLagSmoother(PRIOR), []
    measured = replace(observations, points_m=stretched)
    for row, now_s in enumerate(measured.time_s.tolist()):
        window.update(measured.select(slice(row, row + 1)))
        window.marginalise_before(now_s - LAG_S)
        regained_s += [now_s] if window.converged else []
    assert MAX_FAILED_SEARCHES <= sum(at_s < 8.0 for at_s in searches) <= MAX_FAILED_SEARCHES + 8.0 / RETRY_S
    assert 8.0 < regained_s[0] < 8.0 + LAG_S + RETRY_S


def test_single_prism_is_tracked_with_growing_covariance(observations: Observations) -> None:
    """Tracking continues, and the rotation covariance grows."""
    start = observations.time_s <= 6.0
    alone = observations.select(start | ((observations.prism == 0) & (observations.time_s < 8.0)))
    _, covariance = run_smoother(observations.select(start)).predict(6.0)
    _, then = run_smoother(alone).predict(8.0)
    assert np.trace(then[0, 3:6, 3:6]) > 10 * np.trace(covariance[0, 3:6, 3:6])


@pytest.mark.slow
def test_nees_is_consistent() -> None:
    """NEES of predicted and smoothed poses over motions drawn from the prior has 6 degrees of freedom."""
    predicted: list[float] = []
    smoothed: list[float] = []
    motions = draw_motions(PRIOR, count=12, duration_s=9.0, seed=7)
    for seed, motion in enumerate(motions):
        measured = sorted_by_time(measure(motion, until_s=8.0, seed=seed))
        window = run_smoother(measured)
        for found, at_s in ((predicted, 8.4), (smoothed, 5.6)):
            at = np.array([at_s])
            state, covariance = window.predict(at_s) if found is predicted else window.trajectory().at(at)
            found.append(
                _nees(state.local_coordinates_about(motion.select(rows_at(at)))[:, :6], covariance[:, :6, :6])
            )
    # 95 % band of the mean of 12 draws of chi-square with 6 degrees of freedom, divided by 12.
    for found in (predicted, smoothed):
        assert 4.2 < np.mean(found) < 8.1


def _nees(error: FloatArray, covariance: FloatArray) -> float:
    return float(error[0] @ np.linalg.solve(covariance[0], error[0]))


def test_initialised_trajectory_is_reliable_from_second_measurements(observations: Observations) -> None:
    """Reliable from the second measurement of each of three prisms, and only after a gap."""
    early = observations.select(observations.time_s < 2.0)
    begun = FixedLagSmoother(PRIOR)
    begun.update(early)
    assert begun.converged
    assert begun.reliable_from_s == max(early.time_s[early.prism == prism][1] for prism in range(3))
    few = FixedLagSmoother(PRIOR)
    gap = (observations.time_s < 1.0) | ((observations.time_s > 2.6) & (observations.time_s < 3.2))
    some = observations.select(gap)
    few.update(some)
    assert few.converged
    assert few.reliable_from_s == some.time_s[-1]


@pytest.mark.parametrize(("seed", "prism"), [(2, 0), (4, 1), (7, 0)])
def test_wrong_first_measurement_is_outside_the_reliable_interval(seed: int, prism: int) -> None:
    """The trajectory passes through it, and is correct again by the second measurement."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=6.0, seed=seed)
    measured = sorted_by_time(measure(motion, until_s=5.0, seed=seed))
    seldom = np.sort(np.concatenate([np.flatnonzero(measured.prism == each)[::2] for each in range(3)]))
    measured = measured.select(seldom[:15])
    wrong = measured.points_m.copy()
    wrong[np.flatnonzero(measured.prism == prism)[0], 2] -= 0.3
    window = FixedLagSmoother(PRIOR)
    window.update(replace(measured, points_m=wrong))
    assert window.converged
    at_s = time_grid(window.reliable_from_s, float(measured.time_s[-1]) - 0.5)
    states, covariance = window.trajectory().at(at_s)
    errors = states.local_coordinates_about(motion.select(rows_at(at_s)))[:, :6]
    found = [_nees(errors[i : i + 1], covariance[i : i + 1, :6, :6]) for i in range(len(at_s))]
    assert max(found) < 30.0


def time_grid(from_s: float, until_s: float) -> FloatArray:
    """Multiples of 50 ms between two times."""
    return 0.05 * np.arange(np.ceil(20 * from_s), np.floor(20 * until_s) + 1)


@pytest.mark.parametrize("seed", [1, 19, 44])
def test_inconsistent_measurements_of_one_update(seed: int) -> None:
    """Each passes the gate alone, but they are mutually inconsistent: one is a reflection."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=6.0, seed=seed)
    measured = sorted_by_time(measure(motion, until_s=6.0, seed=seed))
    wrong, row = reflected(measured, seed)
    window = FixedLagSmoother(PRIOR)
    for until_s in np.arange(0.7, 6.0, 0.4):
        here = (wrong.time_s >= until_s - 0.4) & (wrong.time_s < until_s)
        window.update(wrong.select(here if until_s > 0.7 else wrong.time_s < until_s))
        window.marginalise_before(until_s - LAG_S)
        if until_s > wrong.time_s[row]:
            break
    at_s = np.round(until_s + 0.1, 2)
    state, covariance = window.predict(at_s, dim=6)
    error = state.local_coordinates_about(motion.select(rows_at(np.array([at_s]))))[:, :6]
    assert window.ambiguous or _nees(error, covariance) < 60.0


@pytest.mark.parametrize("seed", [0, 10, 19, 36, 38])
def test_accepted_reflection_marks_an_ambiguous_interval(seed: int) -> None:
    """The following measurements look inconsistent, or the trajectory is bent towards all of them."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=10.0, seed=seed)
    measured = sorted_by_time(measure(motion, until_s=9.8, rate_hz=1.2, seed=seed))
    wrong, row = reflected(measured, seed)
    window = FixedLagSmoother(PRIOR)
    for each in range(int(np.searchsorted(wrong.time_s, wrong.time_s[row] + 2.5))):
        window.update(wrong.select(slice(each, each + 1)))
        window.marginalise_before(wrong.time_s[each] - LAG_S)
    at_s = time_grid(float(wrong.time_s[row]) - 0.4, float(wrong.time_s[row]) + 0.4)
    unambiguous = at_s[~window.ambiguous_at(at_s) & (at_s < window.ambiguous_from_s)]
    states, covariance = window.trajectory().at(unambiguous, dim=6)
    errors = states.local_coordinates_about(motion.select(rows_at(unambiguous)))[:, :6]
    assert (
        max([_nees(errors[i : i + 1], covariance[i : i + 1]) for i in range(len(unambiguous))], default=0.0)
        < 60.0
    )


def reflected(measured: Observations, seed: int) -> tuple[Observations, int]:
    """Displace one measurement, made about five seconds after the first, by 4 to 30 cm; return its row too."""
    random = np.random.default_rng(seed)
    row = int(np.searchsorted(measured.time_s, 4.8)) + int(random.integers(3))
    off_m = random.normal(size=3)
    off_m *= np.exp(random.uniform(np.log(0.04), np.log(0.3))) / np.linalg.norm(off_m)
    points_m = measured.points_m.copy()
    points_m[row] += off_m
    return replace(measured, points_m=points_m), row
