"""``tsgt calibrate motion`` on a simulated and on a published drive."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.authors_files import CONSTANTS, write_prisms, write_targets, write_tracks

from tsgt.analysis.calibration import CalibratedRecording, HeldOutComparison, calibrate_recording
from tsgt.analysis.evaluation import HeldOutErrors
from tsgt.config import load_station_calibration
from tsgt.errors import GeometryError
from tsgt.geometry import exp_so3
from tsgt.geometry.motion_calibration import SetupPrior
from tsgt.model import InstrumentNoise
from tsgt.recording import load_recording

if TYPE_CHECKING:
    from pathlib import Path

    from harness.drives.scene import Motion
    from harness.files.cli import Tsgt


def winding(time_s: float) -> Motion:
    """Return rotation and position of a robot that winds its way over uneven ground."""
    around = 0.1 * time_s
    tilt = exp_so3(np.array([0.05 * np.sin(5 * around), 0.05 * np.cos(4 * around), 0.0]))
    place = [40 + 12 * np.sin(around), 10 + 8 * np.sin(2 * around), -1 + 0.5 * np.sin(3.1 * around)]
    return exp_so3(np.array([0.0, 0.0, 0.5 * around])) @ tilt, np.array(place)


@pytest.fixture
def recording(tsgt: Tsgt, tmp_path: Path) -> Path:
    """Return a minute of exact measurements."""
    path = tmp_path / "recording.jsonl"
    tracks = write_tracks(tmp_path, winding, duration_s=60.0)
    done = tsgt(
        "import", "rts", "--tracks", *tracks, "--prisms", write_prisms(tmp_path),
        "--targets", write_targets(tmp_path), *CONSTANTS, "--output", path,
    )  # fmt: skip
    assert done.code == 0
    return path


@pytest.mark.slow
def test_exact_measurements_need_no_correction(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """Corrections are far below a millimetre, and the file agrees with the JSON output."""
    output = tmp_path / "frames.toml"
    done = tsgt("calibrate", "motion", recording, "--no-held-out", "--output", output, "--json")
    assert done.code == 0
    found = done.json()
    assert list(found["stations"]) == ["2", "3"]
    for station in found["stations"].values():
        assert station["correction_mm"] < 1.0
        assert abs(station["latency_ms"]) < 0.5
        assert len(station["sigma_mm"]) == len(station["sigma_mrad"]) == 3
    assert found["before"] is found["after"] is None
    calibration = load_station_calibration(output)
    stations = calibration.stations
    known = calibration.covariance
    assert known is not None
    assert len(known.components) == 14  # frames and latencies of two stations
    at = known.components.index("station2.latency")
    assert 1e3 * np.sqrt(known.matrix[at][at]) == pytest.approx(found["stations"]["2"]["latency_sigma_ms"])
    assert sorted(stations) == [1, 2, 3]
    assert [list(row) for row in stations[2].T_station1_station] == found["stations"]["2"][
        "T_station1_station"
    ]
    assert stations[3].latency_ns == round(1e6 * found["stations"]["3"]["latency_ms"])


@pytest.mark.slow
def test_result_is_independent_of_the_robot_origin(recording: Path) -> None:
    """With the origin some metres off the prisms the same frames and the same motion result."""
    near = load_recording(recording)
    prisms = tuple(
        replace(each, position_m=(each.position_m[0] + 3.0, each.position_m[1] - 1.0, each.position_m[2]))
        for each in near.parameters.prisms
    )
    far = replace(near, parameters=replace(near.parameters, prisms=prisms))
    known = SetupPrior(translation_sigma_m=0.02, rotation_sigma_rad=0.002, latency_sigma_s=0.1)
    one, other = (calibrate_recording(each, known, held_out=False) for each in (near, far))
    for found, given in zip(other.parameters.prisms, prisms, strict=True):
        assert found.position_m == pytest.approx(given.position_m)
    assert other.calibration.setup.frames == pytest.approx(one.calibration.setup.frames, abs=1e-6)
    assert other.calibration.prior.angular_acceleration_sigma_radps2 == pytest.approx(
        one.calibration.prior.angular_acceleration_sigma_radps2, rel=1e-2
    )


def test_noise_of_zero_is_refused(recording: Path) -> None:
    """It gives no weights; the error says which values are 0, and where they are set."""
    loaded = load_recording(recording)
    exact = InstrumentNoise(range_sigma_m=0, range_sigma_ppm=0, angle_sigma_rad=0, pointing_sigma_m=0)
    stations = tuple(replace(station, noise=exact) for station in loaded.parameters.stations)
    loaded = replace(loaded, parameters=replace(loaded.parameters, stations=stations))
    known = SetupPrior(translation_sigma_m=0.02, rotation_sigma_rad=0.002)
    message = r"range_sigma_m, range_sigma_ppm, angle_sigma_rad and pointing_sigma_m of all stations are 0 .*\[stations.noise\]"
    with pytest.raises(GeometryError, match=message):
        calibrate_recording(loaded, known, held_out=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (
            ("--initial-frames", "unknown", "--frame-sigma-mm", 3),
            "--frame-sigma-mm has no effect with --initial-frames",
        ),
        (("--initial-frames", "unknown", "--latency-sigma-ms", 3), "--latency-sigma-ms has no effect"),
        (("--no-latency", "--latency-sigma-ms", 3), "--latency-sigma-ms has no effect with --no-latency"),
        (("--prism-sigma-mm", 3), "--prism-sigma-mm has no effect without --estimate-prisms"),
    ],
)
def test_sigmas_without_effect_are_refused(
    tsgt: Tsgt, recording: Path, arguments: tuple[object, ...], complaint: str
) -> None:
    """The result would pass for one with this prior."""
    done = tsgt("calibrate", "motion", recording, *arguments)
    assert done.code == 2
    assert complaint in done.err


def test_missing_folder_is_noticed_before_the_calibration(
    tsgt: Tsgt, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes minutes."""
    monkeypatch.setattr("tsgt.cli.calibrate.motion.calibrate_recording", None)
    done = tsgt("calibrate", "motion", recording, "--output", tmp_path / "missing" / "frames.toml")
    assert done.code == 1
    assert "cannot be written (No such file or directory)" in done.err


def test_text_names_the_stations(tsgt: Tsgt, recording: Path) -> None:
    """Without --json the output is a table."""
    done = tsgt(
        "calibrate",
        "motion",
        recording,
        "--no-held-out",
        "--initial-frames",
        "unknown",
        "--dof",
        "4",
        "--estimate-prisms",
    )
    assert done.code == 0
    assert "station 2 x" in done.out
    assert "latency relative to station 1" in done.out


@pytest.mark.parametrize(
    ("after_mm", "code", "said"),
    [([6.0], 3, "check failed: the held-out prediction error is larger"), ([], 0, "was not validated")],
)
def test_held_out_error_is_judged_or_the_command_says_so(
    tsgt: Tsgt,
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    after_mm: list[float],
    code: int,
    said: str,
) -> None:
    """All measurements at gaps, and none held out."""
    before, after = (
        HeldOutErrors(np.array(each) / 1e3, np.ones(len(each), np.bool_))
        for each in ([5.0] * len(after_mm), after_mm)
    )

    def calibrate(*args: Any, **options: Any) -> CalibratedRecording:
        found = calibrate_recording(*args, **options | {"held_out": False})
        return replace(found, held_out=HeldOutComparison(before, before, after))

    monkeypatch.setattr("tsgt.cli.calibrate.motion.calibrate_recording", calibrate)
    done = tsgt("calibrate", "motion", recording)
    assert (done.code, said in done.err) == (code, True)


def test_range_scale_is_kept_and_applied_once(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """The frames were solved with it; the file replaces that of the recording, or of the master's configuration."""
    lines = recording.read_text(encoding="utf-8").splitlines()
    parameters = json.loads(lines[1])
    for station, ppm in zip(parameters["stations"], (0.0, 20.0, -5.0), strict=True):
        station["atmospheric_ppm"] = ppm
    recording.write_text("\n".join([lines[0], json.dumps(parameters), *lines[2:], ""]), encoding="utf-8")
    frames, poses = tmp_path / "frames.toml", tmp_path / "poses.jsonl"
    assert tsgt("calibrate", "motion", recording, "--no-held-out", "--output", frames).code == 0
    stations = load_station_calibration(frames).stations
    assert [stations[k].range_scale_ppm for k in (1, 2, 3)] == [None, 20.0, -5.0]
    options = ["--estimator", "linear", "--frames", frames, "--output", poses]
    assert tsgt("process", recording, *options).code == 0
    used = load_recording(poses).parameters.stations
    assert [each.atmospheric_ppm for each in used] == [0.0, 20.0, -5.0]
    assert [stations[each.station].applied(each).atmospheric_ppm for each in used] == [0.0, 20.0, -5.0]


def test_recording_with_a_time_of_a_wrong_clock_is_rejected(tsgt: Tsgt, recording: Path) -> None:
    """Two epochs per second over years would take forever."""
    last = json.loads(recording.read_text(encoding="utf-8").splitlines()[-1])
    last["stamp_ns"] = last["received_ns"] = last["stamp_ns"] + 1000 * 86_400 * 10**9
    with recording.open("a", encoding="utf-8") as file:
        file.write(json.dumps(last | {"sequence": last["sequence"] + 1}) + "\n")
    outcome = tsgt("calibrate", "motion", recording, "--initial-frames", "unknown")
    assert (outcome.code, "its measurements span 1000.0 days" in outcome.err) == (1, True)


def test_recording_of_points_is_rejected(tsgt: Tsgt, tmp_path: Path) -> None:
    """A recording imported without targets has no raw measurements."""
    path = tmp_path / "points.jsonl"
    tracks = write_tracks(tmp_path, winding)
    assert (
        tsgt("import", "rts", "--tracks", *tracks, "--prisms", write_prisms(tmp_path), "--output", path).code
        == 0
    )
    done = tsgt("calibrate", "motion", path)
    assert done.code == 1
    assert "import the recording with its targets" in done.err


def test_prism_output_needs_estimate_prisms(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """--prism-output without --estimate-prisms is a usage error before any computation."""
    assert tsgt("calibrate", "motion", recording, "--prism-output", tmp_path / "prisms.toml").code == 2


def test_frames_and_prisms_need_a_file_each(tsgt: Tsgt, recording: Path, tmp_path: Path) -> None:
    """The second would replace the first."""
    (tmp_path / "sub").mkdir()
    outputs = ("--output", tmp_path / "a.toml", "--prism-output", tmp_path / "sub" / ".." / "a.toml")
    done = tsgt("calibrate", "motion", recording, "--estimate-prisms", *outputs)
    assert done.code == 2
    assert "--output and --prism-output are the same file" in done.err
    assert not (tmp_path / "a.toml").exists()


@pytest.mark.slow
def test_published_drive_has_smaller_held_out_errors(tsgt: Tsgt, field_data: Path, tmp_path: Path) -> None:
    """The held-out error is at most 0.45 times that of linear interpolation, 0.35 times in gaps."""
    day = field_data / "20220314"
    path = tmp_path / "r.jsonl"
    tracks = [day / f"trimble{k}.csv" for k in (1, 2, 3)]
    done = tsgt(
        "import", "rts", "--tracks", *tracks, "--prisms", day / "sensor_positions.csv",
        "--targets", day / "GCP.txt", *CONSTANTS, "--output", path,
    )  # fmt: skip
    assert done.code == 0
    done = tsgt("calibrate", "motion", path, "--json")
    assert done.code == 0
    found = done.json()
    linear, before, after = found["linear"], found["before"], found["after"]
    assert linear["n"] == before["n"] == after["n"]
    assert after["mean"] < 0.45 * linear["mean"]
    assert after["mean"] < before["mean"]
    assert after["p95"] < 0.45 * linear["p95"]
    assert after["gaps"]["mean"] < 0.35 * linear["gaps"]["mean"]
