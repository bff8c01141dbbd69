"""Maximum a posteriori trajectory against dense Gaussian-process regression and least squares; outliers; degenerate input."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.prior_motion import (
    SIGMAS_M,
    STEP_S,
    as_cartesian,
    draw_motions,
    measure,
    rows_at,
    sorted_by_time,
)
from harness.drives.scene import FRAMES, LAYOUT
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from tsgt.errors import GeometryError
from tsgt.geometry import cartesian_to_polar, exp_so3
from tsgt.geometry.trajectory import (
    MIN_KNOT_SPACING_S,
    STATE_DIM,
    Observations,
    States,
    Trajectory,
    initial_guess,
    knot_times,
    nearest_knots,
    solve,
)
from tsgt.geometry.trajectory.gauss_newton import (
    COST_TOLERANCE,
    OUTLIER_THRESHOLD,
    REJECTION_THRESHOLD,
    AnchorPrior,
    diffuse_prior,
    log_evidence,
)
from tsgt.geometry.trajectory.motion_prior import process_noise, transition
from tsgt.geometry.trajectory.states import ProcessFactors, axes_to_state, linearise_process
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

PRIOR = MotionPrior()
MOTION = draw_motions(PRIOR, count=1, duration_s=8.0, seed=3)[0]


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Six seconds of a robot, three stations, exact timestamps."""
    found = sorted_by_time(measure(MOTION, until_s=6.0, seed=4))
    return replace(found, time_sigma_s=np.zeros(len(found)))


def guess_of(observations: Observations) -> States:
    """Return the initial guess at the knots of these measurements."""
    return initial_guess(observations, knot_times(observations.time_s))


def origin_measurements(time_s: FloatArray, x_m: FloatArray, sigma_m: float) -> Observations:
    """Isotropic measurements of the robot's origin: only translation is observed."""
    count = len(time_s)
    return Observations(
        time_s=time_s,
        time_sigma_s=np.zeros(count),
        points_m=np.repeat(x_m[:, None], 3, axis=1),
        sigmas_m=np.full((count, 3), sigma_m),
        polar=np.zeros(count, dtype=bool),
        station=np.zeros(count, dtype=np.intp),
        prism=np.zeros(count, dtype=np.intp),
        frames=np.eye(4)[None],
        layout=np.zeros((1, 3)),
    )


def at_rest(time_s: FloatArray) -> States:
    """Return a robot at rest at the origin."""
    zero = np.zeros((len(time_s), 3))
    return States(time_s, zero, np.broadcast_to(np.eye(3), (len(time_s), 3, 3)), zero, zero, zero, zero)


def dense_prior(time_s: FloatArray, first: FloatArray, time_constant_s: float, sigma: float) -> FloatArray:
    """Joint covariance of one axis's states at all times, (K, 3, K, 3), from that of the first, (3, 3)."""
    count = len(time_s)
    joint = np.zeros((count, 3, count, 3))
    own = first
    for k in range(count):
        joint[k, :, k] = own
        for later in range(k + 1, count):
            phi = transition(time_s[later] - time_s[k], time_constant_s)
            joint[k, :, later] = own @ phi.T
            joint[later, :, k] = phi @ own
        if k + 1 < count:
            dt_s = time_s[k + 1] - time_s[k]
            phi = transition(dt_s, time_constant_s)
            own = phi @ own @ phi.T + sigma**2 * process_noise(dt_s, time_constant_s)
    return joint


def test_translation_agrees_with_dense_regression() -> None:
    """For position measurements, means, covariances and evidence equal dense Gaussian-process regression."""
    rng = np.random.default_rng(5)
    time_s = np.cumsum(rng.uniform(0.05, 0.6, 25))
    measured = np.sin(time_s) + rng.normal(scale=0.05, size=25)
    data, sigma_m = origin_measurements(time_s, measured, 0.05), 0.05
    priors = (
        PRIOR,
        replace(PRIOR, acceleration_sigma_mps2=(1.3, 1.3, 1.3), acceleration_correlation_time_s=0.3),
    )
    evidence, expected_evidence = [], []
    for prior in priors:
        sigma, lasting_s = prior.acceleration_sigma_mps2[0], prior.acceleration_correlation_time_s
        spread_of_first = np.array([2.0, 1.5, sigma])
        information = np.eye(STATE_DIM)
        for axis in range(3):
            own = prior.acceleration_sigma_mps2[axis]
            information[axis, axis], information[6 + axis, 6 + axis] = 2.0**-2, 1.5**-2
            information[12 + axis, 12 + axis] = own**-2
        # Where the measurements are, so that none is an outlier to begin with.
        start = replace(at_rest(time_s), position=data.points_m)
        at_origin = AnchorPrior(at_rest(time_s).select(slice(0, 1)), information)
        found = solve(data, start, prior, anchor=at_origin)
        assert np.all(found.weights == 1.0)

        joint = dense_prior(time_s, np.diag(spread_of_first**2), lasting_s, sigma)
        of_measured = joint[:, 0, :, 0] + sigma_m**2 * np.eye(25)
        gain = np.linalg.solve(of_measured, joint[:, 0].reshape(25, -1)).T
        mean = (gain @ measured).reshape(25, 3)
        covariance = joint.reshape(75, 75) - gain @ joint[:, 0].reshape(25, -1)
        for part, values in enumerate((found.knots.position, found.knots.velocity, found.knots.acceleration)):
            np.testing.assert_allclose(values[:, 0], mean[:, part], atol=1e-8)
        diagonal, off_diagonal = found.factor.marginals()
        blocks, parts = covariance.reshape(25, 3, 25, 3), [0, 6, 12]
        for k in range(25):
            np.testing.assert_allclose(diagonal[k][np.ix_(parts, parts)], blocks[k, :, k], atol=1e-9)
        for k in range(24):
            np.testing.assert_allclose(off_diagonal[k][np.ix_(parts, parts)], blocks[k, :, k + 1], atol=1e-9)
        evidence.append(log_evidence(found, data, prior))
        per_axis = []
        for own in prior.acceleration_sigma_mps2:
            first = np.diag(np.array([2.0, 1.5, own]) ** 2)
            own_joint = dense_prior(time_s, first, lasting_s, own)[:, 0, :, 0]
            per_axis.append(multivariate_normal(cov=own_joint + sigma_m**2 * np.eye(25)).logpdf(measured))
        expected_evidence.append(sum(per_axis))
    # What the angular acceleration's prior leaves in the evidence is the same for both: nothing turns.
    assert evidence[1] - evidence[0] == pytest.approx(expected_evidence[1] - expected_evidence[0], abs=1e-5)


@pytest.mark.slow
def test_pose_agrees_with_scipy_least_squares(observations: Observations) -> None:
    """On polar measurements of a rotating robot the states are those of scipy's least squares on the angles themselves."""
    data = observations.select(observations.time_s < 1.0)
    start = guess_of(data)
    found = solve(data, start, PRIOR)
    assert np.all(found.weights == 1.0)
    at, steps = nearest_knots(start.time_s, data.time_s), ProcessFactors.of(start.time_s, PRIOR)
    anchor = diffuse_prior(start.select(slice(0, 1)), PRIOR)
    roots = np.swapaxes(np.linalg.cholesky(axes_to_state(steps.information)), 1, 2)
    anchor_root = np.sqrt(np.diag(anchor.information))
    measured = np.stack(cartesian_to_polar(data.points_m), axis=-1)

    def residuals(flat: FloatArray) -> FloatArray:
        knots = found.knots.retract(flat.reshape(-1, STATE_DIM))
        delta_s = (data.time_s - knots.time_s[at])[:, None]
        turn = knots.angular_velocity[at] * delta_s + knots.angular_acceleration[at] * delta_s**2 / 2
        arm = Rotation.from_rotvec(turn).apply(LAYOUT[data.prism])
        world = (
            knots.position[at]
            + knots.velocity[at] * delta_s
            + knots.acceleration[at] * delta_s**2 / 2
            + Rotation.from_matrix(knots.rotation[at]).apply(arm)
        )
        frames = FRAMES[data.station]
        seen = np.einsum("mji,mj->mi", frames[:, :3, :3], world - frames[:, :3, 3])
        around, zenith, distance_m = np.stack(cartesian_to_polar(seen), axis=-1).T
        turned = (around - measured[:, 0] + np.pi) % (2 * np.pi) - np.pi
        by_measurement = np.stack(
            [
                distance_m - measured[:, 2],
                turned * measured[:, 2] * np.sin(measured[:, 1]),
                (zenith - measured[:, 1]) * measured[:, 2],
            ],
            axis=-1,
        )
        by_step = (roots @ linearise_process(knots, steps).residuals[..., None])[..., 0]
        first = anchor_root * knots.select(slice(0, 1)).local_coordinates_about(anchor.linearisation_point)[0]
        return np.concatenate([(by_measurement / data.sigmas_m).ravel(), by_step.ravel(), first])

    diagonal, _ = found.factor.marginals()
    sigmas = np.sqrt(np.diagonal(diagonal, axis1=1, axis2=2))
    # In sigmas, from a tenth of one away in each of them.
    begin = np.random.default_rng(1).normal(scale=0.1, size=sigmas.size)

    def in_sigmas(error: FloatArray) -> FloatArray:
        return residuals(error * sigmas.ravel())

    oracle = least_squares(in_sigmas, begin, method="lm")
    # The search ends where a step gains less than this.
    assert 2 * oracle.cost == pytest.approx(found.cost, abs=COST_TOLERANCE * len(data) ** 0.5)
    assert np.abs(oracle.x).max() < 0.03


def test_the_order_of_measurements_is_irrelevant(observations: Observations) -> None:
    """Shuffled measurements give the same trajectory, distances and weights."""
    start = guess_of(observations)
    order = np.random.default_rng(6).permutation(len(observations))
    found, shuffled = (solve(data, start, PRIOR) for data in (observations, observations.select(order)))
    np.testing.assert_allclose(shuffled.knots.local_coordinates_about(found.knots), 0.0, atol=1e-8)
    np.testing.assert_allclose(shuffled.squared_distances, found.squared_distances[order], atol=1e-5)
    assert shuffled.cost == pytest.approx(found.cost)


def test_squared_distances_are_chi_square(observations: Observations) -> None:
    """Mean squared distance of 3 minus the share that the trajectory absorbs."""
    found = solve(observations, guess_of(observations), PRIOR)
    # The trajectory takes what it takes up: six numbers a time, every 0.4 s, of nine that are measured.
    assert 0.8 < found.squared_distances.mean() < 3.0
    assert np.count_nonzero(found.weights < 1.0) <= 1


@pytest.mark.parametrize("miss_m", [0.1, 0.5, 30.0])
def test_single_outlier_is_downweighted(observations: Observations, miss_m: float) -> None:
    """A reflection gets next to no weight, a distant one none; no other weight changes and the trajectory stays."""
    clean = solve(observations, guess_of(observations), PRIOR)
    wrong = len(observations) // 2
    points = observations.points_m.copy()
    points[wrong] *= 1 + miss_m / np.linalg.norm(points[wrong])
    found = solve(replace(observations, points_m=points), guess_of(observations), PRIOR)
    assert np.argmin(found.weights) == wrong
    assert found.weights[wrong] < 16 / (miss_m / 0.01) ** 2
    little = OUTLIER_THRESHOLD**2 / found.squared_distances[wrong]
    assert found.weights[wrong] == pytest.approx(
        0.0 if found.squared_distances[wrong] > REJECTION_THRESHOLD**2 else little
    )
    assert np.count_nonzero((found.weights < 1.0) & (clean.weights == 1.0)) == 1
    arm = LAYOUT.mean(axis=0)
    centroid, clean_centroid = (s.knots.position + s.knots.rotation @ arm for s in (found, clean))
    assert np.linalg.norm(centroid - clean_centroid, axis=1).max() < 0.01


def test_wrong_prism_is_an_outlier(observations: Observations) -> None:
    """Exactly the measurements of a neighbour's prism are outliers."""
    wrong = np.flatnonzero(observations.prism == 0)[4:7]
    truth = MOTION.select(rows_at(observations.time_s[wrong]))
    world = truth.position + truth.rotation @ LAYOUT[1]
    points = observations.points_m.copy()
    points[wrong] = np.einsum("ij,mi->mj", FRAMES[0, :3, :3], world - FRAMES[0, :3, 3])
    data = replace(observations, points_m=points)
    found = solve(data, guess_of(data), PRIOR)
    clean = solve(observations, guess_of(observations), PRIOR)
    named = np.flatnonzero((found.weights < 1.0) & (clean.weights == 1.0))
    np.testing.assert_array_equal(named, wrong)


def test_station_on_the_wrong_prism_adds_no_information() -> None:
    """Many rejected outliers leave the unobserved rotation as uncertain as without them."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=8.0, seed=4)
    observations = sorted_by_time(measure(motion, until_s=6.0, seed=4))
    wrong = (observations.prism == 0) & (observations.time_s > 3.0)
    truth = motion.select(rows_at(observations.time_s[wrong]))
    world = truth.position + truth.rotation @ LAYOUT[1]
    points = observations.points_m.copy()
    points[wrong] = np.einsum("ij,mi->mj", FRAMES[0, :3, :3], world - FRAMES[0, :3, 3])
    others = observations.select(~wrong)
    (state, covariance), (expected, expected_covariance) = (
        Trajectory(solution.knots, PRIOR, *solution.factor.marginals()).at(np.array([4.0]))
        for solution in (
            solve(each, guess_of(others), PRIOR) for each in (replace(observations, points_m=points), others)
        )
    )
    sigmas = np.sqrt(np.diagonal(expected_covariance, axis1=1, axis2=2))
    assert np.abs(state.local_coordinates_about(expected) / sigmas).max() < 2.0
    worst, expected_worst = (
        np.linalg.eigvalsh(each[0, 3:6, 3:6])[-1] for each in (covariance, expected_covariance)
    )
    assert worst == pytest.approx(expected_worst, rel=0.1)


def test_cartesian_solution_is_close_to_polar(observations: Observations) -> None:
    """Cartesian points give the same positions within millimetres."""
    found = solve(observations, guess_of(observations), PRIOR)
    of_points = solve(as_cartesian(observations), guess_of(observations), PRIOR)
    miss = of_points.knots.position - found.knots.position
    assert np.sqrt((miss**2).sum(axis=1).mean()) < 2 * SIGMAS_M[0]


def test_converges_from_a_bad_guess(observations: Observations) -> None:
    """From metres and tens of degrees away it converges to the same trajectory and covariances."""
    start = guess_of(observations)
    rng = np.random.default_rng(7)
    error = np.zeros((len(start), STATE_DIM))
    error[:, :3], error[:, 3:6] = rng.normal(scale=2.0, size=(2, len(start), 3)) * [[[1.0]], [[0.2]]]
    anchor = diffuse_prior(start.select(slice(0, 1)), PRIOR)
    good, bad = (solve(observations, begin, PRIOR, anchor=anchor) for begin in (start, start.retract(error)))
    assert bad.cost == pytest.approx(good.cost, rel=1e-5)
    np.testing.assert_allclose(bad.knots.position, good.knots.position, atol=1e-4)
    np.testing.assert_allclose(
        bad.factor.marginals()[0][:, :6, :6], good.factor.marginals()[0][:, :6, :6], atol=1e-5
    )


@pytest.mark.parametrize("most", [0, 1, 2, 3])
def test_covariance_is_that_of_the_last_linearisation(observations: Observations, most: int) -> None:
    """Wherever the search is cut short, the covariance is the inverse of the normal equations there."""
    start = guess_of(observations)
    rng = np.random.default_rng(8)
    error = np.zeros((len(start), STATE_DIM))
    error[:, 3:6] = rng.normal(scale=0.6, size=(len(start), 3))
    anchor = diffuse_prior(start.select(slice(0, 1)), PRIOR)
    cut = solve(observations, start.retract(error), PRIOR, anchor=anchor, max_iterations=most)
    assert cut.iterations == most
    there = solve(observations, cut.knots, PRIOR, anchor=anchor, max_iterations=0)
    np.testing.assert_allclose(there.factor.banded, cut.factor.banded, rtol=1e-9, atol=1e-9)


def test_two_prisms_are_rejected(observations: Observations) -> None:
    """The error says how many prisms were measured."""
    with pytest.raises(GeometryError, match=r"3 prisms.*2 have been measured"):
        guess_of(observations.select(observations.prism != 2))


def test_coincident_prisms_are_rejected(observations: Observations) -> None:
    """Three stations on one prism determine no attitude; the error asks which station tracks which."""
    points = observations.points_m.copy()
    for station in range(3):
        rows = observations.station == station
        points[rows] = (np.array([50.0, 40.0, 1.0]) - FRAMES[station, :3, 3]) @ FRAMES[station, :3, :3]
    with pytest.raises(GeometryError, match="which station tracks which prism"):
        guess_of(replace(observations, points_m=points))


def test_underdetermined_trajectory_is_rejected(observations: Observations) -> None:
    """Without an anchor prior and with one measurement there is no trajectory."""
    start = guess_of(observations)
    nothing = AnchorPrior(start.select(slice(0, 1)), np.zeros((STATE_DIM, STATE_DIM)))
    with pytest.raises(GeometryError, match="do not determine the trajectory"):
        solve(observations.select(slice(0, 1)), start, PRIOR, anchor=nothing)


def test_single_prism_increases_rotation_covariance(observations: Observations) -> None:
    """With one prism left the rotation becomes uncertain, faster than the prism's position."""
    data = observations.select((observations.time_s < 2.0) | (observations.prism == 0))
    start = initial_guess(data, knot_times(data.time_s))
    diagonal, _ = solve(data, start, PRIOR).factor.marginals()
    before, after = diagonal[np.searchsorted(start.time_s, 1.5)], diagonal[-1]
    turning = np.sqrt(np.linalg.eigvalsh(after[3:6, 3:6]).max() / np.linalg.eigvalsh(before[3:6, 3:6]).max())
    assert turning > 10
    by_error = np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
    found = solve(data, start, PRIOR).knots
    x, y, z = LAYOUT[0]
    by_error[:, 3:] = -found.rotation[-1] @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    of_prism = by_error @ after[:6, :6] @ by_error.T
    assert np.sqrt(np.linalg.eigvalsh(of_prism).max()) < 0.01


@pytest.mark.parametrize("rate_radps", [0.0, 1.5, 2.5])
def test_fast_rotation_with_one_prism_is_tracked(rate_radps: float) -> None:
    """The initial guess extrapolates the rotation and takes the position from the observed prism."""
    time_s = np.arange(round(8.0 / STEP_S) + 1, dtype=np.float64) * STEP_S
    still = np.zeros((len(time_s), 3))
    velocity, rates = (np.tile(v, (len(time_s), 1)) for v in ([0.8, -0.5, 0.0], [0.3, 0.0, rate_radps]))
    motion = States(
        time_s,
        np.array([60.0, 45.0, -1.0]) + time_s[:, None] * velocity,
        exp_so3(time_s[:, None] * rates),
        velocity,
        rates,
        still,
        still,
    )
    whole = sorted_by_time(measure(motion, until_s=7.5, seed=18))
    data = whole.select((whole.time_s < 3.0) | (whole.time_s > 4.5) | (whole.prism == 0))
    start = guess_of(data)
    truth = motion.select(rows_at(start.time_s))
    away = start.local_coordinates_about(truth)
    assert np.linalg.norm(away[:, 3:6], axis=1).max() < 0.7
    found = solve(data, start, PRIOR)
    assert np.all(found.weights == 1.0)
    assert np.linalg.norm(found.knots.local_coordinates_about(truth)[:, 3:6], axis=1).max() < 0.1


def test_knots_are_at_measurement_times() -> None:
    """A single measurement has its knot at its time; close ones share a knot at their mean."""
    times = knot_times(np.array([1.0, 1.2, 1.2 + 0.3 * MIN_KNOT_SPACING_S, 3.3]))
    np.testing.assert_allclose(times, [1.0, 1.2 + 0.15 * MIN_KNOT_SPACING_S, 3.3])


def test_knots_are_spaced_and_near() -> None:
    """Knots keep the minimum spacing, and every measurement has one nearby."""
    time_s = np.sort(np.random.default_rng(9).uniform(0, 20, 2000))
    times = knot_times(time_s)
    assert np.diff(times).min() > 0.2 * MIN_KNOT_SPACING_S
    assert np.abs(times[nearest_knots(times, time_s)] - time_s).max() < MIN_KNOT_SPACING_S


def test_nearest_is_the_nearest() -> None:
    """Each instant gets the knot that is nearest, before the first and after the last one too."""
    knots_s = np.array([0.0, 1.0, 3.0])
    time_s = np.array([-5.0, 0.4, 0.6, 1.9, 2.1, 9.0])
    np.testing.assert_array_equal(nearest_knots(knots_s, time_s), [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(nearest_knots(knots_s[:1], time_s), 0)
