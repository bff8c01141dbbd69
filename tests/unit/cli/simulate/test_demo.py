"""Memory of the demonstration's progress, and scenarios whose daemons cannot start."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.records import POSE

from tsgt.analysis.evaluation import PoseErrors, pose_errors
from tsgt.cli.simulate.demo_progress import Progress
from tsgt.clock import SystemClock, UnixTimeline
from tsgt.config import ScenarioConfig
from tsgt.errors import StreamError
from tsgt.geometry import quaternion_from_rotation, rotation_from_quaternion, transform_from
from tsgt.recording import StatusRecord, encode_line
from tsgt.simulation.demo import Demo, write_demo_files

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from harness.files.cli import Tsgt
    from numpy.typing import NDArray

PERIOD_NS = 50_000_000
POSES = 1000
MOST_BYTES = 120
"""Of a pose that has been compared with the truth."""


@pytest.fixture
def demo(tmp_path: Path) -> Demo:
    """Return a demonstration that does not run."""
    scenario = ScenarioConfig()
    files = write_demo_files(tmp_path, scenario, tmp_path / "poses.sock")
    return Demo(scenario, files, duration_s=60.0, seed=0, clock=SystemClock())


@pytest.fixture
def timeline() -> UnixTimeline:
    """Return the timeline of this computer."""
    return UnixTimeline.fixed_now(SystemClock())


@pytest.mark.usefixtures("capsys")
def test_best_series_is_one_that_has_poses(demo: Demo, timeline: UnixTimeline) -> None:
    """A short demonstration ends before the first smoothed pose."""
    progress = Progress(demo, timeline)
    assert progress.best == "interpolated"
    line = next(_lines(_estimated(demo), timeline.unix_ns(demo.start_ns)))
    assert b'"kind":"smoothed"' in line
    progress.line(line.replace(b'"kind":"smoothed"', b'"kind":"predicted"'))
    assert progress.best == "predicted"
    progress.line(line)
    assert progress.best == "smoothed"


@pytest.mark.usefixtures("capsys")
def test_progress_keeps_few_bytes_per_pose(demo: Demo, timeline: UnixTimeline) -> None:
    """A day has 3.5 million poses; the errors of all are known without storing the poses."""
    start_ns = timeline.unix_ns(demo.start_ns)
    estimated = _estimated(demo)
    progress = Progress(demo, timeline)
    lines = _lines(estimated, start_ns)
    for line in islice(lines, POSES // 2):
        progress.line(line)
    tracemalloc.start()
    try:
        for line in lines:
            progress.line(line)
        kept_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept_bytes < MOST_BYTES * POSES / 2

    times_s = np.arange(POSES) * PERIOD_NS / 1e9
    expected = pose_errors(estimated, demo.world.pose_at(times_s), demo.world.prisms_m.mean(axis=0))
    found = progress.live_poses("smoothed")
    assert (found.poses, found.valid_poses) == (POSES, POSES)
    inner = slice(40, -40)  # without 2 s at both ends
    errors = PoseErrors(expected.position_m[inner], expected.centroid_m[inner], expected.rotation_rad[inner])
    assert found.errors.compared == POSES - 80
    assert found.errors.position_rms_mm == pytest.approx(errors.position_rms_mm, abs=1e-6)
    assert found.errors.centroid.position_rms_mm == pytest.approx(errors.centroid.position_rms_mm, abs=1e-6)
    assert found.errors.orientation_rms_deg == pytest.approx(errors.orientation_rms_deg, abs=1e-7)


def _estimated(demo: Demo) -> NDArray[np.float64]:
    """Return poses with a growing error."""
    poses = demo.world.pose_at(np.arange(POSES) * PERIOD_NS / 1e9)
    turn = rotation_from_quaternion(np.array([0.0, 0.0, 0.01, 1.0]) / np.hypot(0.01, 1.0))
    poses[:, :3, 3] += np.arange(POSES)[:, None] * 1e-5
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    return transform_from(poses[:, :3, :3], poses[:, :3, 3])


def _lines(poses: NDArray[np.float64], start_ns: int) -> Iterator[bytes]:
    """Yield lines of a stream with one status."""
    for index, pose in enumerate(poses):
        fields: dict[str, Any] = {
            "position_m": tuple(pose[:3, 3].tolist()),
            "orientation_xyzw": tuple(quaternion_from_rotation(pose[:3, :3]).tolist()),
        }
        stamp_ns = start_ns + PERIOD_NS * index
        yield encode_line(replace(POSE, stamp_ns=stamp_ns, kind="smoothed", **fields))
        if index == POSES // 5 - 1:
            yield encode_line(StatusRecord(stamp_ns=stamp_ns, poses=index, valid_poses=index, stations=()))


STATION = "[[stations]]\nstation = {0}\nprism = {1}\nposition_m = [{0}, 0, 0]\n"
PRISM = "[[prisms]]\nprism = {0}\nposition_m = [{1}, {2}, 1]\n"


def _scenario(folder: Path, *stations: tuple[int, int]) -> Path:
    """Write a scenario with stations, each on a prism, and return its path."""
    prisms = [PRISM.format(prism, index, index**2) for index, (_, prism) in enumerate(stations)]
    entries = [STATION.format(*each) for each in stations]
    path = folder / "scenario.toml"
    path.write_text("\n".join(['kind = "scenario"', *entries, *prisms]))
    return path


@pytest.mark.usefixtures("short_temporary_folder")
@pytest.mark.parametrize(
    ("stations", "arguments", "reason"),
    [
        (
            ((1, 1), (2, 2), (10, 3)),
            ("--protocol", "classic"),
            "station 10 with prism 3: the protocol classic",
        ),
        (
            ((1, 1), (2, 2), (3, 10)),
            ("--protocol", "classic"),
            "station 3 with prism 10: the protocol classic",
        ),
        (((1, 1), (2, 2), (3, 17)), (), "station 3 with prism 17: the protocol superframe"),
        (((1, 1), (2, 2)), (), "2 stations on 2 prisms cannot give poses without an IMU"),
    ],
)
def test_scenario_whose_daemons_cannot_start_is_an_error(
    tsgt: Tsgt,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stations: tuple[tuple[int, int], ...],
    arguments: tuple[str, ...],
    reason: str,
) -> None:
    """One line before any process starts, not a minute without poses."""
    monkeypatch.setattr(Demo, "run", _starts)
    result = tsgt("demo", "--scenario", _scenario(tmp_path, *stations), *arguments)
    assert result.code == 2
    assert reason in result.err
    assert len(result.err.splitlines()) == 1
    assert result.out == ""


@pytest.mark.usefixtures("short_temporary_folder")
def test_two_stations_and_an_imu_start(tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The master has the IMU when its configuration is checked."""
    monkeypatch.setattr(Demo, "run", _starts)
    scenario = _scenario(tmp_path, (1, 1), (2, 2))
    result = tsgt("demo", "--scenario", scenario, "--duration", 1, "--imu", "industrial")
    assert "the daemons start" in result.err


async def _starts(_demo: Demo, _on_line: Callable[[bytes], None]) -> None:
    raise StreamError("the daemons start")
