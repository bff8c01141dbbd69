from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from harness.drives.scene import LAYOUT, SECOND, START, Motion, stationary_scene, with_origin

from tsgt.analysis.evaluation import held_out_errors
from tsgt.analysis.evaluation.held_out import FOLDS
from tsgt.analysis.processing import process, with_estimator
from tsgt.analysis.smoothing import smooth_poses, smooth_recording
from tsgt.errors import RecordingError
from tsgt.estimation import Kind, Reason, build_observations
from tsgt.geometry import exp_so3, rotate, rotation_from_quaternion, skew
from tsgt.model import Status
from tsgt.recording import Recording, RecordingHeader

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.model import Matrix4, Measurement, Parameters, PolarMeasurement

PATH = Path("field.jsonl")


def wandering(time_s: float) -> Motion:
    """Return rotation and position of a robot that accelerates, brakes and rotates all the time."""
    position = (
        30 + 1.5 * np.sin(0.8 * time_s),
        20 - 1.2 * np.cos(1.1 * time_s),
        -1 + 0.05 * np.sin(1.7 * time_s),
    )
    return exp_so3(np.array([0.0, 0.0, 0.6 * np.sin(0.7 * time_s)])), np.array(position)


SCENE = stationary_scene().moving(wandering)


def recording_of(measurements: Sequence[Measurement], parameters: Parameters = SCENE.parameters) -> Recording:
    """Return a recording of measurements, in the order given."""
    return with_estimator(
        Recording(
            header=RecordingHeader(software="test", created_ns=0, source="test"),
            parameters=parameters,
            measurements=list(measurements),
            end_ns=max((m.received_ns for m in measurements), default=None),
        ),
        "continuous",
    )


def drive(seconds: float = 14.0, *, noise_m: float = 0.002) -> list[PolarMeasurement]:
    """Return measurements of three stations at 2.5 Hz, ranges with noise."""
    rng = np.random.default_rng(2)
    return [
        replace(m, slope_distance_m=m.slope_distance_m + rng.normal(scale=noise_m))  # type: ignore[operator]
        for step in range(round(seconds / 0.4))
        for m in [SCENE.measure(station, 0.4 * step + 0.11 * station) for station in (1, 2, 3)]
    ]


def test_poses_equal_those_of_the_robot() -> None:
    """Smoothed ones, from the first to the last measurement, more accurate than linear interpolation."""
    measurements = drive()
    found = smooth_recording(recording_of(measurements), path=PATH)
    poses = found.poses
    assert set(poses.kind.tolist()) == {Kind.SMOOTHED}
    assert found.motion.tuned
    first, last = measurements[0].stamp_ns, measurements[-1].stamp_ns
    assert 0 <= poses.stamp_ns[0] - first < 50_000_000
    assert 0 <= last - poses.stamp_ns[-1] < 50_000_000
    truth = np.array([wandering((stamp - START) / 1e9)[1] for stamp in poses.stamp_ns.tolist()])
    centroid = LAYOUT.mean(axis=0)
    turned = np.array([wandering((stamp - START) / 1e9)[0] for stamp in poses.stamp_ns.tolist()])
    error_m = np.linalg.norm(
        poses.position_m + _rotations(poses.orientation_xyzw) @ centroid - truth - turned @ centroid, axis=1
    )
    inner = slice(40, -40)
    assert poses.valid[inner].all()
    assert np.sqrt(np.mean(error_m[inner] ** 2)) < 0.002
    lines = process(with_estimator(recording_of(measurements), "linear"), path=PATH)
    assert lines.kind.max() == Kind.INTERPOLATED


def _rotations(orientation_xyzw: np.ndarray) -> np.ndarray:
    x, y, z, w = orientation_xyzw.T
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)


def test_process_uses_the_estimator_of_the_recording() -> None:
    """The same poses."""
    recording = recording_of(drive())
    np.testing.assert_array_equal(
        process(recording, path=PATH).position_m, smooth_recording(recording, path=PATH).poses.position_m
    )


def test_poses_of_pieces_equal_those_of_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every pose, also those between two pieces, to a hundredth of a millimetre."""
    recording = recording_of(drive(8.0))
    one = smooth_poses(recording, path=PATH, refine="off").poses
    monkeypatch.setattr("tsgt.geometry.batch.fit.KNOTS_PER_SEGMENT", 20)
    several = smooth_poses(recording, path=PATH, refine="off").poses
    np.testing.assert_array_equal(several.stamp_ns, one.stamp_ns)
    np.testing.assert_allclose(several.position_m, one.position_m, atol=1e-5)
    np.testing.assert_allclose(several.covariance, one.covariance, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(several.prism_residual_m, one.prism_residual_m, atol=1e-5)


@pytest.mark.slow
def test_order_of_arrival_does_not_matter() -> None:
    """However late a measurement arrived."""
    measurements = drive()
    late = [*measurements[:5], *measurements[6:], measurements[5]]
    a, b = (smooth_recording(recording_of(some), path=PATH).poses for some in (measurements, late))
    np.testing.assert_array_equal(a.position_m, b.position_m)


def test_too_few_measurements_keep_the_recorded_prior() -> None:
    """Two seconds do not determine the hyperparameters."""
    found = smooth_recording(recording_of(drive(2.0)), path=PATH)
    assert not found.motion.tuned
    assert found.motion.prior == SCENE.parameters.pipeline.motion


def test_occluded_prism_is_bridged_with_growing_sigma() -> None:
    """Two prisms and the motion prior suffice for a while; the pose remains valid, the prism's reason is outage."""
    measurements = [m for m in drive() if m.station != 2 or not 6.0 < (m.stamp_ns - START) / SECOND < 8.0]
    poses = smooth_recording(recording_of(measurements), path=PATH).poses
    out = poses.prism_reason[:, 1] == Reason.OUTAGE
    inside = (poses.stamp_ns > START + 6.5 * SECOND) & (poses.stamp_ns < START + 7.5 * SECOND)
    assert out[inside].all()
    assert poses.valid[inside].any()
    sigma = np.sqrt(np.trace(poses.covariance[:, :3, :3], axis1=1, axis2=2))
    assert sigma[inside].max() > 1.15 * np.median(sigma)


def test_gap_of_all_stations_has_no_valid_poses() -> None:
    """A gap of six seconds is not bridged."""
    measurements = [m for m in drive() if not 5.0 < (m.stamp_ns - START) / SECOND < 11.0]
    poses = smooth_recording(recording_of(measurements), path=PATH).poses
    middle = np.abs(poses.stamp_ns - (START + 8 * SECOND)) < SECOND
    assert not poses.valid[middle].any()
    assert poses.valid[~middle].any()


def test_outlier_does_not_affect_validity() -> None:
    """It is rejected."""
    measurements = drive()
    wrong = measurements[60]
    measurements[60] = replace(wrong, slope_distance_m=wrong.slope_distance_m + 1.0)  # type: ignore[operator]
    poses = smooth_recording(recording_of(measurements), path=PATH).poses
    near = np.abs(poses.stamp_ns - wrong.stamp_ns) < SECOND
    assert poses.valid[near].all()


def test_mirrored_layout_is_named() -> None:
    """The robot would be upside down."""
    mirrored = tuple(
        replace(p, position_m=(p.position_m[0], -p.position_m[1], p.position_m[2]))
        for p in SCENE.parameters.prisms
    )
    with pytest.raises(RecordingError, match="the prism layout is mirrored"):
        smooth_recording(recording_of(drive(), replace(SCENE.parameters, prisms=mirrored)), path=PATH)


@pytest.mark.slow
def test_layout_of_another_robot_gives_no_poses() -> None:
    """The layout residual is decimetres; the error says so."""
    other = tuple(
        replace(p, position_m=(1.5 * p.position_m[0], 1.5 * p.position_m[1], p.position_m[2]))
        for p in SCENE.parameters.prisms
    )
    with pytest.raises(RecordingError, match="another robot's layout"):
        smooth_recording(recording_of(drive(), replace(SCENE.parameters, prisms=other)), path=PATH)


def test_missing_measurements_are_rejected() -> None:
    """Of all prisms, or of one."""
    with pytest.raises(RecordingError, match="holds no measurements"):
        smooth_recording(recording_of([]), path=PATH)
    blind = [replace(m, status=Status.NO_TARGET) if m.station == 1 else m for m in drive()]
    with pytest.raises(RecordingError, match="prism 1 has no usable measurement"):
        smooth_recording(recording_of(blind), path=PATH)


@pytest.mark.slow
def test_origin_of_the_layout_does_not_matter() -> None:
    """With the origin metres away the poses and covariances are the same ones of another point."""
    arm = np.array([-3.0, 1.0, -1.5])
    near = smooth_recording(recording_of(drive()), path=PATH)
    far = smooth_recording(recording_of(drive(), with_origin(SCENE.parameters, arm)), path=PATH)
    assert far.motion.noise_scale == pytest.approx(near.motion.noise_scale, rel=1e-4)
    rotation = rotation_from_quaternion(near.poses.orientation_xyzw)
    lever_arm = rotation @ arm
    np.testing.assert_allclose(far.poses.orientation_xyzw, near.poses.orientation_xyzw, atol=1e-6)
    np.testing.assert_allclose(far.poses.position_m, near.poses.position_m + lever_arm, atol=1e-6)
    turning = np.cross(rotate(rotation, near.poses.angular_velocity_radps), lever_arm)
    np.testing.assert_allclose(far.poses.velocity_mps, near.poses.velocity_mps + turning, atol=1e-5)
    # About fixed axes an error of rotation moves the other point by its cross product with the way there.
    by_error = np.tile(np.eye(6), (len(lever_arm), 1, 1))
    by_error[:, :3, 3:] = -skew(lever_arm)
    expected = by_error @ near.poses.covariance @ np.swapaxes(by_error, 1, 2)
    np.testing.assert_allclose(far.poses.covariance, expected, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_array_equal(far.poses.reason, near.poses.reason)


@pytest.mark.slow
def test_predictions_do_not_depend_on_the_held_out_measurements() -> None:
    """Shifting a held-out measurement changes no prediction of its fold, with a set-up that is refined, including its own."""
    frame = np.array(SCENE.parameters.stations[1].T_station1_station)
    frame[2, 3] += 0.02
    second = replace(
        SCENE.parameters.stations[1], T_station1_station=cast("Matrix4", tuple(map(tuple, frame.tolist())))
    )
    stations = (SCENE.parameters.stations[0], second, SCENE.parameters.stations[2])
    wrong = replace(SCENE.parameters, stations=stations)
    assert smooth_recording(recording_of(drive(), wrong), path=PATH).parameters.stations[1] != second
    observations, _ = build_observations(wrong, drive(), origin_ns=START)
    found = held_out_errors(observations, wrong)
    assert found["linear"].statistics.n == found["continuous"].statistics.n == 3 * 25
    assert found["continuous"].statistics.mean < 0.5 * found["linear"].statistics.mean
    points = observations.points_m.copy()
    points[np.flatnonzero(observations.prism == 0)[FOLDS]] += 0.02
    moved = held_out_errors(replace(observations, points_m=points), wrong)
    # It is the first of fold 0 of its prism, which leaves five out.
    assert moved["continuous"].error_m[0] > 0.015
    np.testing.assert_array_equal(moved["continuous"].error_m[1:5], found["continuous"].error_m[1:5])
    assert (moved["continuous"].error_m[5:] != found["continuous"].error_m[5:]).any()
