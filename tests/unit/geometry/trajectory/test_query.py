"""Query of a trajectory: interpolation, extrapolation, covariances and their consistency."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest
from harness.drives.prior_motion import STEP_S, draw_motions, measure, rows_at, sorted_by_time
from scipy.stats import chi2

from tsgt.geometry import exp_so3, log_so3
from tsgt.geometry.trajectory import (
    STATE_DIM,
    States,
    Trajectory,
    concatenate_states,
    initial_guess,
    knot_times,
    ros_covariance,
    solve,
)
from tsgt.geometry.trajectory.gauss_newton import AnchorPrior, diffuse_prior
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import Observations

PRIOR = MotionPrior()
SEEDS = 100


def fitted(observations: Observations, start: States, anchor: AnchorPrior | None = None) -> Trajectory:
    """Trajectory of measurements with knots at those of the initial states."""
    found = solve(observations, start, PRIOR, anchor=anchor)
    return Trajectory(found.knots, PRIOR, *found.factor.marginals())


class Case(NamedTuple):
    """A short recording, its initial guess and its trajectory."""

    observations: Observations
    start: States
    trajectory: Trajectory


@pytest.fixture(scope="module")
def case() -> Case:
    """Four seconds of a rotating robot."""
    motion = draw_motions(PRIOR, count=1, duration_s=5.0, seed=11)[0]
    observations = sorted_by_time(measure(motion, until_s=4.0, seed=12))
    start = initial_guess(observations, knot_times(observations.time_s))
    return Case(observations, start, fitted(observations, start))


def with_knots(start: States, trajectory: Trajectory, added_s: FloatArray) -> States:
    """Return initial states with additional knots."""
    states, _ = trajectory.at(added_s)
    whole = concatenate_states([start, states])
    return whole.select(np.argsort(whole.time_s))


def normalised_difference(states: States, covariance: FloatArray, others: States) -> FloatArray:
    """Differences in sigmas of each component, (N, 18)."""
    return states.local_coordinates_about(others) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def scaled(covariance: FloatArray, by: FloatArray) -> FloatArray:
    """Covariances in units of others' sigmas."""
    sigmas = np.sqrt(np.diagonal(by, axis1=1, axis2=2))
    in_sigmas: FloatArray = covariance / (sigmas[:, :, None] * sigmas[:, None, :])
    return in_sigmas


def test_query_at_knots_returns_knots(case: Case) -> None:
    """At a knot's time the query returns its state and covariance."""
    knots = case.trajectory.knots
    states, covariance = case.trajectory.at(knots.time_s)
    np.testing.assert_allclose(states.local_coordinates_about(knots), 0.0, atol=1e-9)
    np.testing.assert_allclose(
        scaled(covariance, case.trajectory.covariance),
        scaled(case.trajectory.covariance, covariance),
        atol=1e-5,
    )


def test_interpolation_agrees_with_an_additional_knot(case: Case) -> None:
    """Interpolation equals a solution with a knot there: states, velocities and covariances."""
    added_s = case.start.time_s[3:20] + 0.4 * np.diff(case.start.time_s)[3:20]
    states, covariance = case.trajectory.at(added_s)
    anchor = diffuse_prior(case.start.select(slice(0, 1)), PRIOR)
    whole = fitted(case.observations, with_knots(case.start, case.trajectory, added_s), anchor)
    rows = np.searchsorted(whole.knots.time_s, added_s)
    # Two short steps follow a wandering axis a little better than a long one: a hundredth of a sigma.
    assert np.abs(normalised_difference(states, covariance, whole.knots.select(rows))).max() < 0.02
    np.testing.assert_allclose(
        scaled(covariance, whole.covariance[rows]),
        scaled(whole.covariance[rows], whole.covariance[rows]),
        atol=0.02,
    )


@pytest.mark.parametrize("ahead_s", [-1.5, -0.3, 0.3, 1.5])
def test_extrapolation_agrees_with_an_additional_knot(case: Case, ahead_s: float) -> None:
    """Beyond both ends the query equals a solution with a knot there."""
    ends = case.start.time_s[[0, -1]]
    added_s = np.array([ends[1] + ahead_s if ahead_s > 0 else ends[0] + ahead_s])
    states, covariance = case.trajectory.at(added_s)
    whole = fitted(case.observations, with_knots(case.start, case.trajectory, added_s))
    row = slice(-1, None) if ahead_s > 0 else slice(0, 1)
    assert np.abs(normalised_difference(states, covariance, whole.knots.select(row))).max() < 0.02
    np.testing.assert_allclose(
        scaled(covariance, whole.covariance[row]),
        scaled(whole.covariance[row], whole.covariance[row]),
        atol=0.02,
    )


@pytest.mark.parametrize("where", ["between", "before", "after"])
def test_covariance_is_propagated_by_exact_jacobians(where: str) -> None:
    """For random states the knots' covariance is propagated by the numerical Jacobian."""
    rng = np.random.default_rng(13)
    first = exp_so3(rng.normal(size=3))
    rotation = np.stack([first, first @ exp_so3(np.array([0.9, -0.5, 0.7]))])
    knots = States(np.array([0.0, 0.5]), rng.normal(size=(2, 3)), rotation, *rng.normal(size=(4, 2, 3)))
    root = rng.normal(size=(2 * STATE_DIM, 2 * STATE_DIM))
    joint = root @ root.T
    blocks = joint.reshape(2, STATE_DIM, 2, STATE_DIM)
    covariance, cross_covariance = np.stack([blocks[0, :, 0], blocks[1, :, 1]]), blocks[None, 0, :, 1]
    asked_s = np.array([{"between": 0.2, "before": -0.4, "after": 0.9}[where]])
    states, found = Trajectory(knots, PRIOR, covariance, cross_covariance).at(asked_s)
    _, added = Trajectory(knots, PRIOR, 0 * covariance, 0 * cross_covariance).at(asked_s)
    columns = []
    for part in range(2 * STATE_DIM):
        error = np.zeros(2 * STATE_DIM)
        error[part] = 1e-6
        forth, back = (
            Trajectory(
                knots.retract(sign * error.reshape(2, STATE_DIM)), PRIOR, covariance, cross_covariance
            ).at(asked_s)[0]
            for sign in (1, -1)
        )
        columns.append(
            (forth.local_coordinates_about(states)[0] - back.local_coordinates_about(states)[0]) / 2e-6
        )
    derivative = np.stack(columns, axis=-1)
    np.testing.assert_allclose(found - added, [derivative @ joint @ derivative.T], rtol=1e-6, atol=1e-6)


def test_extrapolated_covariance_grows(case: Case) -> None:
    """Covariances grow with the distance from the measurements, in both directions."""
    ends = case.start.time_s[[0, -1]]
    ahead_s = np.array([0.0, 0.1, 0.3, 1.0, 3.0, 10.0])
    for times_s in (ends[1] + ahead_s, ends[0] - ahead_s):
        _, covariance = case.trajectory.at(times_s)
        for parts in (slice(0, 3), slice(3, 6)):
            largest = np.linalg.eigvalsh(covariance[:, parts, parts]).max(axis=1)
            assert np.all(np.diff(largest) > 0)


def test_an_outage_shows_in_the_covariance(case: Case) -> None:
    """In the middle of a second without measurements the pose is several times less certain."""
    gap = (case.observations.time_s > 1.5) & (case.observations.time_s < 2.5)
    kept = case.observations.select(~gap)
    trajectory = fitted(kept, initial_guess(kept, knot_times(kept.time_s)))
    _, covariance = trajectory.at(np.array([1.2, 2.0]))
    sigmas = np.sqrt(np.linalg.eigvalsh(covariance[:, :3, :3]).max(axis=1))
    assert sigmas[1] > 4 * sigmas[0]


def test_rotation_beyond_pi_during_an_outage() -> None:
    """A robot that rotated by 200 degrees during an outage did not rotate back by 160."""
    time_s = np.arange(round(16.0 / STEP_S) + 1, dtype=np.float64) * STEP_S
    still = np.zeros((len(time_s), 3))
    place, rates = (np.tile(value, (len(time_s), 1)) for value in ([60.0, 45.0, -1.0], [0.0, 0.0, 0.5]))
    motion = States(time_s, place, exp_so3(rates * time_s[:, None]), still, rates, still, still)
    observations = sorted_by_time(measure(motion, until_s=15.0, seed=17))
    kept = observations.select((observations.time_s < 4.0) | (observations.time_s > 11.0))
    trajectory = fitted(kept, initial_guess(kept, knot_times(kept.time_s)))
    asked_s = np.array([3.5, 4.0, 7.5, 11.0, 11.5])
    states, covariance = trajectory.at(asked_s)
    error = motion.select(rows_at(asked_s)).local_coordinates_about(states)
    assert nees_of(error[:, :6], covariance[:, :6, :6]).max() < chi2.ppf(0.999, 6)


def test_order_of_query_times_is_irrelevant(case: Case) -> None:
    """Times in any order, inside and outside, get their own states; an empty query returns none."""
    asked_s = np.linspace(-1.0, 5.0, 50)
    order = np.random.default_rng(14).permutation(50)
    states, covariance = case.trajectory.at(asked_s)
    shuffled, shuffled_covariance = case.trajectory.at(asked_s[order])
    np.testing.assert_allclose(shuffled.local_coordinates_about(states.select(order)), 0.0, atol=1e-12)
    np.testing.assert_allclose(shuffled_covariance, covariance[order], rtol=1e-9, atol=1e-12)
    nothing, no_covariance = case.trajectory.at(np.array([]))
    assert len(nothing) == 0
    assert no_covariance.shape == (0, STATE_DIM, STATE_DIM)


def test_ros_covariance_is_that_of_drawn_errors() -> None:
    """The covariance about the fixed axes equals that of a sample."""
    rng = np.random.default_rng(15)
    rotation = exp_so3(rng.normal(size=3))
    root = rng.normal(size=(6, 6)) * 1e-4
    covariance = np.zeros((STATE_DIM, STATE_DIM))
    covariance[:6, :6] = root @ root.T
    errors = rng.normal(size=(200_000, 6)) @ root.T
    drawn = rotation @ exp_so3(errors[:, 3:])
    about_fixed = log_so3(drawn @ rotation.T)
    expected = np.cov(np.concatenate([errors[:, :3], about_fixed], axis=1).T)
    found = ros_covariance(rotation[None], covariance[None])[0]
    np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max())


# Duration of the measurements of one hundred robots drawn from the prior:
UNTIL_S = 8.0
AHEAD_S = np.array([0.1, 0.3, 1.0])
INSIDE_S = np.array([2.0, 3.3, 4.7, 6.0])


@pytest.fixture(scope="module")
def nees_by_kind() -> dict[str, FloatArray]:
    """NEES, (seeds, times): of poses and whole states, at knots, between them and predicted."""
    found: dict[str, list[FloatArray]] = {
        "knots": [],
        "pose": [],
        "state": [],
        "ahead": [],
        "ahead_state": [],
    }
    motions = draw_motions(PRIOR, count=SEEDS, duration_s=UNTIL_S + 1.5, seed=16)
    for seed, motion in enumerate(motions):
        observations = sorted_by_time(measure(motion, until_s=UNTIL_S, seed=seed))
        trajectory = fitted(observations, initial_guess(observations, knot_times(observations.time_s)))
        ends_s = np.floor(observations.time_s[-1] / STEP_S) * STEP_S
        for asked_s, pose, state in ((INSIDE_S, "pose", "state"), (ends_s + AHEAD_S, "ahead", "ahead_state")):
            states, covariance = trajectory.at(asked_s)
            error = motion.select(rows_at(asked_s)).local_coordinates_about(replace(states, time_s=asked_s))
            found[pose].append(nees_of(error[:, :6], covariance[:, :6, :6]))
            found[state].append(nees_of(error, covariance))
        rows = np.searchsorted(trajectory.knots.time_s, INSIDE_S)
        near = trajectory.knots.select(rows)
        on_grid = np.round(near.time_s / STEP_S) * STEP_S
        states, covariance = trajectory.at(on_grid)
        error = motion.select(rows_at(on_grid)).local_coordinates_about(states)
        found["knots"].append(nees_of(error[:, :6], covariance[:, :6, :6]))
    return {name: np.array(values) for name, values in found.items()}


def nees_of(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """NEES of N errors."""
    nees: FloatArray = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return nees


@pytest.mark.parametrize(
    ("what", "freedom"), [("knots", 6), ("pose", 6), ("state", 18), ("ahead", 6), ("ahead_state", 18)]
)
@pytest.mark.slow
def test_nees_is_consistent(nees_by_kind: dict[str, FloatArray], what: str, freedom: int) -> None:
    """Over 100 robots drawn from the prior, mean NEES lies in its 95 % band at each time."""
    nees = nees_by_kind[what]
    means = nees.mean(axis=0)
    # 95 % for all instants together.
    outside = 0.05 / len(means)
    low, high = (float(chi2.ppf(share, freedom * SEEDS)) / SEEDS for share in (outside / 2, 1 - outside / 2))
    assert np.all((means > low) & (means < high)), f"{means} outside {low:.2f} to {high:.2f}"
    # And as many are beyond the 95 % limit as there should be.
    assert 0.01 < np.mean(nees > chi2.ppf(0.95, freedom)) < 0.1
