"""Fixed-lag smoother with an IMU: against the batch solution, against integration by scipy, from nothing, out of order."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial.inertial_drive import DEG, imu_parameters, inertial_drive, standing_from
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from tsgt.errors import GeometryError
from tsgt.geometry import log_so3
from tsgt.geometry.inertial import InertialFixedLagSmoother, fit_inertial_trajectory
from tsgt.geometry.inertial.live import fixed_lag
from tsgt.model import ImuParameters, MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialSamples
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations, SetupJacobian

IMU = imu_parameters()
DRIVE = inertial_drive(11.0, seed=12)
SAMPLES = DRIVE.samples(IMU)
CENTROID = DRIVE.layout.mean(axis=0)
LAG_S = 3.0
DELAY_S = 0.35  # Of measurements
UNTIL_S = 7.0


def measurements(stations: int = 3) -> Observations:
    """Return measurements with the layout of the prisms that the stations track, from the centroid of all."""
    observations = DRIVE.measure(stations=stations)
    return replace(observations, layout=observations.layout[:stations] - CENTROID)


class Live:
    """A smoother that is given measurements and lines of samples as they arrive."""

    def __init__(
        self,
        *,
        gyro_only: bool = False,
        setup_jacobian: SetupJacobian | None = None,
        imu: ImuParameters = IMU,
        min_prisms: int = 1,
    ) -> None:
        self.window = InertialFixedLagSmoother(
            imu,
            MotionPrior(),
            reference_m=CENTROID,
            setup_jacobian=setup_jacobian,
            gyro_only=gyro_only,
            min_prisms=min_prisms,
        )
        self._sampled = 0

    def sample_until(self, time_s: float, samples: InertialSamples = SAMPLES) -> None:
        """Add the samples up to a time."""
        stop = int(np.searchsorted(samples.end_s, time_s, side="right"))
        self.window.add_samples(samples.select(slice(self._sampled, stop)))
        self._sampled = stop

    def measure(self, observations: Observations, samples: InertialSamples = SAMPLES) -> None:
        """Add measurements one by one, each with the samples up to its arrival."""
        for row in range(len(observations)):
            now_s = float(observations.time_s[row]) + DELAY_S
            self.sample_until(now_s, samples)
            self.window.update(observations.select(slice(row, row + 1)))
            self.window.marginalise_before(now_s - LAG_S)


@cache
def tracked(stations: int = 3) -> Live:
    """Seven seconds, live. Not to be changed."""
    live = Live()
    observations = measurements(stations)
    live.measure(observations.select(observations.time_s < UNTIL_S))
    return live


def difference(found: FloatArray, expected: FloatArray) -> FloatArray:
    """Rotation vectors from one to the other, (N, 3)."""
    return log_so3(np.swapaxes(expected, 1, 2) @ found)


def test_newest_pose_agrees_with_batch() -> None:
    """Marginalisation keeps the information: pose and covariance at the end are those of all measurements."""
    observations = measurements()
    observations = observations.select(observations.time_s < UNTIL_S)
    fit = fit_inertial_trajectory(observations, SAMPLES, IMU, reference_m=CENTROID)
    at_s = observations.time_s[-1:]
    (found, covariance), (expected, expected_covariance) = (
        tracked().window.trajectory().at(at_s),
        fit.trajectory.at(at_s),
    )
    sigmas = np.sqrt(np.diag(expected_covariance[0]))
    error = np.concatenate(
        [found.position - expected.position, difference(found.rotation, expected.rotation)], 1
    )
    assert np.abs(error / sigmas).max() < 0.05
    np.testing.assert_allclose(
        covariance[0] / np.outer(sigmas, sigmas), expected_covariance[0] / np.outer(sigmas, sigmas), atol=0.05
    )


def test_prediction_equals_integration() -> None:
    """Strapdown from the newest knot equals scipy's integration of the samples, and the velocity is that of the motion."""
    window = tracked().window
    knots, gravity = window.trajectory().inside.knots, window.trajectory().inside.gravity
    start_s = float(knots.time_s[-1])
    end_s = start_s + 0.345
    first = int(np.searchsorted(SAMPLES.end_s, start_s, side="right"))
    rates = SAMPLES.angular_rate_radps - knots.gyro_bias[-1]
    forces = SAMPLES.specific_force_mps2 - knots.bias_or_acceleration[-1]
    fall = gravity.vector()
    state = np.concatenate(
        [Rotation.from_matrix(knots.rotation[-1]).as_quat(), knots.position[-1], knots.velocity[-1]]
    )
    time_s = start_s
    for row in range(first, int(np.searchsorted(SAMPLES.end_s, end_s)) + 1):

        def derivative(_: float, y: FloatArray, row: int = row) -> FloatArray:
            rotation = Rotation.from_quat(y[:4])
            half = 0.5 * np.append(rates[row], 0.0)
            x, y_, z, w = y[:4]
            turn = np.array(
                [[w, -z, y_, x], [z, w, -x, y_], [-y_, x, w, z], [-x, -y_, -z, w]], dtype=np.float64
            )
            return np.concatenate([turn @ half, y[7:10], rotation.apply(forces[row]) + fall])

        until_s = min(float(SAMPLES.end_s[row]), end_s)
        state = solve_ivp(derivative, (time_s, until_s), state, rtol=1e-10, atol=1e-12).y[:, -1]
        time_s = until_s
    mounting = window.trajectory().inside.mounting
    rotation = Rotation.from_quat(state[:4]).as_matrix()
    found, _ = window.predict(end_s)
    np.testing.assert_allclose(
        found.position[0], state[4:7] + rotation @ mounting.in_imu(np.zeros(3)), atol=1e-6
    )
    np.testing.assert_allclose(found.rotation[0], rotation @ mounting.rotation.T, atol=1e-6)
    step_s = 0.02
    before, after = window.predict(end_s - step_s)[0], window.predict(end_s)[0]
    moved = (after.position - before.position) / step_s
    np.testing.assert_allclose(0.5 * (before.velocity + after.velocity), moved, atol=0.01)


def test_predicted_covariance_equals_that_of_a_knot() -> None:
    """A knot at the time of the prediction, which nothing measures, has the same covariance."""
    window = tracked().window
    trajectory = window.trajectory().inside
    newest_s = float(trajectory.knots.time_s[-1])
    at_s = newest_s + 0.3
    _, covariance = window.predict(at_s)
    observations = measurements()
    observations = observations.select(observations.time_s < UNTIL_S)
    far = observations.select(slice(-1, None))
    # A measurement without weight.
    far = replace(far, time_s=np.array([at_s]), sigmas_m=1e6 * far.sigmas_m)
    live = Live()
    live.measure(observations)
    live.window.update(far)
    _, expected = live.window.trajectory().at(np.array([at_s]))
    scale = np.sqrt(np.diag(expected[0]))
    ratio = covariance[0] / window._prediction_scale() / np.outer(scale, scale)
    np.testing.assert_allclose(ratio, expected[0] / np.outer(scale, scale), atol=0.02)


@pytest.mark.parametrize(
    ("stations", "limit_mm", "limit_deg"), [(3, 5.0, 0.15), (2, 6.0, 0.15), (1, 25.0, 2.0)]
)
def test_start_from_nothing(stations: int, limit_mm: float, limit_deg: float) -> None:
    """The heading is found without any pose, with one station as soon as the robot moves."""
    window = tracked(stations).window
    assert window.converged
    assert not window.ambiguous
    time_s = np.arange(5.0, 6.8, 0.1)
    states, covariance = window.trajectory().at(time_s)
    position, rotation = DRIVE.pose_at(time_s)
    error_m = states.position - position - rotation @ CENTROID
    error_rad = difference(states.rotation, rotation)
    assert np.linalg.norm(error_m, axis=1).max() < limit_mm / 1e3
    assert np.linalg.norm(error_rad, axis=1).max() < limit_deg * DEG
    errors = np.concatenate([error_m, error_rad], axis=1)
    assert np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariance), errors).mean() < 15


def test_late_samples_and_measurements_count() -> None:
    """Within the lag the order of arrival does not matter."""
    observations = measurements()
    observations = observations.select(observations.time_s < UNTIL_S)
    stop = int(np.searchsorted(SAMPLES.end_s, UNTIL_S + DELAY_S))
    # Ten samples before the newest knots come after all others but the last measurement, another measurement last of all.
    gone = slice(stop - 150, stop - 140)
    live = Live()
    live.measure(observations.select(slice(None, -9)))
    live.window.add_samples(SAMPLES.select(slice(live._sampled, gone.start)))
    live.window.add_samples(SAMPLES.select(slice(gone.stop, stop)))
    live._sampled = stop
    live.measure(observations.select(slice(-8, -1)))
    live.window.add_samples(SAMPLES.select(gone))
    live.measure(observations.select(slice(-1, None)))
    live.window.update(observations.select(slice(-9, -8)))
    in_order = tracked().window
    at_s = observations.time_s[-1:] - 0.05
    expected, covariance = in_order.trajectory().at(at_s)
    sigmas = np.sqrt(np.diag(covariance[0]))
    found, _ = live.window.trajectory().at(at_s)
    error = np.concatenate(
        [found.position - expected.position, difference(found.rotation, expected.rotation)], axis=1
    )
    assert np.abs(error / sigmas).max() < 0.1


def test_outage_is_bridged_and_tracked_on() -> None:
    """Two seconds without measurements: predictions by the IMU alone, and no new search after."""
    observations = measurements()
    live = Live()
    live.measure(observations.select(observations.time_s < 5.0))
    live.sample_until(7.0)
    live.window.marginalise_before(7.0 - LAG_S)
    state, covariance = live.window.predict(7.0)
    position, rotation = DRIVE.pose_at(np.array([7.0]))
    error_m = state.position - position - rotation @ CENTROID
    assert np.linalg.norm(error_m) < 0.06
    assert np.linalg.norm(error_m) < 3 * np.sqrt(np.trace(covariance[0, :3, :3]))
    live.measure(observations.select((observations.time_s > 7.0) & (observations.time_s < 8.0)))
    assert live.window.reliable_from_s < 2.0
    assert np.diff(live.window.trajectory().inside.knots.time_s).max() < 0.51


def test_backlog_and_an_outage_at_once() -> None:
    """A station delivers measurements from within the window together with one after a gap: a knot for each, in order."""
    observations = measurements()
    live = Live()
    early = observations.time_s < 4.0
    held_back = early & (observations.time_s > 3.0) & (observations.station == 1)
    live.measure(observations.select(early & ~held_back))
    live.sample_until(5.6)
    later = (observations.time_s > 5.0) & (observations.time_s < 5.2)
    assert later.any()
    live.window.update(observations.select(held_back | later))
    assert live.window.converged
    knots_s = live.window.trajectory().inside.knots.time_s
    steps_s = np.diff(knots_s)
    assert 0.005 < steps_s.min() <= steps_s.max() < 0.51
    for time_s in observations.time_s[held_back | later]:
        assert np.abs(knots_s - time_s).min() <= 0.0101


@pytest.mark.slow
@pytest.mark.parametrize("stations", [3, 2])
def test_measurement_after_an_outage_is_confirmed_by_another_prism(stations: int) -> None:
    """A wrong one would have agreed as well."""
    observations = measurements(stations)
    live = Live()
    live.measure(observations.select(observations.time_s < 5.0))
    assert not live.window.ambiguous
    later = np.flatnonzero(observations.time_s > 9.0)
    first = later[observations.prism[later] == 0][:3]
    for row in first:
        live.measure(observations.select(slice(row, row + 1)))
        # Smoothed states in the outage rest on it, too.
        assert live.window.ambiguous_from_s <= 5.0
        assert live.window.ambiguous
    row = int(np.flatnonzero((observations.prism == 1) & (np.arange(len(observations)) > first[-1]))[0])
    live.measure(observations.select(slice(row, row + 1)))
    assert live.window.converged
    assert not live.window.ambiguous


@pytest.mark.slow
def test_measurement_after_an_outage_is_unproven_beside_a_backlog() -> None:
    """It comes together with what another station measured before the outage."""
    observations = measurements()
    live = Live()
    live.measure(observations.select(observations.time_s < 5.0))
    before = np.flatnonzero((observations.time_s > 5.0) & (observations.prism == 1))[0]
    first = np.flatnonzero((observations.time_s > 9.0) & (observations.prism == 0))[0]
    together = observations.select(np.array([before, first]))
    live.sample_until(together.time_s[1] + DELAY_S)
    live.window.update(together)
    assert live.window.converged
    assert live.window.ambiguous
    assert live.window.ambiguous_from_s < together.time_s[0]


@pytest.mark.slow
def test_trajectory_lost_in_a_backlog_is_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements from before an outage end it, those after it arrived with them, and the first search fails."""
    observations = measurements()
    live = Live()
    live.measure(observations.select(observations.time_s < 5.0))
    before = np.flatnonzero((observations.time_s > 5.0) & (observations.time_s < 5.5))[:2]
    after = np.flatnonzero(observations.time_s > 6.6)
    together = observations.select(np.append(before, after[0]))
    live.sample_until(together.time_s[-1] + DELAY_S)

    def fail(*_: object) -> None:
        raise GeometryError("not determined")

    with monkeypatch.context() as failing:
        failing.setattr(live.window, "_update_tracked", lambda *_: False)
        failing.setattr(live.window._search, "find", fail)
        live.window.update(together)
    live.measure(observations.select(after[1:]))
    assert live.window.converged


@pytest.mark.slow
def test_start_from_one_of_two_prisms_is_confirmed_by_the_other() -> None:
    """It may be the wrong one, however often it agrees with itself; until then no smoothed pose is reliable either."""
    observations = measurements(2)
    alone = np.flatnonzero((observations.station == 0) & (observations.time_s < UNTIL_S))
    live = Live()
    for row in alone:
        live.measure(observations.select(slice(row, row + 1)))
    assert live.window.converged
    assert live.window.ambiguous
    assert live.window.observations is not None
    assert live.window.ambiguous_from_s < live.window.observations.time_s[0]
    later = np.flatnonzero((observations.station == 1) & (observations.time_s > UNTIL_S))
    live.measure(observations.select(later[:2]))
    assert live.window.converged
    assert not live.window.ambiguous


@pytest.mark.slow
def test_no_start_from_one_prism_where_two_are_needed() -> None:
    """The second one ends the wait once it has been measured twice."""
    observations = measurements(2)
    second = np.flatnonzero((observations.station == 1) & (observations.time_s > 5.0))
    alone = np.flatnonzero(observations.station == 0)
    live = Live(min_prisms=2)
    rows = np.sort(np.concatenate([alone, second]))
    last_s = float(observations.time_s[second[1]])
    found = []
    for row in rows[observations.time_s[rows] < UNTIL_S]:
        live.measure(observations.select(slice(row, row + 1)))
        found.append((float(observations.time_s[row]), live.window.converged))
    assert not any(converged for time_s, converged in found if time_s < last_s)
    assert found[-1][1]


@pytest.mark.slow
def test_no_wrong_start_after_a_tripod_has_tilted() -> None:
    """Two prisms agree with a wrong rotation, but the gyro carries the right one on."""
    observations = measurements(2)
    moved = (observations.station == 0) & (observations.time_s > 4.0)
    points = observations.points_m + moved[:, None] * np.array([0.0, 0.0, 0.03])
    observations = replace(observations, points_m=points)
    live = Live()
    live.measure(observations.select(observations.time_s < 4.0))
    assert live.window.initialised
    later = np.flatnonzero(observations.time_s > 4.0)
    contradicted = False
    for row in later:
        live.measure(observations.select(slice(row, row + 1)))
        time_s = float(observations.time_s[row])
        if not live.window.converged or live.window.ambiguous:
            contradicted = True
            continue
        state, covariance = live.window.trajectory().at(np.array([time_s]), dim=6)
        error = difference(state.rotation, DRIVE.pose_at(np.array([time_s]))[1])[0]
        assert error @ np.linalg.solve(covariance[0, 3:, 3:], error) < 30.0
    assert contradicted


@pytest.mark.slow
@pytest.mark.parametrize("up_m", [0.0, 0.06])
def test_rotation_is_known_after_an_outage_that_loses_the_trajectory(
    up_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One tripod has risen meanwhile; the samples of the outage have been forgotten."""
    monkeypatch.setattr(fixed_lag, "MAX_OUTAGE_S", 1.0)
    monkeypatch.setattr(fixed_lag, "SEARCH_S", 0.5)
    observations = measurements(2)
    raised = (observations.station == 0) & (observations.time_s > 4.0)
    points = observations.points_m + raised[:, None] * np.array([0.0, 0.0, up_m])
    observations = replace(observations, points_m=points)
    live = Live()
    live.measure(observations.select(observations.time_s < 4.0))
    for now_s in np.arange(4.0, 8.5, 0.05).tolist():
        live.sample_until(now_s)
        live.window.marginalise_before(now_s - LAG_S)
    assert not live.window.initialised
    for row in np.flatnonzero(observations.time_s > 8.5):
        live.measure(observations.select(slice(row, row + 1)))
    assert live.window.converged == (up_m == 0.0)


@pytest.mark.slow
def test_start_that_fails_after_the_window_has_moved_on() -> None:
    """Every sixth measurement of the only prism is wrong: no start, and no error though the search reaches back further."""
    observations = measurements(1)
    points = observations.points_m.copy()
    points[::6] += 1.0
    live = Live()
    live.measure(replace(observations, points_m=points))
    assert not live.window.converged
    assert live.window.observations is not None
    assert len(live.window.residuals_m) == len(live.window.observations)


@pytest.mark.slow
def test_no_start_when_all_of_the_window_is_wrong() -> None:
    """After an outage the only measurement is of a wrong prism: what came before it tells a trajectory, but none till now."""
    observations = measurements()
    before = observations.select(observations.time_s < 4.0)
    live = Live()
    live.window.update(before)  # without samples there is no start yet
    live.window.marginalise_before(5.0)
    live.sample_until(6.0)
    row = int(np.searchsorted(observations.time_s, 5.5))
    wrong = observations.select(slice(row, row + 1))
    live.window.update(replace(wrong, points_m=wrong.points_m + 1.0))
    converged = [live.window.converged]
    live.measure(observations.select(slice(row + 1, None)))
    converged.append(live.window.converged)
    assert converged == [False, True]
    state, _ = live.window.predict(7.0)
    position, rotation = DRIVE.pose_at(np.array([7.0]))
    assert np.linalg.norm(state.position - position - rotation @ CENTROID) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 4, 6])
def test_heading_of_one_prism_gets_lost_while_the_robot_stands(seed: int) -> None:
    """The bias of a cheap gyro turns it by tens of degrees, and nothing tells that: its sigma grows beyond what is valid, 5 degrees."""
    imu = imu_parameters("consumer")
    drive = standing_from(DRIVE, 5.0, until_s=30.0)
    samples = drive.samples(imu, seed=seed)
    observations = drive.measure(stations=1, seed=seed)
    observations = replace(observations, layout=observations.layout - CENTROID)
    live = Live(imu=imu)
    sigmas_rad = []
    for row in range(len(observations)):
        some = observations.select(slice(row, row + 1))
        live.measure(some, samples)
        if not live.window.converged or some.time_s[0] < 7.0:
            continue
        state, covariance = live.window.trajectory().at(some.time_s, dim=6)
        error = difference(state.rotation, drive.pose_at(some.time_s)[1])[0]
        sigmas_rad.append(float(np.sqrt(np.linalg.eigvalsh(covariance[0, 3:, 3:])[-1])))
        nees = error @ np.linalg.solve(covariance[0, 3:, 3:], error)
        assert nees < 25.0 or sigmas_rad[-1] > 5 * DEG
    assert len(sigmas_rad) > 50
    assert sigmas_rad[-1] > 5 * DEG


@pytest.mark.slow
def test_standing_tells_nothing_of_the_rotation_about_the_line_of_both_prisms() -> None:
    """It rests on what is assumed of the accelerometer's bias; that one prism is lost for a while does not change that."""
    imu = imu_parameters("consumer")
    drive = standing_from(DRIVE, 0.5, until_s=15.0)
    samples, observations = drive.samples(imu, seed=4), drive.measure(stations=2, seed=4)
    observations = replace(observations, layout=observations.layout[:2] - CENTROID)
    time_s = observations.time_s
    live, sigmas_rad = Live(imu=imu), []
    for some in (
        observations.select(time_s < 8.0),
        observations.select((time_s > 8.0) & ((observations.prism == 0) | (time_s > 13.0))),
    ):
        live.measure(some, samples)
        _, covariance = live.window.trajectory().at(some.time_s[-1:], dim=6)
        sigmas_rad.append(float(np.sqrt(np.linalg.eigvalsh(covariance[0, 3:, 3:])[-1])))
    assert sigmas_rad[1] > 0.93 * sigmas_rad[0] > 8e-3


def test_window_does_not_grow() -> None:
    """Numbers of measurements, knots and samples are bounded."""
    window = tracked().window
    assert window.observations is not None
    assert len(window.observations) == len(window.residuals_m) < 1.5 * LAG_S * 7.5
    assert len(window._held.imu) < 1.5 * LAG_S * 200
    assert window.horizon_s <= UNTIL_S + DELAY_S - LAG_S


def test_gyro_alone() -> None:
    """Without the accelerometer three stations still give poses; predictions rest on the motion prior."""
    observations = measurements()
    live = Live(gyro_only=True)
    live.measure(observations.select(observations.time_s < 5.0))
    time_s = np.arange(2.5, 4.5, 0.1)
    states, _ = live.window.trajectory().at(time_s)
    position, rotation = DRIVE.pose_at(time_s)
    assert np.linalg.norm(states.position - position - rotation @ CENTROID, axis=1).max() < 0.008
    assert np.linalg.norm(difference(states.rotation, rotation), axis=1).max() < 0.2 * DEG
    now_s = observations.time_s[observations.time_s < 5.0][-1] + DELAY_S
    state, covariance = live.window.predict(now_s)
    position, rotation = DRIVE.pose_at(np.array([now_s]))
    error_m = np.linalg.norm(state.position - position - rotation @ CENTROID)
    assert error_m < 3 * np.sqrt(np.trace(covariance[0, :3, :3]))
    assert np.linalg.norm(difference(state.rotation, rotation)) < 0.3 * DEG


def test_common_covariance_equals_that_of_a_displaced_setup() -> None:
    """One station stands 0.4 mm elsewhere: poses move by what the common covariance says, smoothed and predicted."""
    observations = measurements(2)
    observations = observations.select(observations.time_s < 5.0)
    shift = np.array([0.0003, -0.0002, 0.0001])

    def by_setup(some: Observations, linearised: LinearisedMeasurements) -> FloatArray:
        found: FloatArray = -(linearised.by_point @ shift)[:, :, None] * (some.station == 1)[:, None, None]
        return found

    frames = observations.frames.copy()
    frames[1, :3, 3] += shift
    live, moved = Live(setup_jacobian=by_setup), Live()
    live.measure(observations)
    moved.measure(replace(observations, frames=frames))
    newest_s = float(observations.time_s[-1])
    for time_s in (newest_s - 1.03, newest_s - 0.1, newest_s + 0.3, newest_s + DELAY_S + 0.1):
        (expected, _), (found, _) = moved.window.predict(time_s), live.window.predict(time_s)
        common = live.window.common_at(time_s)
        assert common is not None
        error = np.concatenate(
            [expected.position - found.position, difference(expected.rotation, found.rotation)], axis=1
        )
        scale = np.sqrt(np.diag(common[0]))
        np.testing.assert_allclose(np.abs(error[0]), scale, rtol=0.05, atol=0.05 * scale.max())
        of_trajectory = live.window.trajectory().common_at(np.array([time_s]))
        assert of_trajectory is not None
        np.testing.assert_allclose(of_trajectory, common, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_silent_imu_does_not_break_the_window() -> None:
    """Samples stop while measurements go on beyond the lag: poses become uncertain, and good again with the samples."""
    observations = measurements()
    live = Live()
    live.measure(observations.select(observations.time_s < 4.0))
    for row in np.flatnonzero((observations.time_s > 4.0) & (observations.time_s < 8.5)).tolist():
        now_s = float(observations.time_s[row]) + DELAY_S
        live.window.update(observations.select(slice(row, row + 1)))
        live.window.marginalise_before(now_s - LAG_S)
        if live.window.initialised:
            assert np.isfinite(live.window.predict(now_s)[1]).all()
    reasons = [live.window.health]
    live._sampled = int(np.searchsorted(SAMPLES.end_s, 8.9))
    live.measure(observations.select(observations.time_s > 8.9))
    reasons.append(live.window.health)
    assert reasons[0] is not None
    assert reasons[1] is None
    state, _ = live.window.predict(10.9)
    position, rotation = DRIVE.pose_at(np.array([10.9]))
    assert live.window.converged
    assert np.linalg.norm(state.position - position - rotation @ CENTROID) < 0.02


def test_time_before_the_first_knot() -> None:
    """Nothing is known there: no error, and a covariance that says so."""
    trajectory = tracked().window.trajectory()
    first_s = float(trajectory.inside.knots.time_s[0])
    states, covariance = trajectory.at(np.array([first_s - 0.5, first_s + 0.5]))
    assert states.time_s[0] == first_s - 0.5
    assert (np.diag(covariance[0]) >= 1e4).all()
    assert (np.diag(covariance[1]) < 1.0).all()


def test_time_before_a_single_knot() -> None:
    """The first measurements after an outage that is longer than the lag leave one knot, at which they all are."""
    live, observations = Live(), measurements()
    live.measure(observations.select(observations.time_s < 4.0))
    row = int(np.searchsorted(observations.time_s, 7.5))
    first = observations.select(slice(row, row + 1))
    live.sample_until(first.time_s[0] + DELAY_S)
    live.window.update(first)
    live.window.marginalise_before(float(first.time_s[0]))
    live.window.update(replace(first, time_s=first.time_s + 0.001))
    trajectory = live.window.trajectory()
    assert len(trajectory.inside.knots.time_s) == 1
    knot_s = float(trajectory.inside.knots.time_s[0])
    states, covariance = trajectory.at(np.array([knot_s - 0.5, knot_s]))
    assert states.time_s[0] == knot_s - 0.5
    assert (np.diag(covariance[0]) >= 1e4).all()
    assert (np.diag(covariance[1]) < 1.0).all()


@pytest.mark.parametrize("step", ["_update_tracked", "_initialise", "_eliminate_before"])
def test_matrix_that_cannot_be_factorised_loses_the_trajectory(
    step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And not the program: the next measurements find it again."""
    live, observations = Live(), measurements()
    live.measure(observations.select(observations.time_s < 3.0))
    converged = [live.window.converged]

    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    with monkeypatch.context() as failing:
        failing.setattr(live.window, step, fail)
        if step == "_initialise":
            failing.setattr(live.window, "_update_tracked", lambda *_: False)
        first = int(np.searchsorted(observations.time_s, 3.0))
        live.measure(observations.select(slice(first, first + 1)))
        converged.append(live.window.converged)
    live.measure(observations.select((observations.time_s < 6.0) & (np.arange(len(observations)) > first)))
    converged.append(live.window.converged)
    assert converged == [True, False, True]


@pytest.mark.parametrize("missing", [True, False])
def test_innovations_are_no_evidence_where_missing_samples_lose_the_rotation(*, missing: bool) -> None:
    """Measurements of an outage's end that come together are far from a linear prediction, though no station has moved."""
    observations = measurements()
    samples = SAMPLES.select((SAMPLES.end_s < 5.2) | (SAMPLES.end_s > 6.5)) if missing else SAMPLES
    live = Live()
    live.measure(observations.select(observations.time_s < 5.0), samples)
    together = observations.select((observations.time_s > 7.2) & (observations.time_s < 8.2))
    together.points_m[-2] += 2.0
    live.sample_until(8.5, samples)
    live.window.update(together)
    assert live.window.converged
    assert live.window.ambiguous
    assert live.window.beyond_chance is not missing


@pytest.mark.slow
def test_innovations_are_no_evidence_after_an_outage_that_leaves_the_position_uncertain() -> None:
    """The position is uncertain by metres and the rotation by 30 mrad: the prediction of what comes together is not linear."""
    imu, drive = imu_parameters("consumer"), inertial_drive(28.0, seed=7)
    samples, observations = drive.samples(imu, seed=7), drive.measure(stations=2, seed=7)
    observations = replace(observations, layout=observations.layout[:2] - CENTROID)
    time_s, is_second = observations.time_s, observations.prism == 1
    live = Live(imu=imu)
    live.measure(
        observations.select((time_s < 3.0) | ((time_s > 11.0) & (time_s < 12.0) & is_second)), samples
    )
    live.sample_until(26.0, samples)
    live.window.marginalise_before(23.0)
    live.window.update(observations.select((time_s > 24.0) & (time_s < 26.0) & is_second))
    assert live.window.converged
    assert live.window.ambiguous
    assert not live.window.beyond_chance
