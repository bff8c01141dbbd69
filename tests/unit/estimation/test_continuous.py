"""The estimator ``continuous``, live: schedule, poses, and reasons of invalid ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.drives.scene import SECOND, START, Scene, at_rest, driving, stationary_scene, with_origin

from tsgt.errors import DegenerateGeometryError
from tsgt.estimation import Kind, PoseBatch, Reason
from tsgt.estimation.continuous import ContinuousEstimator
from tsgt.geometry import exp_so3, log_so3, rotation_from_quaternion
from tsgt.model import PolarMeasurement, PrismPosition, ReferencePoint, Status
from tsgt.recording import encode_line

PERIOD = 50_000_000
LAG = 3 * SECOND


@pytest.fixture
def scene() -> Scene:
    """Three stations and a robot that drives a bend."""
    return stationary_scene().moving(driving).with_limits(estimator="continuous")


def every(
    scene: Scene,
    until_s: float,
    *,
    step_s: float = 0.4,
    stations: tuple[int, ...] = (1, 2, 3),
    from_s: float = 0.0,
) -> list[PolarMeasurement]:
    """Return measurements of the stations in turn, each at an interval."""
    return [
        replace(scene.measure(station, time_s + 0.1 * station), sequence=number)
        for number, time_s in enumerate(np.arange(from_s, until_s, step_s).tolist())
        for station in stations
    ]


def stream(scene: Scene, measurements: list[PolarMeasurement], until_s: float) -> tuple[PoseBatch, PoseBatch]:
    """Predicted and smoothed poses of a live run."""
    estimator = ContinuousEstimator(scene.parameters)
    batches = []
    for measurement in sorted(measurements, key=lambda m: m.received_ns):
        batches.append(estimator.advance(measurement.received_ns))
        estimator.add(measurement)
    batches.append(estimator.advance(START + round(until_s * SECOND)))
    return of_kind(batches, Kind.PREDICTED), of_kind(batches, Kind.SMOOTHED)


def of_kind(batches: list[PoseBatch], kind: Kind) -> PoseBatch:
    """Return the poses of one kind."""
    return PoseBatch.concatenated(batches).select(PoseBatch.concatenated(batches).kind == kind)


def off(scene: Scene, poses: PoseBatch) -> tuple[float, float]:
    """How far valid poses are off at worst, in m and rad."""
    poses = poses.select(poses.valid)
    truth = [scene.motion((stamp - START) / SECOND) for stamp in poses.stamp_ns.tolist()]
    turned = rotation_from_quaternion(poses.orientation_xyzw) @ np.array([r.T for r, _ in truth])
    return (
        float(np.abs(poses.position_m - [p for _, p in truth]).max()),
        float(np.linalg.norm(log_so3(turned), axis=1).max()),
    )


def test_each_epoch_has_a_predicted_and_a_smoothed_pose(scene: Scene) -> None:
    """Exactly one of each; the prediction at its epoch, the other a lag later."""
    predicted, smoothed = stream(scene, every(scene, 8.0), 8.0)
    first = START + 200_000_000 + PERIOD
    assert predicted.stamp_ns.tolist() == list(range(first, START + 8 * SECOND + 1, PERIOD))
    assert smoothed.stamp_ns.tolist() == list(range(first, START + 5 * SECOND + 1, PERIOD))


def delayed_of(batch: PoseBatch, delay_s: float) -> PoseBatch:
    """Return the poses of one delay."""
    return batch.select(batch.delay_ns == round(delay_s * SECOND))


def with_delays(
    scene: Scene, delays_s: tuple[float, ...], measurements: list[PolarMeasurement], until_s: float
) -> tuple[PoseBatch, PoseBatch]:
    """Predicted and smoothed poses of a live run with delays."""
    delays_ns = tuple(round(each * SECOND) for each in delays_s)
    return stream(scene.with_limits(smoothed_delays_ns=delays_ns), measurements, until_s)


@pytest.mark.slow
def test_poses_at_delays_leave_the_others_as_they_are(scene: Scene) -> None:
    """Predicted and final poses have the same bits, whatever delays there are."""
    measurements = every(scene, 8.0)
    expected = stream(scene, measurements, 8.0)
    predicted, smoothed = with_delays(scene, (0.4, 1.0), measurements, 8.0)
    for found, plain in ((predicted, expected[0]), (delayed_of(smoothed, 0.0), expected[1])):
        assert [encode_line(a) for a in found.records()] == [encode_line(a) for a in plain.records()]


@pytest.mark.parametrize(("delay_s", "epochs"), [(1.0, 20), (0.97, 20), (0.33, 7)])
def test_pose_at_a_delay_is_that_of_its_epoch(scene: Scene, delay_s: float, epochs: int) -> None:
    """Sent at the first epoch at which the delay has passed, and better than the prediction of its epoch."""
    predicted, smoothed = with_delays(scene, (delay_s,), every(scene, 8.0), 8.0)
    delayed = delayed_of(smoothed, delay_s)
    assert delayed.stamp_ns.tolist() == predicted.stamp_ns[:-epochs].tolist()
    late = delayed.valid & (delayed.stamp_ns > START + 2 * SECOND)
    assert late.any()
    assert off(scene, delayed.select(late))[0] < 0.01
    sigmas = [np.trace(each.covariance[60:100], axis1=1, axis2=2).mean() for each in (predicted, delayed)]
    assert sigmas[1] < 0.5 * sigmas[0]


def test_pose_without_later_measurements_is_not_called_smoothed(scene: Scene) -> None:
    """In an outage a pose at a delay has no numbers: it would be a prediction."""
    measurements = every(scene, 6.0)
    newest_ns = max(m.stamp_ns for m in measurements)
    _, smoothed = with_delays(scene, (0.2, 1.0), measurements, 8.0)
    for delay_s, reasons in ((0.2, {Reason.UNCERTAIN, Reason.OUTAGE}), (1.0, {Reason.OUTAGE})):
        delayed = delayed_of(smoothed, delay_s)
        after = delayed.stamp_ns > newest_ns
        assert after.sum() > 15
        assert set(delayed.reason[after].tolist()) == reasons
        assert np.isnan(delayed.position_m[after]).all()
        before = ~after & (delayed.stamp_ns > newest_ns - SECOND // 4)
        assert np.isfinite(delayed.position_m[before]).all()


def test_prism_is_not_missing_before_its_next_measurement_can_be_late(scene: Scene) -> None:
    """At a delay shorter than the interval of measurements its last one is still within the outage limit."""
    _, smoothed = with_delays(scene, (0.2,), every(scene, 6.0), 6.0)
    delayed = delayed_of(smoothed, 0.2)
    late = delayed.select(delayed.stamp_ns > START + 2 * SECOND)
    assert (late.prism_reason == Reason.VALID).all()


@pytest.mark.slow
def test_measurement_that_is_later_than_the_delay_changes_the_final_pose(scene: Scene) -> None:
    """And not the pose that was sent before it arrived."""
    measurements = every(scene, 9.0)
    gap = [m for m in measurements if m.station == 2 and 4 * SECOND < m.stamp_ns - START < 5 * SECOND]
    rest = [m for m in measurements if m not in gap]
    late = [replace(m, received_ns=m.received_ns + 2 * SECOND) for m in gap]
    without, filled = (with_delays(scene, (1.0,), some, 9.0)[1] for some in (rest, [*rest, *late]))
    there = (START + 4.4 * SECOND, START + 4.9 * SECOND)
    for delay_s, changes in ((1.0, False), (0.0, True)):
        a, b = (delayed_of(each, delay_s) for each in (without, filled))
        rows = (a.stamp_ns > there[0]) & (a.stamp_ns < there[1])
        assert rows.sum() == 9
        assert np.array_equal(a.covariance[rows], b.covariance[rows]) != changes


def test_poses_at_delays_before_the_initialisation_are_invalid(scene: Scene) -> None:
    """Two measurements of each prism allow a mirrored robot."""
    measurements = every(scene, 6.0)
    _, smoothed = with_delays(scene, (0.4,), measurements, 6.0)
    twice_ns = max([m.stamp_ns for m in measurements if m.prism == prism][1] for prism in (1, 2, 3))
    delayed = delayed_of(smoothed, 0.4)
    assert delayed.valid.any()
    assert delayed.stamp_ns[delayed.valid].min() >= twice_ns


def test_poses_follow_the_robot(scene: Scene) -> None:
    """Exact measurements of a steady bend give poses as exact as the prior allows."""
    predicted, smoothed = stream(scene, every(scene, 10.0), 10.0)
    late = predicted.stamp_ns > START + 4 * SECOND
    assert predicted.valid[late].all()
    assert off(scene, predicted.select(late))[0] < 0.02
    late = smoothed.stamp_ns > START + SECOND
    assert smoothed.valid[late].all()
    assert off(scene, smoothed.select(late)) < (0.001, 0.001)


@pytest.mark.slow
def test_origin_of_the_layout_does_not_matter(scene: Scene) -> None:
    """With the origin metres off the prisms, the poses are those of another point of the robot."""
    arm = np.array([-3.0, 1.0, -1.5])
    measurements = every(scene, 8.0)
    far = replace(scene, parameters=with_origin(scene.parameters, arm))
    for here, there in zip(stream(scene, measurements, 8.0), stream(far, measurements, 8.0), strict=True):
        np.testing.assert_array_equal(there.reason, here.reason)
        spoke = rotation_from_quaternion(here.orientation_xyzw[here.valid]) @ arm
        np.testing.assert_allclose(
            there.position_m[here.valid], here.position_m[here.valid] + spoke, atol=1e-6
        )
        np.testing.assert_allclose(there.orientation_xyzw, here.orientation_xyzw, atol=1e-7)


def test_predictions_use_earlier_measurements_only(scene: Scene) -> None:
    """A measurement changes later predictions, and smoothed poses that are not computed yet."""
    measurements = every(scene, 6.0)
    wrong = [
        replace(m, slope_distance_m=(m.slope_distance_m or 0) + 0.03) if i == 30 else m
        for i, m in enumerate(measurements)
    ]
    arrived = sorted(wrong, key=lambda m: m.received_ns).index(wrong[30])
    received_ns = sorted(wrong, key=lambda m: m.received_ns)[arrived].received_ns
    right, other = stream(scene, measurements, 6.0)[0], stream(scene, wrong, 6.0)[0]
    same = np.all(right.position_m == other.position_m, axis=1) | np.isnan(right.position_m[:, 0])
    before = right.stamp_ns <= received_ns
    assert same[before].all()
    assert not same[~before].any()


@pytest.mark.slow
def test_late_measurement_within_the_lag_is_used(scene: Scene) -> None:
    """It fills its gap two seconds later."""
    measurements = every(scene, 9.0)
    gap = [m for m in measurements if m.station == 2 and 4 * SECOND < m.stamp_ns - START < 5 * SECOND]
    rest = [m for m in measurements if m not in gap]
    late = [replace(m, received_ns=m.received_ns + 2 * SECOND) for m in gap]
    without, filled = stream(scene, rest, 9.0)[1], stream(scene, [*rest, *late], 9.0)[1]
    there = (without.stamp_ns > START + 4.4 * SECOND) & (without.stamp_ns < START + 4.9 * SECOND)
    variance = [np.trace(poses.covariance[there], axis1=1, axis2=2).mean() for poses in (without, filled)]
    assert variance[1] < 0.5 * variance[0]


def test_measurements_outside_the_lag_window_are_counted(scene: Scene) -> None:
    """By station; they change nothing."""
    estimator = ContinuousEstimator(scene.parameters)
    for measurement in every(scene, 8.0):
        estimator.advance(measurement.received_ns)
        estimator.add(measurement)
    estimator.add(replace(scene.measure(3, 1.05), received_ns=START + 8 * SECOND))
    estimator.advance(START + 9 * SECOND)
    assert estimator.outside_lag_window == {3: 1}


def test_old_backlog_is_outside_the_lag_window(scene: Scene) -> None:
    """An hour of backlog makes no window of an hour."""
    measurements = every(scene, 8.0)
    old = [
        replace(m, stamp_ns=m.stamp_ns - 3600 * SECOND, sequence=m.sequence + 10_000)
        for m in measurements[:6]
    ]
    estimator = ContinuousEstimator(scene.parameters)
    for measurement in (*old, *measurements):
        estimator.add(measurement)
        estimator.advance(measurement.received_ns)
    assert sum(estimator.outside_lag_window.values()) == len(old)
    assert estimator.advance(START + 8 * SECOND).valid.all()


@pytest.mark.parametrize("before_ns", [9_000_000, 10_000_000, 11_000_000])
@pytest.mark.parametrize("begun_s", [0.0, 0.082, 0.123, 1.0])
def test_measurement_just_before_the_first_is_used(scene: Scene, before_ns: int, begun_s: float) -> None:
    """Also within the rounding of shared knots."""
    measurements = every(scene, 4.0)
    first_s = (measurements[0].stamp_ns - START - before_ns) / SECOND
    late = scene.measure(2, first_s, delay_s=1.9)
    estimator = ContinuousEstimator(scene.parameters)
    estimator.begin_at(START - round(begun_s * SECOND))
    for measurement in sorted([*measurements, late], key=lambda m: m.received_ns):
        estimator.advance(measurement.received_ns)
        estimator.add(measurement)
    assert estimator.advance(START + 4 * SECOND).valid.all()


def test_zero_distance_is_an_outlier(scene: Scene) -> None:
    """A raw distance that the prism constant makes zero."""
    stations = tuple(replace(station, prism_constant_m=-0.03) for station in scene.parameters.stations)
    scene = replace(scene, parameters=replace(scene.parameters, stations=stations))
    measurements = every(scene, 6.0)
    measurements[30] = replace(measurements[30], slope_distance_m=0.03)
    predicted, smoothed = stream(scene, measurements, 6.0)
    assert predicted.valid[-20:].all()
    assert smoothed.valid[-20:].all()


def test_repeated_measurement_counts_once(scene: Scene) -> None:
    """Repeated measurement counts once."""
    measurements = every(scene, 6.0)
    again = [replace(m, received_ns=m.received_ns + 200_000_000) for m in measurements]
    once, twice = stream(scene, measurements, 6.0), stream(scene, [*measurements, *again], 6.0)
    np.testing.assert_array_equal(once[1].covariance, twice[1].covariance)


def test_missing_prism_is_an_outage(scene: Scene) -> None:
    """It is named; no numbers are computed."""
    predicted, _ = stream(scene, every(scene, 3.0, stations=(1, 2)), 3.0)
    assert set(predicted.reason.tolist()) == {Reason.OUTAGE}
    assert predicted.prism_reason[-1].tolist() == [Reason.VALID, Reason.VALID, Reason.OUTAGE]
    assert np.isnan(predicted.position_m).all()


def test_poses_stay_valid_without_one_prism_until_uncertain(scene: Scene) -> None:
    """The silent station is reported at once."""
    measurements = [*every(scene, 6.0), *every(scene, 20.0, stations=(1, 2), from_s=6.0)]
    predicted, _ = stream(scene, measurements, 20.0)
    after = predicted.select(predicted.stamp_ns > START + 6 * SECOND)
    missing = after.prism_reason[:, 2] == Reason.OUTAGE
    assert missing[25:].all()
    assert (after.valid & missing).any()
    assert after.reason[-1] == Reason.OUTAGE
    spread = np.trace(after.covariance[:, 3:, 3:], axis1=1, axis2=2)[after.valid]
    assert spread[-1] > 3 * spread[0]


def test_error_of_a_station_is_the_reason(scene: Scene) -> None:
    """Error of a station is the reason."""
    errors = [scene.measure(3, 6.0 + i, status=Status.TILT) for i in range(15)]
    measurements = [*every(scene, 6.0), *every(scene, 20.0, stations=(1, 2), from_s=6.0), *errors]
    predicted, _ = stream(scene, measurements, 20.0)
    assert predicted.reason[-1] == Reason.STATION_STATUS


def test_predictions_end_without_measurements(scene: Scene) -> None:
    """They become uncertain, then invalid, then have no numbers."""
    predicted, smoothed = stream(scene, every(scene, 6.0), 30.0)
    assert predicted.valid[predicted.stamp_ns == START + 6 * SECOND + 2 * PERIOD]
    assert predicted.reason[-1] == Reason.OUTAGE
    assert np.isnan(predicted.position_m[-1]).all()
    assert smoothed.reason[-1] == Reason.OUTAGE


@pytest.mark.parametrize("name", ["position_sigma_limit_m", "rotation_sigma_limit_rad"])
def test_tight_limit_makes_poses_uncertain(scene: Scene, name: str) -> None:
    """With all prisms measured; predicted poses have limits of their own."""
    measurements = every(scene, 8.0)
    predicted, smoothed = stream(scene.with_limits(**{f"predicted_{name}": 0.001}), measurements, 8.0)
    assert Reason.UNCERTAIN in predicted.reason[-8:]
    assert smoothed.valid[-20:].all()
    predicted, smoothed = stream(scene.with_limits(**{name: 0.001}), measurements, 8.0)
    assert predicted.valid[-8:].all()
    assert Reason.UNCERTAIN in smoothed.reason[-8:]


@pytest.mark.slow
def test_position_limit_is_judged_at_the_reference_point(scene: Scene) -> None:
    """The uncertain rotation swings a point on a long lever arm about."""
    far = replace(
        scene,
        parameters=replace(
            scene.parameters, reference_point=ReferencePoint(name="mast", position_m=(0.0, 0.0, 60.0))
        ),
    )
    near, _ = stream(scene, every(scene, 8.0), 8.0)
    predicted, smoothed = stream(far, every(scene, 8.0), 8.0)
    assert near.valid[-8:].all()
    assert not predicted.valid.any()
    assert set(smoothed.reason[-20:].tolist()) == {Reason.UNCERTAIN}


@pytest.mark.slow
def test_wrong_layout_is_the_reason(scene: Scene) -> None:
    """Wrong layout is the reason."""
    wrong = tuple(
        PrismPosition(
            prism=p.prism, position_m=(1.5 * p.position_m[0], 1.5 * p.position_m[1], p.position_m[2])
        )
        for p in scene.parameters.prisms
    )
    other = replace(scene, parameters=replace(scene.parameters, prisms=wrong))
    predicted, smoothed = stream(other, every(scene, 8.0), 8.0)
    assert not predicted.valid.any()
    assert smoothed.reason[-1] == Reason.RESIDUAL


def test_robot_upside_down_is_invalid() -> None:
    """A mirrored layout, or swapped prisms."""
    _, position = at_rest(0.0)
    scene = stationary_scene().with_limits(estimator="continuous")
    scene = scene.moving(lambda _: (exp_so3(np.array([3.0, 0.0, 0.0])), position))
    _, smoothed = stream(scene, every(scene, 8.0), 8.0)
    assert smoothed.reason[-1] == Reason.TILT


@pytest.mark.slow
def test_noise_scale_is_applied(scene: Scene) -> None:
    """Twice the noise makes smoothed poses less certain."""
    plain = stream(scene, every(scene, 8.0), 8.0)[1]
    scaled = scene.with_limits(noise_scale=3.0)
    noisy = stream(scaled, every(scaled, 8.0), 8.0)[1]
    assert np.trace(noisy.covariance[-1]) > 3 * np.trace(plain.covariance[-1])


def test_deadline_is_the_next_epoch(scene: Scene) -> None:
    """None before the first measurement."""
    estimator = ContinuousEstimator(scene.parameters)
    assert estimator.next_deadline_ns() is None
    estimator.begin_at(START + 1)
    estimator.add(scene.measure(1, 0.0))
    assert estimator.next_deadline_ns() == START + PERIOD
    assert len(estimator.advance(START + PERIOD - 1)) == 0
    assert len(estimator.advance(START + PERIOD)) == 1


def test_collinear_layout_is_rejected(scene: Scene) -> None:
    """Collinear layout is rejected."""
    line = tuple(PrismPosition(prism=p, position_m=(float(p), 0.0, 0.0)) for p in (1, 2, 3))
    with pytest.raises(DegenerateGeometryError):
        ContinuousEstimator(replace(scene.parameters, prisms=line))


@pytest.mark.slow
def test_memory_is_bounded(scene: Scene) -> None:
    """After a minute it holds no more than after ten seconds."""
    estimator = ContinuousEstimator(scene.parameters)
    sizes = []
    for measurement in [*every(scene, 30.0), *(scene.measure(3, 30.0, status=Status.TILT),)]:
        estimator.advance(measurement.received_ns)
        estimator.add(measurement)
        sizes.append(len(estimator._history.times_ns))
    assert max(sizes[75:]) <= max(sizes[:75])


def test_poses_before_the_initialisation_are_invalid(scene: Scene) -> None:
    """Two measurements of each prism allow a mirrored robot."""
    measurements = every(scene, 8.0)
    _, smoothed = stream(scene, measurements, 8.0)
    twice_ns = max([m.stamp_ns for m in measurements if m.prism == prism][1] for prism in (1, 2, 3))
    assert smoothed.stamp_ns[smoothed.valid].min() >= twice_ns
    known = np.isfinite(smoothed.position_m[:, 0]) & (smoothed.stamp_ns < twice_ns)
    assert known.any()
    assert (smoothed.reason[known] != Reason.VALID).all()


@pytest.mark.parametrize(
    ("wrong_m", "station", "sequence"), [(-0.12, 3, 5), (0.13, 2, 6), (0.05, 3, 5), (0.07, 1, 5)]
)
def test_smoothed_pose_near_an_accepted_outlier_is_invalid(
    scene: Scene, wrong_m: float, station: int, sequence: int
) -> None:
    """A reflection near the robot passes the gate; the next innovations are inconsistent."""
    measured = []
    for each in every(scene, 10.0, step_s=0.83):
        later = scene.measure(each.station, 0.83 * each.sequence + 0.27 * each.station)
        distance_m = later.slope_distance_m
        assert distance_m is not None
        if (each.station, each.sequence) == (station, sequence):
            distance_m += wrong_m
        measured.append(replace(later, sequence=each.sequence, slope_distance_m=distance_m))
    _, smoothed = stream(scene, measured, 10.0)
    assert smoothed.valid.mean() > 0.3
    assert off(scene, smoothed)[0] < 0.01
