"""Errors of streamed poses: by age, against limits and covariance, and as read from a recording."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.records import HEADER, PARAMETERS, POSE, measurement
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation import LivePoseErrors, LivePoses, read_streamed_poses
from tsgt.geometry import transform_from
from tsgt.model import ROBOT_ORIGIN, ReferencePoint
from tsgt.recording import StationShare, encode_line

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.recording import PoseRecord

COVARIANCE = np.diag([1e-4, 4e-4, 9e-4, 1e-6, 4e-6, 9e-6])
CENTROID_M = np.array([0.0, 0.0, 2.0])
PERIOD_NS = 50_000_000


def errors_of(offsets: np.ndarray, age_s: np.ndarray) -> LivePoseErrors:
    """Errors of poses that are off by position and rotation vector in the axes of the world, (N, 6)."""
    rng = np.random.default_rng(1)
    true = transform_from(
        Rotation.random(len(offsets), rng=1).as_matrix(), rng.normal(size=(len(offsets), 3))
    )
    turns = Rotation.from_rotvec(offsets[:, 3:]).as_matrix()
    estimated = transform_from(turns @ true[:, :3, :3], true[:, :3, 3] + offsets[:, :3])
    covariances = np.tile(COVARIANCE, (len(offsets), 1, 1))
    return LivePoseErrors.of(estimated, covariances, age_s, true, CENTROID_M)


def test_errors_are_normalised_by_their_own_covariance() -> None:
    """Consistent errors have NEES 6, and 0.27 % of positions and of rotations are beyond three sigmas."""
    offsets = np.random.default_rng(2).normal(size=(40_000, 6)) * np.sqrt(np.diag(COVARIANCE))
    found = errors_of(offsets, np.full(len(offsets), 0.25)).statistics(0.05, 0.01)
    assert found.nees.mean == pytest.approx(6.0, abs=0.1)
    assert found.beyond_3_sigma.position == pytest.approx(0.0027, abs=0.001)
    assert found.beyond_3_sigma.rotation == pytest.approx(0.0027, abs=0.001)
    norms = np.linalg.norm(offsets[:, :3], axis=1)
    assert found.position_rms_mm == pytest.approx(1e3 * np.sqrt(np.mean(norms**2)))
    assert found.position_p95_mm == pytest.approx(1e3 * np.quantile(norms, 0.95))
    assert found.beyond_limits.position == pytest.approx(np.mean(norms > 0.05))
    assert found.beyond_limits.rotation == pytest.approx(
        np.mean(np.linalg.norm(offsets[:, 3:], axis=1) > 0.01)
    )


def test_rotation_error_moves_the_centroid() -> None:
    """By its lever arm, whatever the attitude; the reference point is unaffected."""
    found = errors_of(np.array([[0, 0, 0, 0.001, 0, 0]] * 50), np.zeros(50)).statistics(None, None)
    assert found.position_rms_mm == pytest.approx(0.0, abs=1e-9)
    assert 0.5 < found.centroid.position_rms_mm < 2.0
    assert np.isnan(found.beyond_limits.position)


def test_bins_are_by_age() -> None:
    """Empty ones are left out; an unknown age is in none."""
    offsets = np.zeros((4, 6))
    offsets[:, 0] = 0.001, 0.003, 0.01, 0.02
    found = errors_of(offsets, np.array([0.31, 0.39, 3.1, np.nan])).statistics(0.1, 0.1)
    assert found.compared == 4
    assert [(each.from_ms, each.to_ms, each.compared) for each in found.by_age] == [
        (300, 400, 2),
        (3000, 3250, 1),
    ]
    assert found.by_age[0].position_rms_mm == pytest.approx(np.sqrt(5.0))


def test_no_valid_pose_is_a_result() -> None:
    """Nothing is divided by zero."""
    keys = LivePoses(7, 0, np.empty(0), errors_of(np.empty((0, 6)), np.empty(0)).statistics(0.1, 0.1)).keys()
    assert (keys["poses"], keys["valid_fraction"], keys["compared"]) == (7, 0.0, 0)
    assert np.isnan(keys["position_rms_mm"])
    assert np.isnan(keys["age_ms"]["p50"])


def stream(path: Path) -> None:
    """Write a recording: a measurement, predictions each period, and smoothed poses before every second one."""
    first = measurement(0)
    lines: list[object] = [HEADER, PARAMETERS, first]
    shares = tuple(
        StationShare(id=number, prism=number, age_s=age_s, residual_m=None, reason="")
        for number, age_s in ((1, 0.4), (2, 0.25), (3, None))
    )
    for number in range(1, 5):
        stamp_ns = first.received_ns + number * PERIOD_NS
        predicted = replace(
            POSE, stamp_ns=stamp_ns, kind="predicted", estimator="continuous", stations=shares
        )
        if number % 2 == 0:
            lines.append(replace(predicted, stamp_ns=stamp_ns - 3_000_000_000, kind="smoothed"))
        lines.append(replace(predicted, valid=number != 3, reason="" if number != 3 else "outage"))
    path.write_bytes(b"".join(encode_line(line) + b"\n" for line in lines))


def test_ages_follow_from_the_order_of_the_stream(tmp_path: Path) -> None:
    """Of the newest measurement of a prediction; of a smoothed pose when it was sent."""
    stream(tmp_path / "r.jsonl")
    found = read_streamed_poses(tmp_path / "r.jsonl", ROBOT_ORIGIN)
    assert {kind: (each.poses, len(each.stamp_ns)) for kind, each in found.items()} == {
        "predicted": (4, 3),
        "smoothed": (2, 2),
    }
    np.testing.assert_allclose(found["predicted"].age_s, 0.25)
    np.testing.assert_allclose(found["smoothed"].age_s, 3.0)


def test_poses_at_a_delay_are_a_series_of_their_own(tmp_path: Path) -> None:
    """Their errors are not mixed with those of the final poses."""
    path = tmp_path / "r.jsonl"
    stream(path)
    stamp_ns = measurement(0).received_ns + 5 * PERIOD_NS
    predicted = replace(POSE, stamp_ns=stamp_ns, kind="predicted", estimator="continuous")
    delayed = replace(predicted, stamp_ns=stamp_ns - 600_000_000, kind="smoothed", delay_s=0.6)
    path.write_bytes(path.read_bytes() + b"".join(encode_line(each) + b"\n" for each in (delayed, predicted)))
    found = read_streamed_poses(path, ROBOT_ORIGIN)
    assert {series: each.poses for series, each in found.items()} == {
        "predicted": 5,
        "smoothed": 2,
        "smoothed_0.6s": 1,
    }
    np.testing.assert_allclose(found["smoothed_0.6s"].age_s, 0.6)


def test_poses_are_those_of_the_point(tmp_path: Path) -> None:
    """They were recorded at the robot's origin."""
    stream(tmp_path / "r.jsonl")
    mast = ReferencePoint(name="mast", position_m=(0.0, 0.0, 2.0))
    found = read_streamed_poses(tmp_path / "r.jsonl", mast)["smoothed"]
    assert POSE.position_m is not None
    np.testing.assert_allclose(found.position_m, [np.array(POSE.position_m) + np.array([0.0, 0.0, 2.0])] * 2)
    assert found.covariance[0, 0, 0] > 1e-6


def test_recording_without_poses_has_none(tmp_path: Path) -> None:
    """As an import has."""
    lines: list[PoseRecord | object] = [HEADER, PARAMETERS, measurement(0)]
    (tmp_path / "r.jsonl").write_bytes(b"".join(encode_line(line) + b"\n" for line in lines))
    assert read_streamed_poses(tmp_path / "r.jsonl", ROBOT_ORIGIN) == {}


def test_poses_before_a_replaced_set_up_are_left_out(tmp_path: Path) -> None:
    """They are in other frames; those of a run that was joined are kept."""
    path = tmp_path / "r.jsonl"
    stream(path)
    run = path.read_bytes()
    moved = replace(PARAMETERS, stations=PARAMETERS.stations[::-1])
    replaced, joined = encode_line(moved) + b"\n", b"".join(run.splitlines(keepends=True)[3:])
    path.write_bytes(run + replaced + joined)
    assert read_streamed_poses(path, ROBOT_ORIGIN)["predicted"].poses == 4
    path.write_bytes(run + run)
    assert read_streamed_poses(path, ROBOT_ORIGIN)["predicted"].poses == 8
