"""The fixed lag: measurements one by one, at the same cost for each, as good as all at once where it matters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.prior_motion import draw_motions, measure, rows_at, sorted_by_time

from tsgt.geometry import FixedLagSmoother, FloatArray, Observations, Trajectory
from tsgt.geometry.trajectory import initial_guess, knot_times, solve
from tsgt.geometry.trajectory.innovation_monitor import AMBIGUITY_MARGIN_S
from tsgt.model import MotionPrior

PRIOR = MotionPrior()
LAG_S = 3.0


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Twelve seconds of a robot that moves as the prior says."""
    return drawn(1)


def drawn(seed: int, until_s: float = 12.0) -> Observations:
    """Measurements of some motion, in the order of time."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=until_s, seed=seed)
    return sorted_by_time(measure(motion, until_s=until_s, seed=seed))


def batch(observations: Observations) -> Trajectory:
    """All at once."""
    found = solve(observations, initial_guess(observations, knot_times(observations.time_s)), PRIOR)
    return Trajectory(found.knots, PRIOR, *found.factor.marginals())


def followed(observations: Observations, *, lag_s: float = LAG_S) -> FixedLagSmoother:
    """One by one; what is older than the lag is let go of."""
    window = FixedLagSmoother(PRIOR)
    for row in range(len(observations)):
        window.update(observations.select(slice(row, row + 1)))
        window.marginalise_before(observations.time_s[row] - lag_s)
    return window


def test_the_end_is_that_of_the_whole_trajectory(observations: Observations) -> None:
    """What the window has let go of is not forgotten: state and covariance at the end are those of all measurements."""
    at_s = np.array([observations.time_s[-1] + 0.3])
    state, covariance = followed(observations).trajectory().at(at_s)
    expected, expected_covariance = batch(observations).at(at_s)
    sigmas = np.sqrt(np.diagonal(expected_covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas).max() < 0.05
    np.testing.assert_allclose(covariance, expected_covariance, rtol=0.05, atol=1e-3 * sigmas.max() ** 2)


def test_a_smoothed_state_is_nearly_that_of_the_whole_trajectory(observations: Observations) -> None:
    """A few seconds of measurements on its later side are as good as all."""
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


def test_the_window_does_not_grow(observations: Observations) -> None:
    """Hours cost no more than seconds."""
    window = followed(observations)
    assert window.observations is not None
    assert len(window.observations) < 1.5 * LAG_S * 7.5
    assert window.horizon_s > observations.time_s[-1] - 1.5 * LAG_S


def test_a_late_measurement_counts(observations: Observations) -> None:
    """Within the lag it does not matter when a measurement comes."""
    order = np.arange(len(observations))
    late = len(order) - 8
    order = np.concatenate([order[:late], order[late + 1 :], [late]])
    in_order, out_of_order = followed(observations), followed(observations.select(order))
    at_s = observations.time_s[-1:]
    state, covariance = out_of_order.trajectory().at(at_s)
    expected, expected_covariance = in_order.trajectory().at(at_s)
    sigmas = np.sqrt(np.diagonal(expected_covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas).max() < 0.05
    np.testing.assert_allclose(covariance, expected_covariance, rtol=0.02, atol=1e-3 * sigmas.max() ** 2)


def test_what_has_been_let_go_of_is_named(observations: Observations) -> None:
    """The horizon is the instant before which nothing counts any more, never after what was asked to be kept."""
    window = FixedLagSmoother(PRIOR)
    for row in range(len(observations)):
        window.update(observations.select(slice(row, row + 1)))
        window.marginalise_before(observations.time_s[row] - LAG_S)
        assert window.horizon_s <= observations.time_s[row] - LAG_S


def test_it_begins_when_three_prisms_have_been_measured_twice(observations: Observations) -> None:
    """Two prisms, however often, tell no rotation."""
    two = observations.select(observations.prism != 2)
    assert not followed(two).initialised
    assert followed(observations).initialised


@pytest.mark.parametrize("off_m", [0.2, 1.0, 30.0])
def test_an_outlier_does_little(observations: Observations, off_m: float) -> None:
    """One wrong distance moves the trajectory by no more than its sigmas."""
    row = len(observations) - 12
    points = observations.points_m.copy()
    points[row] *= 1 + off_m / np.linalg.norm(points[row])
    wrong = followed(replace(observations, points_m=points))
    without = followed(observations.select(np.arange(len(observations)) != row))
    at_s = float(observations.time_s[-1])
    state, covariance = wrong.predict(at_s)
    expected, _ = without.predict(at_s)
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas)[:, :6].max() < 1.0


def test_what_contradicts_is_doubtful_until_other_prisms_agree(observations: Observations) -> None:
    """A wrong measurement, and one like it, which cannot clear it; then good ones of all prisms."""
    rows = np.flatnonzero(observations.time_s < 6.0)
    window = followed(observations.select(rows))
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


def test_it_begins_anew_after_an_outage(observations: Observations) -> None:
    """After half a minute without measurements it is found again within a second."""
    later = drawn(2, 3.0)
    again = replace(later, time_s=later.time_s + observations.time_s[-1] + 30.0)
    window = followed(observations)
    for row in range(len(again)):
        window.update(again.select(slice(row, row + 1)))
        window.marginalise_before(again.time_s[row] - LAG_S)
    state, covariance = window.predict(float(again.time_s[-1]))
    expected, _ = batch(again).at(again.time_s[-1:])
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas).max() < 0.3


def test_one_prism_alone_is_followed_with_growing_uncertainty(observations: Observations) -> None:
    """It goes on, and says how much less it knows."""
    start = observations.time_s <= 6.0
    alone = observations.select(start | ((observations.prism == 0) & (observations.time_s < 8.0)))
    _, covariance = followed(observations.select(start)).predict(6.0)
    _, then = followed(alone).predict(8.0)
    assert np.trace(then[0, 3:6, 3:6]) > 10 * np.trace(covariance[0, 3:6, 3:6])


def test_covariances_are_honest() -> None:
    """NEES of predicted and smoothed poses, over motions drawn from the prior, is that of 6 degrees of freedom."""
    predicted: list[float] = []
    smoothed: list[float] = []
    motions = draw_motions(PRIOR, count=12, duration_s=9.0, seed=7)
    for seed, motion in enumerate(motions):
        measured = sorted_by_time(measure(motion, until_s=8.0, seed=seed))
        window = followed(measured)
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


def test_what_was_before_a_gap_is_not_believed_when_it_begins_anew(observations: Observations) -> None:
    """But for that, it is from the second measurements on that three of each prism have told how the robot lies."""
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
def test_a_first_measurement_of_another_prism_bends_nothing_that_is_believed(seed: int, prism: int) -> None:
    """Nothing before it contradicts; the trajectory goes through it, and by the second one it is where it was."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=6.0, seed=seed)
    measured = sorted_by_time(measure(motion, until_s=5.0, seed=seed))
    seldom = np.sort(np.concatenate([np.flatnonzero(measured.prism == each)[::2] for each in range(3)]))
    measured = measured.select(seldom[:15])
    wrong = measured.points_m.copy()
    wrong[np.flatnonzero(measured.prism == prism)[0], 2] -= 0.3
    window = FixedLagSmoother(PRIOR)
    window.update(replace(measured, points_m=wrong))
    assert window.converged
    at_s = in_steps(window.reliable_from_s, float(measured.time_s[-1]) - 0.5)
    states, covariance = window.trajectory().at(at_s)
    errors = states.local_coordinates_about(motion.select(rows_at(at_s)))[:, :6]
    found = [_nees(errors[i : i + 1], covariance[i : i + 1, :6, :6]) for i in range(len(at_s))]
    assert max(found) < 30.0


def in_steps(from_s: float, until_s: float) -> FloatArray:
    """Return multiples of 50 ms between two instants."""
    return 0.05 * np.arange(np.ceil(20 * from_s), np.floor(20 * until_s) + 1)


@pytest.mark.parametrize("seed", [1, 19, 44])
def test_measurements_that_come_together_may_contradict_each_other(seed: int) -> None:
    """Each of them is near enough to where the robot could have gone by then, but not all at once: one is a reflection."""
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
def test_where_a_reflection_was_believed_is_contested(seed: int) -> None:
    """By the next measurements, which it makes seem wrong, or which the trajectory bends to pass by as well."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=10.0, seed=seed)
    measured = sorted_by_time(measure(motion, until_s=9.8, rate_hz=1.2, seed=seed))
    wrong, row = reflected(measured, seed)
    window = FixedLagSmoother(PRIOR)
    for each in range(int(np.searchsorted(wrong.time_s, wrong.time_s[row] + 2.5))):
        window.update(wrong.select(slice(each, each + 1)))
        window.marginalise_before(wrong.time_s[each] - LAG_S)
    at_s = in_steps(float(wrong.time_s[row]) - 0.4, float(wrong.time_s[row]) + 0.4)
    believed = at_s[~window.ambiguous_at(at_s) & (at_s < window.ambiguous_from_s)]
    states, covariance = window.trajectory().at(believed, dim=6)
    errors = states.local_coordinates_about(motion.select(rows_at(believed)))[:, :6]
    assert (
        max([_nees(errors[i : i + 1], covariance[i : i + 1]) for i in range(len(believed))], default=0.0)
        < 60.0
    )


def reflected(measured: Observations, seed: int) -> tuple[Observations, int]:
    """Put one measurement, made about five seconds after the first, 4 to 30 cm off; tell which."""
    random = np.random.default_rng(seed)
    row = int(np.searchsorted(measured.time_s, 4.8)) + int(random.integers(3))
    off_m = random.normal(size=3)
    off_m *= np.exp(random.uniform(np.log(0.04), np.log(0.3))) / np.linalg.norm(off_m)
    points_m = measured.points_m.copy()
    points_m[row] += off_m
    return replace(measured, points_m=points_m), row
