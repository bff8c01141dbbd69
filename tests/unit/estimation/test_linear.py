"""The estimator ``linear``: schedule, poses, and reasons of invalid ones."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import LAYOUT, SECOND, START, at_rest, driving, stationary_scene

from tsgt.errors import DegenerateGeometryError
from tsgt.estimation import LinearEstimator, PoseBatch, Reason
from tsgt.geometry import exp_so3, log_so3, rotation_from_quaternion
from tsgt.model import TRACKING_NOISE, InstrumentNoise, PrismPosition, Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harness.drives.scene import Motion, Scene
    from numpy.typing import NDArray

    from tsgt.model import PolarMeasurement

    Vector = NDArray[np.float64]


@pytest.fixture
def scene() -> Scene:
    """Three stations and a standing robot."""
    return stationary_scene()


def poses_of(scene: Scene, measurements: Sequence[PolarMeasurement], until_s: float) -> PoseBatch:
    """Return all poses that are decided at an instant in s after the start, with all measurements added at once."""
    estimator = LinearEstimator(scene.parameters)
    for measurement in measurements:
        estimator.add(measurement)
    return estimator.advance(START + round(until_s * SECOND))


def every(
    scene: Scene, times_s: list[float], stations: tuple[int, ...] = (1, 2, 3)
) -> list[PolarMeasurement]:
    """Measurements of several stations at the same instants."""
    return [scene.measure(station, time_s) for time_s in times_s for station in stations]


def test_stationary_robot_has_an_exact_pose(scene: Scene) -> None:
    """At every epoch between the first and the last measurement."""
    poses = poses_of(scene, every(scene, [0.0, 0.4]), until_s=0.4)
    rotation, position = at_rest(0.0)
    assert poses.valid.tolist() == [False] + [True] * 8  # nothing brackets the very first instant
    np.testing.assert_allclose(poses.position_m[1:], np.broadcast_to(position, (8, 3)), atol=1e-9)
    quaternion = poses.orientation_xyzw[1]
    assert 2 * np.arccos(quaternion[3]) == pytest.approx(np.linalg.norm([0.02, -0.01, 0.6]), abs=1e-9)
    np.testing.assert_allclose(poses.residual_m[1:], 0.0, atol=1e-9)
    assert np.trace(rotation) == pytest.approx(1 + 2 * np.cos(2 * np.arccos(quaternion[3])))


def test_velocity_frames_are_as_documented(scene: Scene) -> None:
    """Velocity in the world frame, angular velocity in the robot frame."""
    moving = scene.moving(driving)
    poses = poses_of(moving, every(moving, [-0.1, 0.1]), until_s=0.1)
    at_zero = poses.stamp_ns.tolist().index(START)
    np.testing.assert_allclose(poses.velocity_mps[at_zero], [0.3, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(poses.angular_velocity_radps[at_zero], [0.0, 0.0, 0.3], atol=1e-3)


def test_epochs_are_whole_multiples_of_the_period(scene: Scene) -> None:
    """Whatever the time of the first measurement."""
    poses = poses_of(scene, every(scene, [0.013, 0.413]), until_s=1.0)
    assert poses.stamp_ns[0] == START + 50_000_000
    assert (poses.stamp_ns % 50_000_000 == 0).all()


def test_pose_waits_for_the_last_station(scene: Scene) -> None:
    """It is due with that station's measurement."""
    estimator = LinearEstimator(scene.parameters)
    for measurement in [*every(scene, [0.0]), *every(scene, [0.4], stations=(1, 2))]:
        estimator.add(measurement)
    assert len(estimator.advance(START + SECOND // 2)) == 1  # the first epoch, which nothing precedes
    estimator.add(scene.measure(3, 0.25))
    assert estimator.advance(START + SECOND // 2).stamp_ns[-1] == START + SECOND // 4
    estimator.add(scene.measure(3, 0.4))
    assert estimator.advance(START + SECOND // 2).valid.tolist() == [True] * 3


def test_pose_waits_for_a_retransmission(scene: Scene) -> None:
    """A gap in the sequence numbers is not interpolated while the missing one may arrive."""
    estimator = LinearEstimator(scene.parameters)
    for measurement in every(scene, [0.0, 0.4, 0.8], stations=(1, 2)):
        estimator.add(replace(measurement, sequence=round((measurement.stamp_ns - START) / (0.4 * SECOND))))
    estimator.add(scene.measure(3, 0.0))
    estimator.add(replace(scene.measure(3, 0.8), sequence=2))
    assert len(estimator.advance(START + SECOND)) == 1
    assert estimator.next_deadline_ns() == START + round(2.8 * SECOND) + 1
    estimator.add(replace(scene.measure(3, 0.4), sequence=1))
    assert len(estimator.advance(START + SECOND)) == 16


@pytest.mark.parametrize(("gap_s", "valid"), [(1.0, True), (1.000000001, False)])
def test_interval_beyond_the_outage_limit_is_invalid(scene: Scene, gap_s: float, valid: bool) -> None:  # noqa: FBT001
    """The limit itself is valid."""
    measurements = [*every(scene, [0.0, 0.5, 1.0, 1.5], stations=(1, 2))]
    measurements += [scene.measure(3, 0.0), scene.measure(3, gap_s), scene.measure(3, 1.5)]
    poses = poses_of(scene, measurements, until_s=1.5)
    in_gap = (poses.stamp_ns > START) & (poses.stamp_ns < START + SECOND)
    assert (poses.valid[in_gap] == valid).all()
    assert {Reason(r).word for r in poses.reason[in_gap]} == ({""} if valid else {"outage"})
    assert poses.valid[poses.stamp_ns > START + 1.05 * SECOND].all()


def test_silent_station_is_an_outage_at_the_deadline(scene: Scene) -> None:
    """At the announced instant."""
    estimator = LinearEstimator(scene.parameters)
    for measurement in [*every(scene, [0.0]), *every(scene, [0.5, 1.0, 1.5, 2.0], stations=(1, 2))]:
        estimator.add(measurement)
    estimator.advance(START + 2 * SECOND)
    deadline = estimator.next_deadline_ns()
    assert deadline == START + 3 * SECOND + 1  # last seen + outage limit + transport limit
    assert len(estimator.advance(deadline - 1)) == 0
    given_up = estimator.advance(deadline)
    assert given_up.stamp_ns[-1] == START + SECOND
    assert (given_up.reason == Reason.OUTAGE).all()
    (record, *_) = given_up.records()
    assert [(share.id, share.reason) for share in record.stations] == [(1, ""), (2, ""), (3, "outage")]
    assert record.position_m is None


def test_station_without_measurements_keeps_poses_invalid(scene: Scene) -> None:
    """It is named, with no age."""
    poses = poses_of(scene, every(scene, [0.0, 0.4, 0.8], stations=(1, 2)), until_s=3.0)
    assert not poses.valid.any()
    missing = list(poses.records())[-1].stations[2]
    assert (missing.id, missing.age_s, missing.reason) == (3, None, "outage")


def test_error_status_is_the_reason(scene: Scene) -> None:
    """The measurement is not used."""
    measurements = every(scene, [0.0, 0.4, 0.8, 1.2, 1.6], stations=(1, 2))
    measurements += [scene.measure(3, 0.0), scene.measure(3, 0.4, status=Status.TILT), scene.measure(3, 1.59)]
    poses = poses_of(scene, measurements, until_s=1.6)
    words = [Reason(r).word for r in poses.reason]
    assert words == ["outage"] + ["outage"] * 7 + ["station_status"] * 24


def test_low_accuracy_is_used(scene: Scene) -> None:
    """It is normal in motion."""
    measurements = [replace(m, status=Status.LOW_ACCURACY) for m in every(scene, [0.0, 0.4])]
    assert poses_of(scene, measurements, until_s=0.4).valid[1:].all()


def test_zero_distance_is_not_usable(scene: Scene) -> None:
    """Whatever the status."""
    measurements = [
        replace(m, slope_distance_m=0.0) if m.station == 2 else m for m in every(scene, [0.0, 0.4])
    ]
    assert not poses_of(scene, measurements, until_s=3.0).valid.any()


def test_swapped_prisms_have_a_residual(scene: Scene) -> None:
    """Swapped prisms have a residual."""
    swap = {1: 2, 2: 1, 3: 3}
    measurements = [
        replace(scene.measure(s, t, prism=swap[s]), prism=s) for t in (0.0, 0.4) for s in (1, 2, 3)
    ]
    assert poses_of(scene, measurements, until_s=0.4).invalid_counts() == {"residual": 8, "outage": 1}


def test_coincident_prisms_are_degenerate(scene: Scene) -> None:
    """Coincident prisms are degenerate."""
    measurements = [replace(scene.measure(s, t, prism=1), prism=s) for t in (0.0, 0.4) for s in (1, 2, 3)]
    assert poses_of(scene, measurements, until_s=0.4).invalid_counts() == {
        "degenerate_geometry": 8,
        "outage": 1,
    }


def test_mirrored_layout_exceeds_the_tilt_limit(scene: Scene) -> None:
    """It fits without a residual, but upside down."""
    mirrored = tuple(
        PrismPosition(prism=i + 1, position_m=(x, -y, z)) for i, (x, y, z) in enumerate(LAYOUT.tolist())
    )
    turned = replace(scene, parameters=replace(scene.parameters, prisms=mirrored))
    poses = poses_of(turned, every(turned, [0.0, 0.4]), until_s=0.4)
    assert poses.invalid_counts() == {"tilt": 8, "outage": 1}
    assert poses.residual_m[1] < 1e-9


def test_degenerate_layout_is_rejected(scene: Scene) -> None:
    """Degenerate layout is rejected."""
    together = tuple(PrismPosition(prism=i, position_m=(0.0, 0.0, float(i // 3))) for i in (1, 2, 3))
    with pytest.raises(DegenerateGeometryError, match="prisms 1 and 2"):
        LinearEstimator(replace(scene.parameters, prisms=together))


def test_latency_is_subtracted_from_the_stamp(scene: Scene) -> None:
    """Latency is subtracted from the stamp."""
    moving = scene.moving(driving)
    exact = poses_of(moving, every(moving, [0.0, 0.4]), until_s=0.5)
    stations = tuple(replace(s, latency_ns=70_000_000 * s.station) for s in scene.parameters.stations)
    late = replace(moving, parameters=replace(scene.parameters, stations=stations))
    np.testing.assert_array_equal(
        poses_of(late, every(late, [0.0, 0.4]), until_s=0.5).position_m, exact.position_m
    )


def test_repeated_measurement_changes_nothing(scene: Scene) -> None:
    """Repeated measurement changes nothing."""
    measurements = every(scene, [0.0, 0.4])
    repeated = [m for m in measurements for _ in range(3)]
    once, again = (poses_of(scene, m, until_s=0.4) for m in (measurements, repeated))
    np.testing.assert_array_equal(once.position_m, again.position_m)


def test_unknown_stations_and_prisms_are_ignored(scene: Scene) -> None:
    """Unknown stations and prisms are ignored."""
    unknown = [replace(scene.measure(1, 0.2), station=9), replace(scene.measure(1, 0.2), prism=9)]
    assert poses_of(scene, [*every(scene, [0.0, 0.4]), *unknown], until_s=0.4).valid[1:].all()


def test_covariance_grows_between_measurements(scene: Scene) -> None:
    """The unknown acceleration counts most in the middle; here it is all of the sigma."""
    blind = scene.with_limits(acceleration_sigma_mps2=0.5, angular_acceleration_sigma_radps2=0.0)
    poses = poses_of(blind, every(blind, [0.0, 0.8]), until_s=0.8)
    sigma_m = np.sqrt(poses.covariance[1:, 0, 0])
    unseen_m = 0.5 * 0.4 * 0.4 / 2  # acceleration sigma, and both times to the measurements
    # All three prisms miss by the same vector, so the whole robot does.
    assert sigma_m[7] == pytest.approx(np.hypot(sigma_m[-1] / np.sqrt(2), unseen_m), rel=0.01)


@pytest.mark.slow
def test_covariance_is_consistent_for_an_accelerating_robot(scene: Scene) -> None:
    """Squared normalised errors of poses average to the number of their degrees of freedom.

    The robot accelerates, and turns faster and faster, as a whole and at random; stations measure at different times.
    """
    rng = np.random.default_rng(5)
    limits = {"acceleration_sigma_mps2": 0.4, "angular_acceleration_sigma_radps2": 0.2}
    centroid = LAYOUT.mean(axis=0)
    squared = []
    for _ in range(400):
        acceleration, turning = rng.normal(0.0, 0.4, 3), rng.normal(0.0, 0.2, 3)

        def motion(time_s: float, a: Vector = acceleration, alpha: Vector = turning) -> Motion:
            rotation = exp_so3(alpha * time_s**2 / 2)
            return rotation, np.array([30.0, 20.0, -1.0]) + a * time_s**2 / 2 - rotation @ centroid

        world = scene.moving(motion).with_limits(**limits)
        starts = rng.uniform(-0.4, 0.0, 3)
        measurements = [
            noisy(world.measure(station, start + step), rng)
            for station, start in zip((1, 2, 3), starts, strict=True)
            for step in (0.0, 0.4, 0.8)
        ]
        poses = poses_of(world, measurements, until_s=1.3)
        row = int(np.flatnonzero(poses.valid)[rng.integers(np.count_nonzero(poses.valid))])
        rotation, position = motion((int(poses.stamp_ns[row]) - START) / SECOND)
        found = rotation_from_quaternion(poses.orientation_xyzw[row])
        error = np.concatenate([position - poses.position_m[row], log_so3(rotation @ found.T)])
        squared.append(error @ np.linalg.solve(poses.covariance[row], error))
    # The mean of 400 sums of six squares scatters by 0.17.
    assert np.mean(squared) == pytest.approx(6.0, abs=0.6)


def noisy(measurement: PolarMeasurement, rng: np.random.Generator) -> PolarMeasurement:
    """Add the noise of the tracking mode, by the definition of its sigmas."""
    noise = TRACKING_NOISE
    distance_m = measurement.slope_distance_m or 0.0
    across_rad = np.hypot(noise.angle_sigma_rad, noise.pointing_sigma_m / distance_m)
    along_m = np.hypot(
        np.hypot(noise.range_sigma_m, noise.range_sigma_ppm * 1e-6 * distance_m), noise.pointing_sigma_m
    )
    horizontal, zenith, slope = rng.normal(size=3)
    return replace(
        measurement,
        horizontal_angle_rad=measurement.horizontal_angle_rad
        + horizontal * across_rad / np.sin(measurement.zenith_angle_rad),
        zenith_angle_rad=measurement.zenith_angle_rad + zenith * across_rad,
        slope_distance_m=distance_m + slope * along_m,
    )


def test_uncertain_stamp_counts_along_the_velocity(scene: Scene) -> None:
    """10 ms at 0.3 m/s are 3 mm."""
    moving = scene.moving(driving).with_limits(
        acceleration_sigma_mps2=0.0, angular_acceleration_sigma_radps2=0.0
    )
    sharp = every(moving, [-0.01, 0.0])
    blurred = [replace(m, stamp_sigma_ns=10_000_000) for m in sharp]
    added = poses_of(moving, blurred, 0.1).covariance[-1] - poses_of(moving, sharp, 0.1).covariance[-1]
    assert added[0, 0] > (0.3 * 0.01) ** 2 / 3
    assert added[2, 2] < 1e-9


def test_tilt_limit_is_a_parameter(scene: Scene) -> None:
    """Tilt limit is a parameter."""
    leaning = scene.moving(lambda _: (exp_so3(np.array([0.5, 0.0, 0.0])), np.array([30.0, 20.0, -1.0])))
    strict = leaning.with_limits(tilt_limit_rad=0.4)
    assert poses_of(leaning, every(leaning, [0.0, 0.4]), 0.4).valid[1:].all()
    assert poses_of(strict, every(strict, [0.0, 0.4]), 0.4).invalid_counts() == {"tilt": 8, "outage": 1}


def test_stamp_from_the_future_is_ignored(scene: Scene) -> None:
    """Poses continue."""
    wrong = scene.measure(2, 86_400.0, delay_s=-86_399.8)
    assert (
        poses_of(scene, [wrong, *every(scene, [0.0, 0.4])], until_s=0.5).valid.tolist()
        == [False] + [True] * 8
    )


def test_live_poses_start_at_the_start(scene: Scene) -> None:
    """Not at the time of a station's wrong clock."""
    estimator = LinearEstimator(scene.parameters)
    estimator.begin_at(START)
    for measurement in [scene.measure(2, -40_000_000.0, delay_s=40_000_000.0), *every(scene, [0.0, 0.4])]:
        estimator.add(measurement)
    poses = estimator.advance(START + SECOND // 2)
    assert poses.stamp_ns[0] == START - 2 * SECOND
    assert poses.valid[-8:].all()


def test_lower_station_counts_at_equal_instants(scene: Scene) -> None:
    """Whatever the order of arrival."""
    stations = (*scene.parameters.stations, replace(scene.parameters.stations[1], station=4, prism=1))
    two = replace(scene, parameters=replace(scene.parameters, stations=stations))
    other = replace(two.measure(4, 0.2), slope_distance_m=35.0)
    measurements = [*every(two, [0.0, 0.2, 0.4]), other, two.measure(4, 0.4)]
    ahead, behind = (poses_of(two, order, until_s=3.0) for order in (measurements, measurements[::-1]))
    np.testing.assert_array_equal(ahead.position_m, behind.position_m)
    assert ahead.station[4, 0] == 1


@pytest.mark.parametrize("stamp_sigma_ns", [10**17, 2**63 - 1])
def test_time_that_is_unknown_breaks_nothing(scene: Scene, stamp_sigma_ns: int) -> None:
    """A damaged recording may state any sigma."""
    measurements = every(scene.moving(driving), [0.4 * number for number in range(8)])
    measurements[10] = replace(measurements[10], stamp_sigma_ns=stamp_sigma_ns)
    assert poses_of(scene, measurements, until_s=4.0).valid.any()


def test_measurements_without_any_noise_break_nothing(scene: Scene) -> None:
    """As a configuration may state them; at whole epochs their covariance is singular."""
    exact = InstrumentNoise(range_sigma_m=0.0, range_sigma_ppm=0.0, angle_sigma_rad=0.0, pointing_sigma_m=0.0)
    stations = tuple(replace(station, noise=exact) for station in scene.parameters.stations)
    noiseless = replace(scene, parameters=replace(scene.parameters, stations=stations))
    measurements = every(noiseless, [0.0, 0.4, 0.8])
    assert len(poses_of(noiseless, measurements, until_s=2.0).valid) > 0
