"""Absolute and relative pose errors against evo, and against values computed by hand."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation.ate_rpe import (
    absolute_errors,
    pairs_by_path,
    pairs_by_time,
    relative_error_table,
    relative_errors,
)
from tsgt.geometry import transform_from

if TYPE_CHECKING:
    from pathlib import Path

RATE_HZ = 20
STEP_NS = 50_000_000


def trajectories(count: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Return estimated and true poses of a drive of 30 s that begins with a stop of 5 s."""
    random = np.random.default_rng(7)
    t = np.maximum(0.0, np.arange(count) / RATE_HZ - 5.0)
    angles = np.stack([0.3 * t, 0.05 * np.sin(t), 0.04 * np.cos(t)], axis=1)
    position_m = np.stack([5 * np.sin(0.3 * t), 5 - 5 * np.cos(0.3 * t), 0.05 * t], axis=1)
    true = transform_from(Rotation.from_euler("ZYX", angles).as_matrix(), position_m)
    turns = Rotation.from_rotvec(random.normal(scale=0.01, size=(count, 3))).as_matrix()
    noise = transform_from(turns, random.normal(scale=0.003, size=(count, 3)))
    return true @ noise, true


@pytest.fixture
def evo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import the metrics of evo, which writes its settings to the home folder when it is first imported."""
    monkeypatch.setenv("HOME", str(tmp_path))
    return pytest.importorskip("evo.core.metrics")


def of_evo(evo: Any, metric: Any, name: str) -> dict[str, float]:
    """Return all statistics of one reduction of a metric of evo on the trajectories."""
    trajectory = pytest.importorskip("evo.core.trajectory").PoseTrajectory3D
    stamps = np.arange(600) / RATE_HZ
    pair = tuple(trajectory(poses_se3=list(poses), timestamps=stamps) for poses in reversed(trajectories()))
    metric.pose_relation = evo.PoseRelation[name]
    metric.process_data(pair)
    scale = 1e3 if name == "translation_part" else 1.0
    found = {key: scale * value for key, value in metric.get_all_statistics().items() if key != "sse"}
    return {"rms": found.pop("rmse"), **found}


REDUCTIONS = {
    "translation_part": "position_mm",
    "rotation_angle_deg": "orientation_deg",
    "full_transformation": "full",
}


@pytest.mark.parametrize("name", REDUCTIONS)
def test_absolute_errors_agree_with_evo(evo: Any, name: str) -> None:
    """All statistics to 1e-9."""
    found = getattr(absolute_errors(*trajectories()), REDUCTIONS[name])
    assert dataclasses.asdict(found) == pytest.approx(of_evo(evo, evo.APE(), name), abs=1e-9)


@pytest.mark.parametrize("name", REDUCTIONS)
@pytest.mark.parametrize(("row", "unit", "delta", "all_pairs"), [
    (0, "meters", 1.0, False),
    (1, "meters", 1.0, True),
    (2, "meters", 10.0, False),
    (3, "meters", 10.0, True),
    (4, "frames", RATE_HZ, True),
])  # fmt: skip
def test_relative_errors_agree_with_evo(
    evo: Any, name: str, row: int, unit: str, delta: float, *, all_pairs: bool
) -> None:
    """All statistics to 1e-9; a second is twenty poses."""
    units = pytest.importorskip("evo.core.units").Unit
    metric = evo.RPE(delta=delta, delta_unit=units[unit], all_pairs=all_pairs)
    found = relative_error_table(*trajectories(), STEP_NS * np.arange(600))[row].errors
    theirs = of_evo(evo, metric, name)
    assert found.n == len(metric.error) > 0
    assert dataclasses.asdict(getattr(found, REDUCTIONS[name])) == pytest.approx(theirs, abs=1e-9)


def test_constant_error_has_no_relative_error() -> None:
    """A wrong frame moves all poses alike, which no difference between poses shows."""
    _, true = trajectories()
    off = transform_from(Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix(), np.array([0.3, 0.0, 0.4]))
    found = relative_errors(off @ true, true, np.array([[0, 200], [100, 599]]))
    assert found.position_mm.max == pytest.approx(0.0, abs=1e-9)
    stop = absolute_errors((off @ true)[:1], true[:1])  # at the origin the rotation moves nothing
    assert stop.position_mm.rms == pytest.approx(500.0, abs=1e-9)
    assert stop.orientation_deg.rms == pytest.approx(math.degrees(0.1), abs=1e-9)


def test_consecutive_pairs_start_where_the_last_one_ended() -> None:
    """Each spans at least the distance."""
    position_m = np.array([[x, 0.0, 0.0] for x in (0.0, 0.4, 0.9, 1.1, 1.1, 2.0, 2.2)])
    assert pairs_by_path(position_m, 1.0, all_pairs=False).tolist() == [[0, 3], [3, 6]]


def test_all_pairs_are_the_closest_within_a_tenth() -> None:
    """At a stop, where several are equally far, the first."""
    position_m = np.array([[x, 0.0, 0.0] for x in (0.0, 0.4, 0.95, 0.95, 1.2, 1.4, 3.0)])
    assert pairs_by_path(position_m, 1.0, all_pairs=True).tolist() == [[0, 2], [1, 5]]


@pytest.mark.parametrize("rate_hz", [2.0, 7.0, 9.5, 12.3, 20.0, 20.7, 200.0])
def test_pairs_by_time_at_any_rate(rate_hz: float) -> None:
    """Each pose has the closest one, but for those of the last second."""
    stamp_ns = np.round(1e9 * np.arange(400) / rate_hz).astype(np.int64)
    pairs = pairs_by_time(stamp_ns, 1.0)
    assert 400 - math.ceil(rate_hz) <= len(pairs) <= 400 - math.floor(rate_hz)
    assert np.ptp(pairs[:, 1] - pairs[:, 0]) <= 1


def test_pairs_by_time_do_not_span_a_gap() -> None:
    """Poses without one a second later have no pair."""
    stamp_ns = np.array([0, 500, 1000, 1500, 4000, 5000]) * 1_000_000
    assert pairs_by_time(stamp_ns, 1.0).tolist() == [[0, 2], [1, 3], [4, 5]]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_poses_have_no_pairs(count: int) -> None:
    """Their statistics are NaN."""
    estimated, true = (poses[:count] for poses in trajectories())
    assert math.isnan(absolute_errors(estimated[:0], true[:0]).full.rms)
    assert [each.errors.n for each in relative_error_table(estimated, true, STEP_NS * np.arange(count))] in (
        [],
        [0] * 5,
    )
