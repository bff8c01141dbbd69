"""``tsgt export``: selection of poses, MCAP files, and errors."""

from __future__ import annotations

import csv
import dataclasses
import sys
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.records import (
    EVENT,
    HEADER,
    NO_POSE,
    PARAMETERS,
    POSE,
    START,
    measurement,
    recording_bytes,
)
from rosbags.highlevel import AnyReader

from tsgt.model import ReferencePoint
from tsgt.recording import encode_line

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Outcome, Tsgt

    from tsgt.recording import Kind, PoseRecord

PERIOD_NS = 50_000_000


def pose(epoch: int, kind: Kind, x_m: float) -> PoseRecord:
    """Make a pose of the continuous estimator, identified by its x."""
    return dataclasses.replace(
        POSE,
        stamp_ns=START + epoch * PERIOD_NS,
        kind=kind,
        estimator="continuous",
        position_m=(x_m, 0.0, 0.0),
    )


@pytest.fixture
def live(tmp_path: Path) -> Path:
    """Write a recording of a live master: each epoch predicted at once and smoothed later."""
    predicted = [pose(k, "predicted", 100.0 + k) for k in range(4)]
    smoothed = [pose(k, "smoothed", float(k)) for k in range(2)]
    records = [measurement(0), *predicted[:3], smoothed[0], predicted[3], measurement(1), smoothed[1], EVENT]
    path = tmp_path / "live.jsonl"
    path.write_bytes(recording_bytes(*records))
    return path


def xs(outcome: Outcome) -> list[float]:
    """Return the x of each line of a TUM file."""
    assert outcome.code == 0, outcome.err
    return [float(line.split()[1]) for line in outcome.out.splitlines() if not line.startswith("#")]


def read(path: Path) -> dict[str, list[Any]]:
    """Return the messages by topic."""
    found: dict[str, list[Any]] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    return found


def test_smoothed_poses_replace_predicted_ones(tsgt: Tsgt, live: Path) -> None:
    """Each epoch is exported once."""
    assert xs(tsgt("export", live, "--format", "tum")) == [0.0, 1.0]


def test_predicted_poses_are_exported_on_request(tsgt: Tsgt, live: Path) -> None:
    """They are what the robot had at that time."""
    outcome = tsgt("export", live, "--format", "tum", "--kind", "predicted")
    assert xs(outcome) == [100.0, 101.0, 102.0, 103.0]


def test_csv_has_estimator_and_kind(tsgt: Tsgt, live: Path) -> None:
    """Joined files can be separated again."""
    outcome = tsgt("export", live, "--format", "csv", "--kind", "predicted")
    rows = list(csv.DictReader(outcome.out.splitlines()))
    assert {(row["estimator"], row["kind"]) for row in rows} == {("continuous", "predicted")}
    assert len(rows) == 4


def test_poses_at_a_delay_are_exported_on_request(tsgt: Tsgt, live: Path) -> None:
    """By default they are not mixed with the final ones of the same epochs."""
    delayed = dataclasses.replace(pose(1, "smoothed", 50.0), delay_s=0.6)
    live.write_bytes(live.read_bytes() + encode_line(delayed) + b"\n")
    assert xs(tsgt("export", live, "--format", "tum")) == [0.0, 1.0]
    assert xs(tsgt("export", live, "--format", "tum", "--kind", "smoothed")) == [0.0, 1.0]
    assert xs(tsgt("export", live, "--format", "tum", "--delay-s", "0.6")) == [50.0]
    outcome = tsgt("export", live, "--format", "tum", "--delay-s", "1")
    assert outcome.code == 1
    assert "holds no smoothed poses at 1s; omit --delay-s" in outcome.err
    assert tsgt("export", live, "--format", "tum", "--delay-s", "1", "--kind", "predicted").code == 2


def test_missing_kind_is_an_error(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """Nothing is computed instead, and no file is written."""
    output = tmp_path / "out.tum"
    outcome = tsgt("export", live, "--format", "tum", "--kind", "interpolated", "--output", output)
    assert outcome.code == 1
    assert "holds no interpolated poses" in outcome.err
    assert not output.exists()


def test_mcap_of_a_live_recording(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """Poses, prism positions and the reference are in the file."""
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


def test_mcap_of_measurements_is_processed_first(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """Processing fails here, and the error names the missing prism."""
    live.write_bytes(recording_bytes(measurement(0), measurement(1)))
    outcome = tsgt("export", live, "--format", "mcap", "--output", tmp_path / "out.mcap")
    assert outcome.code == 1
    assert "holds no poses; processing its measurements" in outcome.err
    assert "prism 2 has no usable measurement" in outcome.err
    assert list(tmp_path.iterdir()) == [live]


def test_torn_line_is_reported_once(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """MCAP export reads the file twice."""
    with live.open("ab") as file:
        file.write(b'{"type":"pose","st')
    outcome = tsgt("export", live, "--format", "mcap", "--output", tmp_path / "out.mcap")
    assert (outcome.code, outcome.err.count("is torn")) == (0, 1)


def test_invalid_poses_have_no_message(tsgt: Tsgt, tmp_path: Path) -> None:
    """A ROS message has no validity."""
    path, output = tmp_path / "poses.jsonl", tmp_path / "out.mcap"
    path.write_bytes(
        recording_bytes(
            POSE,
            NO_POSE,
            dataclasses.replace(POSE, stamp_ns=NO_POSE.stamp_ns + PERIOD_NS, valid=False, reason="residual"),
        )
    )
    assert tsgt("export", path, "--format", "mcap", "--output", output).code == 0
    assert len(read(output)["/tsgt/pose"]) == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--format", "mcap"], "--output FILE"),
        (["--format", "mcap", "--records", "measurements", "--output", "x"], "--format csv"),
        (["--format", "tum", "--reference", "x"], "tsgt evaluate"),
        (["--format", "mcap", "--output", "x", "--reference-point", "1,1,1"], "needs --reference"),
        (["--format", "csv", "--records", "measurements", "--kind", "predicted"], "choose poses"),
        (["--format", "csv", "--records", "measurements", "--delay-s", "1"], "choose poses"),
        (["--format", "tum", "--delay-s", "nan"], "nan is not a finite number"),
        (["--format", "csv", "--records", "measurements", "--point", "1,2,3"], "choose poses"),
        (["--format", "csv", "--records", "measurements", "--no-imu"], "choose poses"),
    ],
)
def test_inconsistent_options_are_rejected(tsgt: Tsgt, live: Path, arguments: list[str], says: str) -> None:
    """The error says what to use instead."""
    outcome = tsgt("export", live, *arguments)
    assert outcome.code == 2
    assert says in outcome.err


@pytest.mark.parametrize(
    "option", [("--no-imu",), ("--imu", "x"), ("--imu-setup", "x"), ("--wheel-odometry", "x")]
)
def test_recorded_poses_are_not_those_of_another_imu(
    tsgt: Tsgt, live: Path, tmp_path: Path, option: tuple[str, ...]
) -> None:
    """Recorded poses would pass for poses with or without an IMU: nothing is written, also not to stdout."""
    for output in ((), ("--output", tmp_path / "out.tum")):
        outcome = tsgt("export", live, "--format", "tum", *option, *output)
        assert (outcome.code, outcome.out) == (2, "")
        assert "holds poses, which are exported as they are: options of the IMU have no effect" in outcome.err
    assert list(tmp_path.iterdir()) == [live]


def test_measurements_are_exported_as_recorded(tsgt: Tsgt, tmp_path: Path) -> None:
    """Those before the set-up was replaced, and those of a master without calibration."""
    path = tmp_path / "raw.jsonl"
    for records in (
        (HEADER, PARAMETERS, measurement(0), PARAMETERS, measurement(1)),
        (HEADER, dataclasses.replace(PARAMETERS, no_poses="not calibrated"), measurement(0), measurement(1)),
    ):
        path.write_bytes(b"".join(encode_line(record) + b"\n" for record in records))
        outcome = tsgt("export", path, "--format", "csv", "--records", "measurements")
        assert (outcome.code, outcome.err) == (0, "")
        assert [row["sequence"] for row in csv.DictReader(outcome.out.splitlines())] == [
            str(measurement(0).sequence),
            str(measurement(1).sequence),
        ]


def test_recording_without_measurements_has_none_to_export(tsgt: Tsgt, tmp_path: Path) -> None:
    """As one of poses alone: a file with a header only would look like a result."""
    path, output = tmp_path / "poses.jsonl", tmp_path / "measurements.csv"
    path.write_bytes(recording_bytes(pose(0, "smoothed", 0.0)))
    outcome = tsgt("export", path, "--records", "measurements", "--output", output)
    assert outcome.code == 1
    assert "has no measurements" in outcome.err
    assert not output.exists()


def test_inputs_are_not_overwritten(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """Recording and reference."""
    reference = tmp_path / "reference.tum"
    reference.write_text("1 7 8 9 0 0 0 1\n2 7 8 9 0 0 0 1\n", encoding="utf-8")
    for output in (live, reference):
        arguments = ["--format", "mcap", "--reference", reference, "--output", output]
        assert tsgt("export", live, *arguments).code == 2


@pytest.mark.parametrize("option", ["--imu", "--imu-setup", "--wheel-odometry"])
@pytest.mark.parametrize("command", ["export", "process"])
def test_inputs_of_the_imu_are_not_overwritten(
    tsgt: Tsgt, live: Path, tmp_path: Path, command: str, option: str
) -> None:
    """Their samples, their mounting, and the odometry."""
    given = tmp_path / "given.csv"
    given.write_text("time_s,linear_mps,angular_radps\n")
    outcome = tsgt(command, live, option, given, "--output", given)
    assert (outcome.code, "would replace its own input" in outcome.err) == (2, True)


def test_missing_library_fails_before_the_work(
    tsgt: Tsgt, live: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says what to install."""
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    outcome = tsgt("export", live, "--format", "mcap", "--output", tmp_path / "out.mcap")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert "pip install 'tsgt[mcap]'" in outcome.err


def test_time_beyond_ros_2_is_one_line(tsgt: Tsgt, live: Path, tmp_path: Path) -> None:
    """ROS 2 times end in January 2038."""
    live.write_bytes(recording_bytes(dataclasses.replace(POSE, stamp_ns=2**62)))
    output = tmp_path / "out.mcap"
    outcome = tsgt("export", live, "--format", "mcap", "--output", output)
    assert outcome.code == 1
    assert "January 2038" in outcome.err
    assert not output.exists()


LIDAR = ReferencePoint(name="lidar", position_m=(0.0, 0.0, 2.0), orientation_xyzw=(1.0, 0.0, 0.0, 0.0))


@pytest.fixture
def two_points(tmp_path: Path) -> Path:
    """Two sessions of a master that was restarted with another reference point, at rest."""
    path = tmp_path / "two.jsonl"
    first = dataclasses.replace(POSE, orientation_xyzw=(0.0, 0.0, 0.0, 1.0))
    later = dataclasses.replace(
        first,
        stamp_ns=first.stamp_ns + PERIOD_NS,
        child_frame="lidar",
        position_m=(1.0, 2.0, 1.9),
        orientation_xyzw=(1.0, 0.0, 0.0, 0.0),
    )
    parameters = dataclasses.replace(PARAMETERS, reference_point=LIDAR)
    path.write_bytes(
        recording_bytes(first) + b"".join(encode_line(r) + b"\n" for r in (HEADER, parameters, later))
    )
    return path


def test_all_poses_of_a_file_are_of_one_point(tsgt: Tsgt, two_points: Path) -> None:
    """Of the first session's, or of the one that is given; the comment and each row name it."""
    for options, name, z_m in (((), "robot", -0.1), (("--point", "lidar=0,0,2,1,0,0,0"), "lidar", 1.9)):
        tum = tsgt("export", two_points, "--format", "tum", *options).out.splitlines()
        assert tum[0].startswith(f"# {name} in station1")
        assert [float(line.split()[3]) for line in tum[2:]] == pytest.approx([z_m, z_m])
        rows = list(csv.DictReader(tsgt("export", two_points, "--format", "csv", *options).out.splitlines()))
        assert [row["child_frame"] for row in rows] == [name, name]
        assert [float(row["z_m"]) for row in rows] == pytest.approx([z_m, z_m])


def test_frames_of_an_mcap_file_hang_on_the_point(tsgt: Tsgt, two_points: Path, tmp_path: Path) -> None:
    """The moving transform is that of the point; the robot frame, with its prisms, is fixed to it."""
    output = tmp_path / "out.mcap"
    assert tsgt("export", two_points, "--point", "lidar=0,0,2,1,0,0,0", "--output", output).code == 0
    found = read(output)
    assert {t.child_frame_id for m in found["/tf"] for t in m.transforms} == {"lidar"}
    assert {m.child_frame_id for m in found["/tsgt/odometry"]} == {"lidar"}
    robot = next(t for m in found["/tf_static"] for t in m.transforms if t.child_frame_id == "robot")
    assert robot.header.frame_id == "lidar"
    # Half a turn about x: what is up for the robot is down for the sensor.
    assert robot.transform.translation.z == pytest.approx(2.0)
    assert abs(robot.transform.rotation.x) == pytest.approx(1.0)


def test_poses_before_a_set_up_that_was_replaced_are_left_out(tsgt: Tsgt, tmp_path: Path) -> None:
    """The tripods may have stood elsewhere, so that their frame is another one; a note counts them."""
    poses = [pose(k, "smoothed", float(k)) for k in range(5)]
    path = tmp_path / "reload.jsonl"
    moved = dataclasses.replace(PARAMETERS, stations=PARAMETERS.stations[::-1])
    path.write_bytes(
        recording_bytes(*poses[:3])
        + b"".join(encode_line(r) + b"\n" for r in (moved, poses[3], moved, poses[4]))
    )
    outcome = tsgt("export", path, "--format", "tum")
    assert xs(outcome) == [3.0, 4.0]  # The same set-up may be read again
    assert "3 poses before the set-up was replaced are left out" in outcome.err


def test_file_without_a_valid_pose_has_no_trajectory(tsgt: Tsgt, tmp_path: Path) -> None:
    """TUM has valid poses only; CSV has all, with the reason why one is invalid."""
    path = tmp_path / "invalid.jsonl"
    path.write_bytes(recording_bytes(NO_POSE))
    outcome = tsgt("export", path, "--output", tmp_path / "out.tum")
    assert outcome.code == 1
    assert "has no valid pose; --format csv tells why each pose is invalid" in outcome.err
    assert not (tmp_path / "out.tum").exists()
    assert "outage" in tsgt("export", path, "--format", "csv").out


def test_mcap_without_a_valid_pose_is_noted(tsgt: Tsgt, tmp_path: Path) -> None:
    """It still shows the prisms."""
    path, output = tmp_path / "invalid.jsonl", tmp_path / "out.mcap"
    path.write_bytes(recording_bytes(measurement(0), NO_POSE))
    outcome = tsgt("export", path, "--output", output)
    assert outcome.code == 0
    assert "has no valid pose, only positions of prisms" in outcome.err
    assert "/tsgt/prism1" in read(output)


def test_joined_runs_that_overlap_are_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """No reader of trajectories takes times that run backwards."""
    path = tmp_path / "twice.jsonl"
    path.write_bytes(2 * recording_bytes(*(pose(k, "smoothed", float(k)) for k in range(3))))
    outcome = tsgt("export", path, "--format", "tum", "--output", tmp_path / "out.tum")
    assert outcome.code == 1
    assert "runs that were joined overlap; export each by itself" in outcome.err
    assert not (tmp_path / "out.tum").exists()


def test_joined_runs_with_different_set_ups_are_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """Their poses are in different frames, which no file can say."""
    path = tmp_path / "days.jsonl"
    moved = dataclasses.replace(PARAMETERS, stations=PARAMETERS.stations[:2])
    second = b"".join(encode_line(record) + b"\n" for record in (HEADER, moved, pose(5, "smoothed", 5.0)))
    path.write_bytes(recording_bytes(pose(0, "smoothed", 0.0)) + second)
    outcome = tsgt("export", path, "--format", "tum", "--output", tmp_path / "out.tum")
    assert outcome.code == 1
    assert "runs with different set-ups were joined; export each by itself" in outcome.err
    assert not (tmp_path / "out.tum").exists()
