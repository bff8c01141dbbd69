"""``process``, ``evaluate`` and ``export`` with the robot's IMU."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.records import HEADER, SECOND, START
from harness.inertial.imu_recording import IMU, imu_recording, shaken_drive, write

from tsgt.analysis.formats import write_imu_mounting
from tsgt.analysis.report import collect_findings, report_numbers, report_sections
from tsgt.model import OdometryParameters, OdometrySamples, SetupCovariance
from tsgt.recording import encode_line

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt
    from harness.inertial.inertial_drive import InertialDrive


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of two stations with an IMU, the same of a master without one, its samples and its set-up."""
    path = tmp_path_factory.mktemp("imu")
    recording = imu_recording(shaken_drive(22.0), stations=2)
    write(path / "with.jsonl", recording)
    without = replace(recording.parameters, imu=None)
    write(path / "without.jsonl", replace(recording, parameters=without, imu_samples=[]))
    lines = [encode_line(record) + b"\n" for record in (HEADER, *recording.imu_samples)]
    (path / "samples.jsonl").write_bytes(b"".join(lines))
    covariance = SetupCovariance(components=("imu.x",), matrix=((1e-6,),))
    write_imu_mounting(path / "imu.toml", IMU, comment="by a test", covariance=covariance)
    return path


def positions(path: Path) -> np.ndarray:
    """Return stamps and positions of a TUM file, (N, 4)."""
    return np.loadtxt(path)[:, :4]


@pytest.mark.slow
def test_imported_samples_are_worth_the_recorded_ones(tsgt: Tsgt, folder: Path, tmp_path: Path) -> None:
    """With the file of a calibration, which describes the IMU."""
    done = tsgt("process", folder / "with.jsonl", "--output", tmp_path / "a.tum")
    assert "IMU: used with stations 1, 2" in done.out
    imported = ("--imu", folder / "samples.jsonl", "--imu-setup", folder / "imu.toml")
    result = tsgt(
        "process", folder / "without.jsonl", *imported, "--output", tmp_path / "b.tum", "--json"
    ).json()
    assert result["imu"]["stations"] == [1, 2]
    np.testing.assert_allclose(positions(tmp_path / "b.tum"), positions(tmp_path / "a.tum"), atol=1e-6)


@pytest.mark.parametrize(
    ("recording", "options", "message"),
    [
        ("with", ("--no-imu",), "an IMU"),
        ("without", (), "an IMU"),
        ("without", ("--imu", "samples.jsonl"), "give --imu-setup"),
        ("with", ("--no-imu", "--imu-setup", "imu.toml"), "exclude each other"),
    ],
)
def test_two_stations_need_the_imu(
    tsgt: Tsgt, folder: Path, tmp_path: Path, recording: str, options: tuple[str, ...], message: str
) -> None:
    """And both its samples and its parameters."""
    given = [option if option.startswith("--") else folder / option for option in options]
    done = tsgt("process", folder / f"{recording}.jsonl", *given, "--output", tmp_path / "a.tum")
    assert done.code in (1, 2)
    assert message in done.err


@pytest.mark.parametrize("command", ["process", "evaluate", "export"])
def test_wheels_without_an_imu_are_refused(tsgt: Tsgt, folder: Path, tmp_path: Path, command: str) -> None:
    """They are used with an IMU only, and the same poses would pass for poses with wheels."""
    wheels, output = tmp_path / "wheels.jsonl", tmp_path / "a.tum"
    wheels.write_bytes(
        encode_line(HEADER) + b"\n" + encode_line(driven(shaken_drive(22.0), 1.0, scale=1.0)) + b"\n"
    )
    arguments = () if command == "evaluate" else ("--output", output)
    done = tsgt(command, folder / "without.jsonl", "--wheel-odometry", wheels, *arguments)
    assert done.code == 2
    assert "wheel odometry is used with one only" in done.err
    assert not output.exists()


@pytest.mark.parametrize(
    ("shift_ns", "message"),
    [(None, "contains no wheel odometry"), (86_400 * SECOND, "do not overlap with the measurements in time")],
)
def test_wheels_without_effect_are_refused(
    tsgt: Tsgt, folder: Path, tmp_path: Path, shift_ns: int | None, message: str
) -> None:
    """A file without any, as of the samples of the IMU, and that of another day."""
    wheels, output = folder / "samples.jsonl", tmp_path / "a.tum"
    if shift_ns is not None:
        wheels = tmp_path / "wheels.jsonl"
        other = later(driven(shaken_drive(22.0), 1.0, scale=1.0), shift_ns)
        wheels.write_bytes(encode_line(HEADER) + b"\n" + encode_line(other) + b"\n")
    done = tsgt("process", folder / "with.jsonl", "--wheel-odometry", wheels, "--output", output)
    assert done.code == 1
    (line,) = done.err.splitlines()
    assert line.startswith(f"error: {wheels}: ")
    assert message in line
    assert not output.exists()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--refine", "prisms"), "--refine prisms"),
        (("--imu", "samples.jsonl", "--imu-setup", "imu.toml"), "--imu and --imu-setup"),
    ],
)
def test_linear_refuses_what_it_does_not_use(
    tsgt: Tsgt, folder: Path, tmp_path: Path, options: tuple[str, ...], named: str
) -> None:
    """Its poses would pass for poses with an IMU, or with refined prisms."""
    given = [folder / option if "." in option else option for option in options]
    output = tmp_path / "a.tum"
    done = tsgt("process", folder / "with.jsonl", "--estimator", "linear", *given, "--output", output)
    assert done.code == 2
    assert f"does not use {named}; the estimator continuous does" in done.err
    assert not output.exists()


@pytest.mark.slow
def test_export_gives_poses_of_the_imu_by_its_name(tsgt: Tsgt, folder: Path, tmp_path: Path) -> None:
    """The points of the robot have names."""
    output = tmp_path / "imu.tum"
    assert tsgt("export", folder / "with.jsonl", "--point", "imu", "--output", output).code == 0
    robot = tmp_path / "robot.tum"
    assert tsgt("process", folder / "with.jsonl", "--output", robot).code == 0
    distances = np.linalg.norm(positions(output)[:, 1:] - positions(robot)[:, 1:], axis=1)
    np.testing.assert_allclose(distances, np.linalg.norm(IMU.position_m), atol=1e-5)
    done = tsgt("export", folder / "with.jsonl", "--point", "lidar", "--output", output)
    assert done.code == 2
    assert "there are robot, centroid, imu" in done.err


@pytest.mark.slow
def test_evaluate_predicts_held_out_measurements_with_the_imu(tsgt: Tsgt, folder: Path) -> None:
    """Better than by interpolation; without the IMU two stations predict nothing else."""
    found = tsgt("evaluate", folder / "with.jsonl", "--json").json()["held_out_mm"]
    assert set(found) == {"linear", "continuous_imu"}
    assert found["continuous_imu"]["mean"] < 0.5 * found["linear"]["mean"]


@pytest.mark.slow
def test_report_shows_imu_and_wheels(tmp_path: Path) -> None:
    """Rate, biases with sigmas, the gyro against the prisms, scale and slip; what the samples were made with is found."""
    path = tmp_path / "field.jsonl"
    drive = shaken_drive(22.0)
    recording = imu_recording(drive)
    parameters = replace(recording.parameters, odometry=OdometryParameters())
    recording = replace(recording, parameters=parameters, odometry=[driven(drive, 21.9, scale=0.98)])
    write(path, recording)
    found = collect_findings(recording, path, reference=None, with_held_out=False, refine="off")
    numbers = report_numbers(found)["imu_quality"]
    assert numbers["rate_hz"] == pytest.approx(200.0)
    assert numbers["gaps"] == 0
    innovation = numbers["rotation_innovation_deg"]
    assert innovation["rms"] < 1.5 * innovation["expected"]
    assert max(numbers["gyro_bias_sigma_dps"]) < 0.05
    wheels = numbers["odometry"]
    assert wheels["samples"] == 436  # of 438, within the time of the measurements
    assert wheels["covered"] > 0.95
    assert wheels["scale"] == pytest.approx(1 / 0.98 - 1, abs=3 * wheels["scale_sigma"])
    assert wheels["slip_rms"] < 0.02
    assert wheels["rejected"] < 0.05
    (section,) = [each for each in report_sections(found) if each.title == "IMU of the robot"]
    assert "stations 1, 2, 3" in section.text[0]
    assert "Wheel odometry" in [table.caption for table in section.tables]
    section.plots[0].write([tmp_path / "biases.png"])
    assert (tmp_path / "biases.png").stat().st_size > 1000


def driven(drive: InertialDrive, until_s: float, *, scale: float) -> OdometrySamples:
    """Return the speed of a drive as wheel odometry at 20 Hz, with a scale."""
    time_s = np.arange(0.0, until_s + 1e-9, 0.05)
    position, rotation = drive.pose_at(time_s)
    moved = np.einsum("nji,nj->ni", rotation[:-1], np.diff(position, axis=0))[:, 0]
    stamps = tuple(START + round(1e9 * each) for each in time_s[1:].tolist())
    return OdometrySamples(
        sequence=0,
        received_ns=stamps[-1],
        stamp_ns=stamps,
        duration_ns=(50_000_000,) * len(stamps),
        instrument_time_ns=None,
        speed_mps=tuple((scale * moved / 0.05).tolist()),
        yaw_rate_radps=None,
        valid=(True,) * len(stamps),
    )


def later(samples: OdometrySamples, shift_ns: int) -> OdometrySamples:
    """Return samples of another time."""
    return replace(samples, stamp_ns=tuple(stamp_ns + shift_ns for stamp_ns in samples.stamp_ns))


@pytest.mark.slow
@pytest.mark.parametrize("stations", [1, 2])
def test_one_and_two_stations_are_evaluated(tsgt: Tsgt, tmp_path: Path, stations: int) -> None:
    """Text and report, without distances between three prisms; linear has no poses, and is not held against them."""
    path, truth = tmp_path / "field.jsonl", tmp_path / "truth.tum"
    write(path, imu_recording(shaken_drive(22.0), stations=stations))
    assert tsgt("process", path, "--output", truth).code == 0
    text = tsgt("evaluate", path, "--no-held-out", "--reference", truth)
    assert text.code == 0, text.err
    assert "IMU: used with station" in text.out
    assert ("Distances between prisms" in text.out) is (stations == 2)
    assert "No valid pose of linear" not in text.out
    done = tsgt("evaluate", path, "--no-held-out", "--report", tmp_path / "report")
    assert done.code == 0, done.err
    assert "IMU of the robot" in (tmp_path / "report" / "report.html").read_text()
