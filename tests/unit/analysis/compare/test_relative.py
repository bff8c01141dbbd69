"""Errors of motions against evo, against a literal translation of KITTI's program, and against simulated references."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.drives.paired import drive, noisy, paired

from tsgt.analysis.compare.relative import drift, explained_motion, relative

if TYPE_CHECKING:
    from pathlib import Path

TRUE = drive(6000, 10.0, speed_mps=2.0)
RANDOM = np.random.default_rng(3)
ESTIMATED = noisy(TRUE, RANDOM, position_m=0.02, rotation_rad=0.004)
ESTIMATED[:, :3, 3] *= 1.01


@pytest.fixture
def evo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import the metrics of evo, which writes its settings to the home folder when it is first imported."""
    monkeypatch.setenv("HOME", str(tmp_path))
    return pytest.importorskip("evo.core.metrics")


def test_relative_errors_agree_with_evo(evo: Any) -> None:
    """Over distances, with both kinds of pairs, and over times, where a second is ten poses; to 1e-9."""
    trajectory = pytest.importorskip("evo.core.trajectory").PoseTrajectory3D
    units = pytest.importorskip("evo.core.units").Unit
    count = 600
    stamps = np.arange(count) / 10.0
    data = tuple(
        trajectory(poses_se3=list(poses), timestamps=stamps) for poses in (TRUE[:count], ESTIMATED[:count])
    )
    found = relative(paired(ESTIMATED[:count], TRUE[:count]))
    assert {(each.delta, each.unit, each.pairs) for each in found} >= {
        (1.0, "m", "all"),
        (10.0, "m", "consecutive"),
        (10.0, "s", "all"),
    }
    for each in found:
        if (each.delta, each.pairs) not in {(10.0, "consecutive"), (100.0, "all"), (10.0, "all")}:
            continue  # those of evaluation are tested there
        delta, unit = (each.delta, units.meters) if each.unit == "m" else (int(10 * each.delta), units.frames)
        for relation, figure in (
            (evo.PoseRelation.translation_part, each.judged.errors.position_mm.rms / 1e3),
            (evo.PoseRelation.rotation_angle_deg, each.judged.errors.orientation_deg.rms),
        ):
            metric = evo.RPE(relation, delta=delta, delta_unit=unit, all_pairs=each.pairs == "all")
            metric.process_data(data)
            assert figure == pytest.approx(metric.get_statistic(evo.StatisticsType.rmse), abs=1e-9)


def kitti(true: np.ndarray, found: np.ndarray) -> dict[float, tuple[float, float, int]]:
    """Compute errors as evaluate_odometry.cpp does, line by line: mean translation and rotation error by length, and number."""
    distance = [0.0]
    for i in range(1, len(true)):
        distance.append(distance[-1] + math.dist(true[i - 1][:3, 3], true[i][:3, 3]))
    errors: dict[float, list[tuple[float, float]]] = {}
    for first in range(0, len(true), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next((i for i in range(first, len(true)) if distance[i] > distance[first] + length), -1)
            if last == -1:
                continue
            gt_delta = np.linalg.inv(true[first]) @ true[last]
            result_delta = np.linalg.inv(found[first]) @ found[last]
            error = np.linalg.inv(result_delta) @ gt_delta
            cosine = max(min(0.5 * (np.trace(error[:3, :3]) - 1.0), 1.0), -1.0)
            errors.setdefault(length, []).append(
                (float(np.linalg.norm(error[:3, 3])) / length, math.acos(cosine) / length)
            )
    return {
        key: (float(np.mean([t for t, _ in each])), float(np.mean([r for _, r in each])), len(each))
        for key, each in errors.items()
    }


def test_segments_are_those_of_kitti() -> None:
    """At 10 Hz the starts, the ends and the errors agree."""
    every = slice(None, None, 5)  # keeps the literal loop fast
    true, estimated = TRUE[every], ESTIMATED[every]
    expected = kitti(true, estimated)
    found = drift(paired(estimated, true, rate_hz=10.0))
    assert not found.shortened
    assert [each.length_m for each in found.segments] == list(expected) == [100.0 * n for n in range(1, 9)]
    for each in found.segments:
        position, rotation, count = expected[each.length_m]
        assert each.n == count
        assert each.position_percent == pytest.approx(100 * position, rel=1e-9)
        assert each.orientation_deg_per_m == pytest.approx(math.degrees(rotation), rel=1e-6)
    weights = [each.n for each in found.segments]
    mean = np.average([each.position_percent for each in found.segments], weights=weights)
    assert found.position_mm_per_m == pytest.approx(10 * mean)


def test_short_path_has_shorter_segments() -> None:
    """Of 95 m, 10 m to 80 m; it is said."""
    found = drift(paired(ESTIMATED[:525], TRUE[:525]))
    assert found.shortened
    assert [each.length_m for each in found.segments] == [10.0 * n for n in range(1, 9)]


def test_drift_of_a_wrong_scale() -> None:
    """One percent of a straight line is 10 mm per metre."""
    true = np.broadcast_to(np.eye(4), (2000, 4, 4)).copy()
    true[:, 0, 3] = 0.2 * np.arange(2000)
    estimated = true.copy()
    estimated[:, 0, 3] *= 1.01
    found = drift(paired(estimated, true))
    assert found.position_mm_per_m == pytest.approx(10.0, rel=0.01)
    assert found.orientation_deg_per_m == 0.0
    assert {each.length_m for each in found.curve} == {1, 2, 5, 10, 20, 50, 100, 200}


def test_reference_explains_the_error_of_motions() -> None:
    """An exact estimate against a reference with white noise: over 20 m the rotation of the first pose dominates."""
    reference = noisy(TRUE, np.random.default_rng(8), position_m=0.003, rotation_rad=0.001)
    covariance = np.diag([0.003] * 3 + [0.001] * 3) ** 2
    pairs = paired(TRUE[:2000], reference[:2000], covariance=covariance)
    for each in relative(pairs):
        if each.judged.errors.n > 500:
            explained = each.judged.explained
            assert each.judged.errors.position_mm.rms == pytest.approx(explained.position_rms_mm, rel=0.1)
            assert each.judged.errors.orientation_deg.rms == pytest.approx(
                explained.orientation_rms_deg, rel=0.1
            )


def test_correlation_of_position_and_rotation_counts() -> None:
    """Errors of a turn about a point 5 m ahead do not move that point."""
    lever = np.array([5.0, 0.0, 0.0])
    true = np.broadcast_to(np.eye(4), (2, 4, 4)).copy()
    true[1, :3, 3] = lever
    random = np.random.default_rng(2).normal(scale=0.001, size=(20_000, 3))
    # The first pose errs by a turn about the end of the motion, the second not at all.
    shift = -np.cross(random, lever)
    errors = np.concatenate([shift, random], axis=1)
    pairs = paired(true, true, covariance=np.zeros((6, 6)))
    covariance = np.stack([np.cov(errors.T), np.zeros((6, 6))])
    pairs = dataclasses.replace(pairs, reference_covariance=covariance)
    assert explained_motion(pairs, np.array([[0, 1]])).position_rms_mm < 1e-3


def test_common_part_cancels() -> None:
    """An error that all poses share does not change a motion."""
    covariance = np.diag([0.003] * 3 + [0.001] * 3) ** 2
    pairs = paired(TRUE, TRUE, covariance=covariance, common=covariance)
    assert explained_motion(pairs, np.array([[0, 100]])).position_rms_mm == 0.0


def test_too_few_poses_have_no_segments() -> None:
    """Drift is unknown."""
    for count in (0, 1, 20):
        found = drift(paired(ESTIMATED[:count], TRUE[:count]))
        assert found.segments == ()
        assert math.isnan(found.position_mm_per_m)


def test_rotation_of_the_reference_does_not_show_in_positions() -> None:
    """The motion of positions alone is compared in the axes of the reference on both sides."""
    covariance = np.diag([0.003] * 3 + [0.01] * 3) ** 2
    reference = noisy(TRUE, np.random.default_rng(8), position_m=0.003, rotation_rad=0.01)
    estimated = reference.copy()
    estimated[:, :3, 3] = TRUE[:, :3, 3]
    pairs = paired(estimated[:2000], reference[:2000], covariance=covariance, has_orientation=False)
    (over_10_s,) = (each for each in relative(pairs) if (each.delta, each.unit) == (10.0, "s"))
    assert over_10_s.judged.explained.position_rms_mm == pytest.approx(3.0 * math.sqrt(6.0))
    assert over_10_s.judged.errors.position_mm.rms == pytest.approx(3.0 * math.sqrt(6.0), rel=0.05)
