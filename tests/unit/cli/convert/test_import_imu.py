"""Importing samples of an IMU that another program recorded."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.cli import called
from harness.files.records import START, measurement, recording_bytes
from harness.inertial.imu_calibration import uncalibrated_drive, write_imu_recording
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tsgt.recording import read_imu_samples

if TYPE_CHECKING:
    from pathlib import Path

COLUMNS = (
    "stamp_ns,angular_rate_x_radps,angular_rate_y_radps,angular_rate_z_radps,"
    "specific_force_x_mps2,specific_force_y_mps2,specific_force_z_mps2"
)
START_NS = 1_700_000_000_000_000_000
NUMBERS = [n for n in range(100) if n not in (40, 41)]


def write_table(path: Path) -> Path:
    """Write samples at 200 Hz, two of which are missing."""
    rows = [f"{START_NS + n * 5_000_000},{n / 1000},0,0.1,0,0,9.81" for n in NUMBERS]
    path.write_text("\n".join([COLUMNS, *rows]) + "\n")
    return path


def write_bag(
    path: Path,
    *topics: str,
    plugin: StoragePlugin = StoragePlugin.MCAP,
    force_z: float = 9.81,
    absent: bool = False,
) -> Path:
    """Write the same samples as messages."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    covariance = np.zeros(9)
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        for topic in topics:
            connection = writer.add_connection(topic, "sensor_msgs/msg/Imu", typestore=store)
            for n in NUMBERS:
                stamp_ns = START_NS + n * 5_000_000
                message = types["sensor_msgs/msg/Imu"](
                    header=types["std_msgs/msg/Header"](
                        stamp=types["builtin_interfaces/msg/Time"](
                            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
                        ),
                        frame_id="imu",
                    ),
                    orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
                    orientation_covariance=covariance,
                    angular_velocity=types["geometry_msgs/msg/Vector3"](x=n / 1000, y=0.0, z=0.1),
                    angular_velocity_covariance=covariance,
                    linear_acceleration=types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=force_z),
                    linear_acceleration_covariance=covariance - np.eye(9)[0] if absent else covariance,
                )
                data = store.serialize_cdr(message, "sensor_msgs/msg/Imu")
                writer.write(connection, stamp_ns + 7_000_000, data)
    return path


def imported(tmp_path: Path, *arguments: object) -> Path:
    """Import; check what is printed and the samples."""
    output = tmp_path / "imu.jsonl"
    outcome = called("import", "imu", *arguments, "--output", output, "--json")
    assert outcome.code == 0, outcome.err
    assert outcome.json() == {"samples": 98, "rate_hz": pytest.approx(200.0), "gaps": 1}
    records = list(read_imu_samples(output))
    assert [rate[0] for record in records for rate in record.angular_rate_radps] == [
        n / 1000 for n in NUMBERS
    ]
    assert {duration for record in records for duration in record.duration_ns} == {5_000_000}
    assert [
        number
        for record in records
        for number in range(record.sequence, record.sequence + len(record.stamp_ns))
    ] == NUMBERS
    return output


def test_table_is_imported(tmp_path: Path) -> None:
    """Its times are shifted by the offset."""
    output = imported(tmp_path, write_table(tmp_path / "imu.csv"), "--offset-ms", "-12.5")
    first = next(read_imu_samples(output))
    assert first.stamp_ns[0] == START_NS - 12_500_000
    assert first.instrument_time_ns is not None
    assert first.instrument_time_ns[0] == START_NS


@pytest.mark.parametrize("cut", [0, 1, 3])
def test_cut_table_is_imported_with_a_note(tmp_path: Path, cut: int) -> None:
    """A number may have lost its last digits where the last line has no end."""
    table = write_table(tmp_path / "imu.csv")
    table.write_bytes(table.read_bytes()[: -cut or None])
    done = called("import", "imu", table, "--output", tmp_path / "imu.jsonl")
    assert done.code == 0
    assert ("note" in done.err) == (cut > 0)
    if cut:
        assert f"note: {table}: the last line has no line end" in done.err


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_bag_is_imported(tmp_path: Path, plugin: StoragePlugin) -> None:
    """By the stamps in the messages, not by those of the bag."""
    output = imported(tmp_path, write_bag(tmp_path / "bag", "/imu/data", plugin=plugin))
    assert next(read_imu_samples(output)).stamp_ns[0] == START_NS


@pytest.mark.parametrize("force_z", [float("nan"), float("inf"), 1e30])
def test_absurd_sample_of_a_bag_is_one_line(tmp_path: Path, force_z: float) -> None:
    """With its time and the limits, which are those of a table; nothing is written."""
    bag = write_bag(tmp_path / "bag", "/imu", force_z=force_z)
    outcome = called("import", "imu", bag, "--output", tmp_path / "imu.jsonl")
    assert outcome.code == 1
    assert f"specific_force_z_mps2 of the sample at {START_NS} ns is" in outcome.err
    assert "expected -2000 to 2000" in outcome.err
    assert not (tmp_path / "imu.jsonl").exists()


def test_messages_without_acceleration_are_refused(tmp_path: Path) -> None:
    """A covariance that begins with -1 says that the zeros beside it mean nothing."""
    bag = write_bag(tmp_path / "bag", "/imu", force_z=0.0, absent=True)
    outcome = called("import", "imu", bag, "--output", tmp_path / "imu.jsonl")
    assert outcome.code == 1
    assert "without angular velocity or linear acceleration" in outcome.err


def test_files_that_overlap_give_each_sample_once(tmp_path: Path) -> None:
    """A logger may repeat its last lines in the next file."""
    whole = write_table(tmp_path / "whole.CSV").read_text().splitlines()
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    first.write_text("\n".join(whole[:60]) + "\n")
    second.write_text("\n".join([whole[0], *whole[50:]]) + "\n")
    assert imported(tmp_path, tmp_path / "whole.CSV").exists()
    assert imported(tmp_path, second, first).exists()


def test_topic_is_chosen(tmp_path: Path) -> None:
    """Where there are several."""
    bag = write_bag(tmp_path / "bag", "/a", "/b")
    outcome = called("import", "imu", bag, "--output", tmp_path / "imu.jsonl")
    assert outcome.code == 1
    assert "has several topics of an IMU: /a, /b; give --topic" in outcome.err
    imported(tmp_path, bag, "--topic", "/b")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stamp_ns\n1\n", "expected one column angular_rate_x_radps"),
        (COLUMNS + "\n1,0,0,5000,0,0,9.8\n", "expected -100 to 100"),
        (COLUMNS + "\n1,0,0,0,0,0,9.8\n", "fewer than two samples"),
        (
            COLUMNS + "\n1,0,0,0,0,0,9.8\n2,0,0,0,0,0,9.8\n2,0,0,1,0,0,9.8\n",
            "different samples have the same time",
        ),
        (COLUMNS.replace(",", ";") + "\n1;0;0;0;0;0;9.8\n", "columns are separated by commas"),
        ("# " + COLUMNS + "\n1,0,0,0,0,0,9.8\n2,0,0,0,0,0,9.8\n", "must have the names of the columns"),
    ],
)
def test_bad_table_is_one_line(tmp_path: Path, text: str, expected: str) -> None:
    """With what is expected; nothing is written."""
    path = tmp_path / "imu.csv"
    path.write_text(text)
    outcome = called("import", "imu", path, "--output", tmp_path / "imu.jsonl")
    assert outcome.code == 1
    assert expected in outcome.err
    assert not (tmp_path / "imu.jsonl").exists()


def test_file_that_is_no_bag_is_one_line(tmp_path: Path) -> None:
    """With the file's name."""
    path = tmp_path / "imu.mcap"
    path.write_bytes(b"garbage")
    outcome = called("import", "imu", path, "--output", tmp_path / "imu.jsonl")
    assert outcome.code == 1
    assert "is no bag of ROS that can be read" in outcome.err


def test_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the extra that has it."""
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    outcome = called("import", "imu", tmp_path / "bag.mcap", "--output", tmp_path / "imu.jsonl")
    assert outcome.code == 1
    assert "pip install 'tsgt[mcap]'" in outcome.err


@pytest.mark.slow
def test_clock_of_another_computer_is_aligned_with_a_recording(tmp_path: Path) -> None:
    """Offset and drift are found and removed; the device's own times stay in the file."""
    drive = uncalibrated_drive(160.0, latency_s=0.0, seed=3)
    write_imu_recording(tmp_path / "field.jsonl", drive)
    times_ns = START + np.round(1e9 * drive.samples.end_s).astype(np.int64)
    stamps_ns = times_ns + 3_600_000_000_000 + np.round(60e3 * drive.samples.end_s).astype(np.int64)
    values = np.hstack([drive.samples.angular_rate_radps, drive.samples.specific_force_mps2]).tolist()
    rows = (f"{stamp},{','.join(map(repr, row))}" for stamp, row in zip(stamps_ns, values, strict=True))
    (tmp_path / "imu.csv").write_text("\n".join([COLUMNS, *rows]) + "\n")
    output = tmp_path / "imu.jsonl"
    arguments = (
        "import",
        "imu",
        tmp_path / "imu.csv",
        "--align",
        tmp_path / "field.jsonl",
        "--output",
        output,
    )
    done = called(*arguments, "--json")
    assert done.code == 0, done.err
    clock = done.json()["clock"]
    assert clock["offset_ms"] == pytest.approx(3_600_004.8, abs=4 * clock["offset_sigma_ms"])
    assert clock["drift_ppm"] == pytest.approx(60.0, abs=4 * clock["drift_sigma_ppm"])
    records = list(read_imu_samples(output))
    aligned_ns = np.array([stamp for record in records for stamp in record.stamp_ns])
    assert np.abs(aligned_ns - times_ns).max() < 2_500_000
    assert [stamp for record in records for stamp in record.instrument_time_ns or ()] == stamps_ns.tolist()
    assert "clock of the files less the master's" in called(*arguments).out


def test_align_and_offset_exclude_each_other(tmp_path: Path) -> None:
    """The offset is found, or given."""
    table = write_table(tmp_path / "imu.csv")
    arguments = ("--align", table, "--offset-ms", "0", "--output", tmp_path / "imu.jsonl")
    outcome = called("import", "imu", table, *arguments)
    assert outcome.code == 2
    assert "--align finds the offset; omit --offset-ms" in outcome.err


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (recording_bytes(), "the recording has no measurements"),
        (
            recording_bytes(measurement(0)),
            "fewer than 3 prisms do not tell how the robot turns; give --offset-ms",
        ),
        (b"{}", "does not begin with the header of a recording"),
    ],
    ids=["empty", "one-prism", "other-file"],
)
def test_recording_that_tells_no_clock_is_one_line(tmp_path: Path, content: bytes, expected: str) -> None:
    """Nothing is written."""
    (tmp_path / "field.jsonl").write_bytes(content)
    table, output = write_table(tmp_path / "imu.csv"), tmp_path / "imu.jsonl"
    outcome = called("import", "imu", table, "--align", tmp_path / "field.jsonl", "--output", output)
    assert outcome.code == 1
    assert expected in outcome.err
    assert not output.exists()
