"""``tsgt import polar``: exported measurements become a recording again."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import pytest
from harness.drives.scene import LAYOUT
from harness.files.authors_files import CONSTANTS, write_prisms, write_targets, write_tracks

from tsgt.recording import load_recording

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt


@pytest.fixture
def recording(tsgt: Tsgt, tmp_path: Path) -> Path:
    """Raw measurements of a drive, with frames solved from targets."""
    path = tmp_path / "drive.jsonl"
    sources = ("--prisms", write_prisms(tmp_path), "--targets", write_targets(tmp_path), *CONSTANTS)
    outcome = tsgt("import", "rts", "--tracks", *write_tracks(tmp_path), *sources, "--output", path)
    assert outcome.code == 0, outcome.err
    return path


def exported(tsgt: Tsgt, recording: Path) -> Path:
    """Export its measurements as CSV."""
    path = recording.with_name("measurements.csv")
    outcome = tsgt("export", recording, "--format", "csv", "--records", "measurements", "--output", path)
    assert outcome.code == 0, outcome.err
    return path


def imported(tsgt: Tsgt, tracks: Path, *where: object, constant_mm: float = 10.0) -> Path:
    """Import them again."""
    path = tracks.with_name("again.jsonl")
    prisms = tracks.with_name("sensor_positions.csv")
    options = ("--prisms", prisms, "--prism-constant-mm", constant_mm, *where)
    outcome = tsgt("import", "polar", "--tracks", tracks, *options, "--output", path, "--json")
    assert outcome.code == 0, outcome.err
    assert outcome.json()["measurements"] == 75
    return path


def test_import_with_targets_restores_the_recording(tsgt: Tsgt, recording: Path) -> None:
    """Measurements, frames, prisms and target residuals are equal."""
    targets = recording.with_name("GCP.txt")
    again = imported(tsgt, exported(tsgt, recording), "--targets", targets, *CONSTANTS[:2])
    first, second = (load_recording(path, keep_going=False) for path in (recording, again))
    assert second.measurements == first.measurements
    assert second.parameters == first.parameters
    assert [target.target for target in second.parameters.stations[1].targets] == [1, 2, 3, 4, 5]


def test_import_with_calibrated_frames(tsgt: Tsgt, recording: Path) -> None:
    """The set-up file has frames and target residuals, to a micrometre."""
    frames = recording.with_name("frames.toml")
    targets = recording.with_name("GCP.txt")
    solving = ("--target-constant-mm", 10, "--output", frames)
    assert tsgt("calibrate", "targets", targets, *solving).code == 0
    again = load_recording(imported(tsgt, exported(tsgt, recording), "--frames", frames), keep_going=False)
    wanted = load_recording(recording, keep_going=False).parameters
    for found, station in zip(again.parameters.stations, wanted.stations, strict=True):
        assert found.T_station1_station == station.T_station1_station
        assert [t.target for t in found.targets] == [t.target for t in station.targets]
        for a, b in zip(found.targets, station.targets, strict=True):
            assert a.residual_m == pytest.approx(b.residual_m, abs=1e-6)
            assert a.leave_one_out_m == pytest.approx(b.leave_one_out_m, abs=1e-6)


def test_replaced_frames_drop_the_recorded_residuals(tsgt: Tsgt, recording: Path) -> None:
    """Recorded target residuals do not belong to other frames."""
    frames, poses = recording.with_name("frames.toml"), recording.with_name("poses.jsonl")
    parameters = json.loads(recording.read_text(encoding="utf-8").splitlines()[1])
    tables = [
        f"[stations.{s['station']}]\nT_station1_station = {json.dumps(s['T_station1_station'])}\n"
        for s in parameters["stations"]
    ]
    frames.write_text("\n".join(['kind = "station_frames"', *tables]), encoding="utf-8")
    outcome = tsgt("process", recording, "--estimator", "linear", "--frames", frames, "--output", poses)
    assert outcome.code == 0, outcome.err
    assert all(not s.targets for s in load_recording(poses, keep_going=False).parameters.stations)


@pytest.mark.parametrize("given", [(), ("--frames", "frames.toml", "--targets", "GCP.txt")])
def test_frames_and_targets_exclude_each_other(tsgt: Tsgt, recording: Path, given: tuple[str, ...]) -> None:
    """Neither and both are rejected."""
    options = ("--prisms", recording.with_name("sensor_positions.csv"), *given, *CONSTANTS[2:])
    out = recording.with_name("no.jsonl")
    outcome = tsgt("import", "polar", "--tracks", exported(tsgt, recording), *options, "--output", out)
    assert outcome.code == 2
    assert "give --frames or --targets" in outcome.err
    assert not out.exists()


def test_invalid_line_is_named(tsgt: Tsgt, recording: Path) -> None:
    """One line with file and line number; no recording is written."""
    tracks = exported(tsgt, recording)
    lines = tracks.read_text(encoding="utf-8").splitlines()
    lines[3] = lines[3].replace(",ok,", ",good,")
    tracks.write_text("\n".join(lines), encoding="utf-8")
    out = recording.with_name("no.jsonl")
    sources = (
        "--prisms",
        recording.with_name("sensor_positions.csv"),
        "--targets",
        recording.with_name("GCP.txt"),
        *CONSTANTS,
    )
    outcome = tsgt("import", "polar", "--tracks", tracks, *sources, "--output", out)
    assert outcome.code == 1
    assert outcome.err.splitlines()[-1].startswith(f"error: {tracks}, line 4: status is 'good'")
    assert not out.exists()


def test_cut_track_is_imported_with_a_note(tsgt: Tsgt, recording: Path) -> None:
    """A last line without line end may lack digits."""
    tracks = exported(tsgt, recording)
    tracks.write_bytes(tracks.read_bytes()[:-1])
    out = recording.with_name("cut.jsonl")
    sources = (
        "--prisms",
        recording.with_name("sensor_positions.csv"),
        "--targets",
        recording.with_name("GCP.txt"),
    )
    done = tsgt("import", "polar", "--tracks", tracks, *sources, *CONSTANTS, "--output", out)
    assert done.code == 0, done.err
    assert f"note: {tracks}: the last line has no line end" in done.err


def test_bytes_of_names_that_are_not_utf8_are_replaced(tsgt: Tsgt, recording: Path) -> None:
    """The header names the files, whose names a system with Latin-1 has written."""
    tracks = exported(tsgt, recording)
    tracks = tracks.rename(tracks.with_name(os.fsdecode(b"m\xe4.csv")))
    again = imported(tsgt, tracks, "--targets", recording.with_name("GCP.txt"), *CONSTANTS[:2])
    header = json.loads(again.read_text(encoding="utf-8").splitlines()[0])
    assert header["source"] == "import polar: m\ufffd.csv sensor_positions.csv GCP.txt"


def test_two_stations_are_imported_with_a_note(tsgt: Tsgt, recording: Path) -> None:
    """Their poses need an IMU, whose samples and set-up are given when they are computed."""
    tracks, prisms = exported(tsgt, recording), recording.with_name("prisms.toml")
    lines = tracks.read_text(encoding="utf-8").splitlines(keepends=True)
    tracks.write_text("".join(line for line in lines if ",3,3," not in line), encoding="utf-8")
    tables = [
        f"[prisms.{k}]\nposition_m = {position}\n" for k, position in enumerate(LAYOUT.tolist(), start=1)
    ]
    prisms.write_text("\n".join(['kind = "prism_layout"', *tables]), encoding="utf-8")
    two = recording.with_name("two.jsonl")
    sources = ("--prisms", prisms, "--targets", recording.with_name("GCP.txt"), *CONSTANTS)
    done = tsgt("import", "polar", "--tracks", tracks, *sources, "--output", two)
    assert done.code == 0, done.err
    needed = "a pose needs at least 3 prisms on the robot, or an IMU and one: the layout has 2"
    assert f"note: {prisms}: {needed}; tsgt process needs --imu and --imu-setup" in done.err
    parameters = load_recording(two).parameters
    assert [(station.station, station.prism) for station in parameters.stations] == [(1, 1), (2, 2)]
    assert [each.position_m for each in parameters.prisms] == [tuple(each) for each in LAYOUT.tolist()[:2]]
    processed = tsgt("process", two, "--output", two.with_suffix(".tum"))
    assert (processed.code, needed in processed.err) == (1, True)


def test_layout_keeps_its_covariance(tsgt: Tsgt, recording: Path) -> None:
    """Of the prisms that were tracked, beside that of the frames."""
    tracks, prisms = exported(tsgt, recording), recording.with_name("prisms.toml")
    tables = [
        f"[prisms.{k}]\nposition_m = {position}\nsigma_m = [0.001, 0.001, 0.002]\n"
        for k, position in enumerate([*LAYOUT.tolist(), [1.0, 2.0, 3.0]], start=1)
    ]
    prisms.write_text("\n".join(['kind = "prism_layout"', *tables]), encoding="utf-8")
    output = recording.with_name("again.jsonl")
    sources = ("--prisms", prisms, "--targets", recording.with_name("GCP.txt"), *CONSTANTS)
    done = tsgt("import", "polar", "--tracks", tracks, *sources, "--output", output)
    assert (done.code, done.err) == (0, "")
    known = load_recording(output).parameters.setup_covariance
    assert known is not None
    names = known.components
    assert "station2.x" in names
    assert [name for name in names if name.startswith("prism")] == [
        f"prism{k}.{axis}" for k in (1, 2, 3) for axis in "xyz"
    ]
    at = names.index("prism2.z")
    assert known.matrix[at][at] == pytest.approx(4e-6)
