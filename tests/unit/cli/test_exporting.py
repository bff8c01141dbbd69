"""``tsgt export``: which poses are taken, MCAP files, what is refused. The formats themselves are tested elsewhere."""

from __future__ import annotations

import csv
import dataclasses
import sys
from typing import TYPE_CHECKING, Any

import pytest
from harness.records import EVENT, NO_POSE, POSE, START, measurement, recording_bytes
from rosbags.highlevel import AnyReader

if TYPE_CHECKING:
    from pathlib import Path

    from harness.cli import Outcome, Tsgt

    from tsgt.recording import Kind, PoseRecord

PERIOD_NS = 50_000_000


def pose(epoch: int, kind: Kind, x_m: float) -> PoseRecord:
    """Make a pose of the continuous estimator that is known by its x."""
    return dataclasses.replace(
        POSE,
        stamp_ns=START + epoch * PERIOD_NS,
        kind=kind,
        estimator="continuous",
        position_m=(x_m, 0.0, 0.0),
    )


@pytest.fixture
def live(tmp_path: Path) -> Path:
    """Write what a live master records: each epoch predicted at once and smoothed later, measurements in between."""
    predicted = [pose(k, "predicted", 100.0 + k) for k in range(4)]
    smoothed = [pose(k, "smoothed", float(k)) for k in range(2)]
    records = [measurement(0), *predicted[:3], smoothed[0], predicted[3], measurement(1), smoothed[1], EVENT]
    path = tmp_path / "live.jsonl"
    path.write_bytes(recording_bytes(*records))
    return path


def xs(outcome: Outcome) -> list[float]:
    """Return the x of each line of a TUM file."""
    assert outcome.code == 0, outcome.err
    return [float(line.split()[1]) for line in outcome.out.splitlines()]


def read(path: Path) -> dict[str, list[Any]]:
    """Messages of each topic."""
    found: dict[str, list[Any]] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    return found


def test_of_predicted_and_smoothed_poses_the_smoothed_are_taken(tsgt: Tsgt, live: Path) -> None:
    """An epoch must not stand in a trajectory twice, and the better of the two is the later one."""
    assert xs(tsgt("export", live, "--format", "tum")) == [0.0, 1.0]


def test_predicted_poses_are_there_for_the_asking(tsgt: Tsgt, live: Path) -> None:
    """They are what a robot had at that moment."""
    outcome = tsgt("export", live, "--format", "tum", "--kind", "predicted")
    assert xs(outcome) == [100.0, 101.0, 102.0, 103.0]


def test_csv_says_what_each_pose_is(tsgt: Tsgt, live: Path) -> None:
    """Who joins two files can tell them apart."""
    outcome = tsgt("export", live, "--format", "csv", "--kind", "predicted")
    rows = list(csv.DictReader(outcome.out.splitlines()))
    assert {(row["estimator"], row["kind"]) for row in rows} == {("continuous", "predicted")}
    assert len(rows) == 4


def test_a_kind_that_is_not_there_is_an_error(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """Nothing is computed in its place, and no empty file is left."""
    output = tmp_path / "out.tum"
    outcome = tsgt("export", live, "--format", "tum", "--kind", "interpolated", "--output", output)
    assert outcome.code == 1
    assert "holds no interpolated poses" in outcome.err
    assert not output.exists()


def test_mcap_of_a_live_recording(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """Poses as recorded, prisms as measured, and the trajectory to compare with."""
    reference, output = tmp_path / "reference.tum", tmp_path / "out.mcap"
    reference.write_text("1700000000.5 7 8 9 0 0 0 1\n1700000000.6 7 8 9 0 0 0 1\n", encoding="utf-8")
    arguments = ["--format", "mcap", "--reference", reference, "--output", output]
    assert tsgt("export", live, *arguments) == (0, "", "")
    found = read(output)
    assert [m.pose.pose.position.x for m in found["/tsgt/pose"]] == [0.0, 1.0]
    assert {topic: len(them) for topic, them in found.items()} == {
        "/tf": 2,
        "/tf_static": 1,
        "/tsgt/odometry": 2,
        "/tsgt/pose": 2,
        "/tsgt/prism1": 2,
        "/tsgt/reference": 2,
    }


def test_mcap_of_what_was_only_measured_is_processed_first(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """As for the other formats; here it cannot be, and what is missing is named."""
    live.write_bytes(recording_bytes(measurement(0), measurement(1)))
    outcome = tsgt("export", live, "--format", "mcap", "--output", tmp_path / "out.mcap")
    assert outcome.code == 1
    assert "holds no poses; processing its measurements" in outcome.err
    assert "prism 2 has no usable measurement" in outcome.err
    assert list(tmp_path.iterdir()) == [live]


def test_a_torn_line_is_told_of_once(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """MCAP needs the file twice, the user the warning once."""
    with live.open("ab") as file:
        file.write(b'{"type":"pose","st')
    outcome = tsgt("export", live, "--format", "mcap", "--output", tmp_path / "out.mcap")
    assert (outcome.code, outcome.err.count("is torn")) == (0, 1)


def test_invalid_poses_have_no_message(tsgt: Tsgt, tmp_path: Path) -> None:
    """A ROS message cannot say that it is not to be used."""
    path, output = tmp_path / "poses.jsonl", tmp_path / "out.mcap"
    path.write_bytes(
        recording_bytes(POSE, NO_POSE, dataclasses.replace(POSE, valid=False, reason="residual"))
    )
    assert tsgt("export", path, "--format", "mcap", "--output", output).code == 0
    assert len(read(output)["/tsgt/pose"]) == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--format", "mcap"], "--output FILE"),
        (["--format", "mcap", "--records", "measurements", "--output", "x"], "--format csv"),
        (["--format", "tum", "--reference", "x"], "tsgt evaluate"),
    ],
)
def test_combinations_without_a_meaning_are_refused(
    tsgt: Tsgt, live: Path, arguments: list[str], says: str
) -> None:
    """With what to type instead."""
    outcome = tsgt("export", live, *arguments)
    assert outcome.code == 2
    assert says in outcome.err


def test_neither_input_is_overwritten(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """Neither the recording nor the reference."""
    reference = tmp_path / "reference.tum"
    reference.write_text("1 7 8 9 0 0 0 1\n2 7 8 9 0 0 0 1\n", encoding="utf-8")
    for output in (live, reference):
        arguments = ["--format", "mcap", "--reference", reference, "--output", output]
        assert tsgt("export", live, *arguments).code == 2


def test_a_missing_library_is_one_line(
    tsgt: Tsgt, live: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says what to install."""
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    outcome = tsgt("export", live, "--format", "mcap", "--output", tmp_path / "out.mcap")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert "pip install 'tsgt[mcap]'" in outcome.err


def test_a_clock_beyond_ros_2_is_one_line(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """A recording may hold a time that ROS 2 cannot tell."""
    live.write_bytes(recording_bytes(dataclasses.replace(POSE, stamp_ns=2**62)))
    output = tmp_path / "out.mcap"
    outcome = tsgt("export", live, "--format", "mcap", "--output", output)
    assert outcome.code == 1
    assert "January 2038" in outcome.err
    assert not output.exists()
