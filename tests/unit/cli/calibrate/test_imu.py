"""``tsgt calibrate imu`` on a recording with an IMU whose mounting is unknown."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial.imu_calibration import UncalibratedDrive, uncalibrated_drive, write_imu_recording

from tsgt.analysis.calibration import calibrate_recorded_imu
from tsgt.config import IMU_NOISE, load_imu_mounting
from tsgt.errors import GeometryError
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.recording import encode_line, load_recording, read_imu_samples

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt


@pytest.fixture(scope="module")
def drive() -> UncalibratedDrive:
    """Drive for a little more than a minute."""
    return uncalibrated_drive(63.0, seed=2)


@pytest.fixture(scope="module")
def recording(drive: UncalibratedDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return its recording."""
    path = tmp_path_factory.mktemp("imu") / "recording.jsonl"
    write_imu_recording(path, drive)
    return path


@pytest.mark.slow
def test_file_and_json_hold_the_mounting(
    tsgt: Tsgt, drive: UncalibratedDrive, recording: Path, tmp_path: Path
) -> None:
    """What is written is what was found, and that is the truth within a few sigmas."""
    output = tmp_path / "imu.toml"
    done = tsgt("calibrate", "imu", recording, "--output", output, "--json")
    assert done.code == 0, done.err
    assert "mounting of the IMU with its covariance written" in done.err
    found = done.json()
    mounting = load_imu_mounting(output)
    np.testing.assert_allclose(np.array(mounting.position_m) * 1e3, found["lever_arm_mm"])
    assert mounting.latency_ns / 1e6 == pytest.approx(found["offset_ms"])
    rotation = rotation_from_quaternion(np.array(mounting.orientation_xyzw))
    np.testing.assert_allclose(np.degrees(log_so3(rotation)), found["rotation_deg"])
    np.testing.assert_allclose(mounting.gyro_matrix, found["gyro_matrix"])
    assert mounting.covariance is not None
    assert len(mounting.covariance.components) == 16

    truth = drive.truth
    error_deg = np.degrees(log_so3(truth.mounting.rotation.T @ rotation))
    assert np.abs(truth.mounting.rotation @ error_deg / found["rotation_deg_sigma"]).max() < 4
    error_mm = np.array(found["lever_arm_mm"]) - 1e3 * (truth.mounting.position + drive.centroid_m)
    assert np.abs(error_mm / found["lever_arm_mm_sigma"]).max() < 4
    assert abs(found["offset_ms"] - 4.3) < 4 * found["offset_ms_sigma"]
    named = [each["name"] for each in found["observability"]]
    assert named[:4] == [
        *(f"rotation about the robot's {axis}" for axis in "xyz"),
        "position along the robot's x",
    ]


@pytest.mark.slow
def test_table_and_notes(tsgt: Tsgt, recording: Path) -> None:
    """Values stand beside their sigmas and what was configured."""
    done = tsgt("calibrate", "imu", recording)
    assert done.code == 0
    assert "robot frame" in done.out
    assert "calibrated in the factory" in done.out


@pytest.mark.slow
def test_halves_that_disagree_fail(tsgt: Tsgt, drive: UncalibratedDrive, tmp_path: Path) -> None:
    """An IMU that is knocked half-way is not calibrated: exit code 3, and no file."""
    samples = drive.samples
    angle = np.radians(4.0)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    later = samples.end_s[:, None] > 32.0
    knocked = replace(
        samples,
        angular_rate_radps=np.where(later, samples.angular_rate_radps @ turn, samples.angular_rate_radps),
        specific_force_mps2=np.where(later, samples.specific_force_mps2 @ turn, samples.specific_force_mps2),
    )
    path, output = tmp_path / "knocked.jsonl", tmp_path / "imu.toml"
    write_imu_recording(path, replace(drive, samples=knocked))
    done = tsgt("calibrate", "imu", path, "--output", output)
    assert done.code == 3
    assert "the halves of the drive disagree in rotation" in done.err
    assert not output.exists()


@pytest.mark.parametrize(
    ("missing", "problem"),
    [("imu", "no samples of the IMU"), ("point", "has no measurements")],
)
def test_recording_without_data(
    tsgt: Tsgt, recording: Path, tmp_path: Path, missing: str, problem: str
) -> None:
    """Samples and measurements are needed."""
    path = tmp_path / "part.jsonl"
    lines = recording.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(line for line in lines if f'"type":"{missing}"'.encode() not in line))
    done = tsgt("calibrate", "imu", path)
    assert done.code == 1
    assert problem in done.err


def test_recording_without_imu(recording: Path) -> None:
    """A master without the table [imu]."""
    loaded = load_recording(recording)
    without = replace(loaded, parameters=replace(loaded.parameters, imu=None))
    with pytest.raises(GeometryError, match="the recording has no IMU"):
        calibrate_recorded_imu(without, read_imu_samples(recording))


def test_two_prisms_do_not_calibrate(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """The message says what does."""
    path = tmp_path / "two.jsonl"
    lines = recording.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(line for line in lines if b'"point","station":3' not in line))
    done = tsgt("calibrate", "imu", path)
    assert done.code == 1
    assert (
        "two prisms leave the rotation of the IMU about their line undetermined: calibrate once with 3"
        in done.err
    )


@pytest.mark.slow
def test_imported_samples_are_calibrated(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """Of a recording that knows no IMU; class and gravity go into the file, which then describes the IMU completely."""
    lines = recording.read_bytes().splitlines(keepends=True)
    samples, rest = (
        [line for line in lines if line.startswith(b'{"type":"imu"') == wanted] for wanted in (True, False)
    )
    loaded = load_recording(recording).parameters
    bare, imported, output = tmp_path / "bare.jsonl", tmp_path / "imu.jsonl", tmp_path / "imu.toml"
    parameters = encode_line(replace(loaded, imu=None)) + b"\n"
    bare.write_bytes(b"".join([rest[0], parameters, *rest[2:]]))
    imported.write_bytes(b"".join([lines[0], *samples]))
    assert tsgt("calibrate", "imu", bare, "--imu", imported, "--noise", "industrial").code == 2
    given = ("--imu", imported, "--noise", "industrial", "--gravity-mps2", "9.81", "--output", output)
    assert tsgt("calibrate", "imu", bare, *given).code == 0
    known = load_imu_mounting(output).parameters()
    assert known is not None
    assert known.gravity_mps2 == 9.81
    assert known.noise == IMU_NOISE["industrial"]
