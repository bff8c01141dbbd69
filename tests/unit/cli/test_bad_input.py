"""Invalid input: one line on stderr, a non-zero exit code, and no output file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import LAYOUT
from harness.files.authors_files import CONSTANTS, write_prisms, write_targets, write_tracks

if TYPE_CHECKING:
    from collections.abc import Callable

    from harness.files.cli import Tsgt
    from numpy.typing import NDArray

TRACK_EDITS: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
    "empty file": (lambda _: [], "contains no positions"),
    "wrong column count": (
        lambda lines: [*lines[:4], lines[4] + " 1.0", *lines[5:]],
        "line 5: expected 4 columns",
    ),
    "NaN": (
        lambda lines: [*lines[:4], _with_last(lines[4], "nan"), *lines[5:]],
        "line 5: expected a finite number",
    ),
    "infinity": (
        lambda lines: [*lines[:4], _with_last(lines[4], "inf"), *lines[5:]],
        "line 5: expected a finite",
    ),
    "text": (lambda lines: ["time x y z", *lines], "line 1: expected a Unix time"),
    "a giant word": (
        lambda lines: [*lines[:4], _with_last(lines[4], "9" * 100_000), *lines[5:]],
        f"line 5: expected a finite number, got '{'9' * 56}...\n",
    ),
    "unsorted time stamps": (lambda lines: [lines[1], lines[0], *lines[2:]], "line 2: time decreases"),
    "repeated time stamps": (
        lambda lines: [lines[0], *lines],
        "line 2: duplicate time 1700000000.1100123",
    ),
}


def _with_last(line: str, word: str) -> str:
    return " ".join([*line.split()[:-1], word])


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Return valid files, for a test to spoil one of them."""
    one, two, three = write_tracks(tmp_path)
    return {
        "track1": one,
        "track2": two,
        "track3": three,
        "prisms": write_prisms(tmp_path),
        "targets": write_targets(tmp_path),
        "recording": tmp_path / "recording.jsonl",
        "poses": tmp_path / "poses.tum",
    }


def import_arguments(files: dict[str, Path]) -> list[object]:
    """Return arguments that import the files without their targets."""
    tracks = [files["track1"], files["track2"], files["track3"]]
    return ["import", "rts", "--tracks", *tracks, "--prisms", files["prisms"], "--output", files["recording"]]


def assert_refused(tsgt: Tsgt, arguments: list[object], output: Path, expected: str) -> None:
    """Check the exit code, the one line, and that the folder is unchanged."""
    before = {path: path.stat().st_mtime_ns for path in output.parent.iterdir()}
    outcome = tsgt(*arguments)
    assert outcome.code == 1
    assert outcome.out == ""
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1
    assert expected in outcome.err
    assert {path: path.stat().st_mtime_ns for path in output.parent.iterdir()} == before


def test_tracks_may_be_given_one_by_one(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The option takes several files, and may be repeated."""
    tracks = [word for k in (1, 2, 3) for word in ("--tracks", files[f"track{k}"])]
    others = ["--prisms", files["prisms"], "--output", files["recording"]]
    assert tsgt("import", "rts", *tracks, *others, "--json").json()["measurements"] == 75


@pytest.mark.parametrize("option", ["--target-constant-mm", "--prism-constant-mm"])
def test_constants_of_raw_measurements_need_targets(tsgt: Tsgt, files: dict[str, Path], option: str) -> None:
    """Without targets there are no distances to correct, and nobody shall believe that they were."""
    outcome = tsgt(*import_arguments(files), option, 10)
    assert outcome.code == 2
    assert option in outcome.err
    assert not files["recording"].exists()


def test_cut_track_is_imported_with_a_note(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Its last coordinate may lack digits."""
    files["track2"].write_bytes(files["track2"].read_bytes().rstrip())
    outcome = tsgt(*import_arguments(files))
    assert outcome.code == 0
    assert f"note: {files['track2']}: the last line has no line end" in outcome.err


def test_import_rts_needs_three_tracks(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The paper has three prisms."""
    others = ["--prisms", files["prisms"], "--output", files["recording"]]
    outcome = tsgt("import", "rts", "--tracks", files["track1"], files["track2"], *others)
    assert outcome.code == 2
    assert "--tracks takes 3 files, one per prism; got 2" in outcome.err
    assert not files["recording"].exists()


@pytest.mark.parametrize("missing", ["--target-constant-mm", "--prism-constant-mm"])
def test_constants_have_no_default(tsgt: Tsgt, files: dict[str, Path], missing: str) -> None:
    """The authors' marker file has no constants, and a wrong one changes every result."""
    index = CONSTANTS.index(missing)
    constants = CONSTANTS[:index] + CONSTANTS[index + 2 :]
    outcome = tsgt(*import_arguments(files), "--targets", files["targets"], *constants)
    assert outcome.code == 2
    assert missing in outcome.err
    assert not files["recording"].exists()


@pytest.mark.parametrize("case", TRACK_EDITS)
def test_invalid_track_is_rejected(tsgt: Tsgt, files: dict[str, Path], case: str) -> None:
    """The error names the line and the problem."""
    edit, expected = TRACK_EDITS[case]
    lines = edit(files["track2"].read_text(encoding="utf-8").splitlines())
    files["track2"].write_text("\n".join(lines), encoding="utf-8")
    assert_refused(tsgt, import_arguments(files), files["recording"], expected)


def test_missing_track_is_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The error names the file."""
    files["track3"].unlink()
    assert_refused(
        tsgt, import_arguments(files), files["recording"], "trimble3.csv: cannot be read: No such file"
    )


def test_binary_track_is_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The error says that it is not text."""
    files["track1"].write_bytes(b"\xff\xfe\x00\x01")
    assert_refused(tsgt, import_arguments(files), files["recording"], "is not a text file")


def test_failed_import_keeps_an_older_recording(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The file is unchanged."""
    assert tsgt(*import_arguments(files)).code == 0
    files["track1"].write_text("", encoding="utf-8")
    assert_refused(tsgt, import_arguments(files), files["recording"], "contains no positions")


@pytest.mark.parametrize(
    ("layout", "expected"),
    [
        (LAYOUT[[0, 0, 2]], "prisms 1 and 2 are 0.0 mm apart"),
        (np.outer([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]), "nearly in a line"),
        (LAYOUT[:2], "has no position of prism 3"),
        (LAYOUT * np.nan, "line 1: expected a finite number"),
    ],
    ids=["two at one place", "in a line", "one missing", "NaN"],
)
def test_degenerate_prism_layout_is_rejected(
    tsgt: Tsgt,
    files: dict[str, Path],
    layout: NDArray[np.float64],
    expected: str,
) -> None:
    """A layout must determine a pose."""
    write_prisms(files["prisms"].parent, layout)
    assert_refused(tsgt, import_arguments(files), files["recording"], expected)


@pytest.mark.parametrize(("stations", "missing"), [((1, 2), "3"), ((1, 3), "2")])
def test_targets_without_a_station_are_rejected(
    tsgt: Tsgt,
    files: dict[str, Path],
    stations: tuple[int, ...],
    missing: str,
) -> None:
    """The error names the station."""
    targets = write_targets(files["targets"].parent, stations)
    arguments = [*import_arguments(files), "--targets", targets, *CONSTANTS]
    assert_refused(tsgt, arguments, files["recording"], f"holds no targets of station {missing}")


def process_arguments(files: dict[str, Path]) -> list[object]:
    """Return arguments that process the recording."""
    return ["process", files["recording"], "--output", files["poses"]]


def imported(tsgt: Tsgt, files: dict[str, Path]) -> list[str]:
    """Import the files and return the lines of the recording."""
    assert tsgt(*import_arguments(files)).code == 0
    return files["recording"].read_text(encoding="utf-8").splitlines(keepends=True)


def test_mirrored_layout_is_detected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Distances agree, but the robot would be upside down."""
    write_prisms(files["prisms"].parent, LAYOUT * [1.0, -1.0, 1.0])
    imported(tsgt, files)
    assert_refused(
        tsgt, process_arguments(files), files["poses"], "layout is mirrored or two prisms are swapped"
    )


def test_swapped_prisms_are_detected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The error states the layout residual."""
    write_prisms(files["prisms"].parent, LAYOUT[[0, 2, 1]])
    imported(tsgt, files)
    assert_refused(tsgt, process_arguments(files), files["poses"], "is 222 mm (median)")


def test_recording_without_a_station_is_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The error names the prism and its station."""
    lines = imported(tsgt, files)
    files["recording"].write_text("".join(lines[:2] + [x for x in lines[2:] if '"station":3' not in x]))
    expected = "prism 3 has no usable measurement (station 3 "
    assert_refused(tsgt, process_arguments(files), files["poses"], expected)


def test_recording_with_a_station_in_error_is_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The error has the instrument's status."""
    lines = imported(tsgt, files)
    spoilt = [x.replace('"ok"', '"tilt"') if '"station":2' in x else x for x in lines[2:]]
    files["recording"].write_text("".join(lines[:2] + spoilt))
    assert_refused(
        tsgt,
        process_arguments(files),
        files["poses"],
        "prism 2 has no usable measurement (25 with status tilt",
    )


def test_tracks_of_different_drives_are_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """They do not overlap in time."""
    text = files["track1"].read_text(encoding="utf-8")
    files["track1"].write_text(text.replace("17000000", "17000009"), encoding="utf-8")
    expected = "trimble1.csv: begins 890.3 s after the end of"
    assert_refused(tsgt, import_arguments(files), files["recording"], expected)


def test_measurement_of_a_wrong_clock_is_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """A single stamp of 1970 must not make a billion empty poses."""
    lines = imported(tsgt, files)
    old = re.sub(r'"stamp_ns":\d+', '"stamp_ns":5000000000', lines[-1])
    files["recording"].write_text("".join([*lines, old]), encoding="utf-8")
    expected = "its measurements span 19675.9 days"
    assert_refused(tsgt, process_arguments(files), files["poses"], expected)


@pytest.mark.parametrize("option", ["--target-constant-mm", "--prism-constant-mm"])
def test_constant_must_be_finite(tsgt: Tsgt, files: dict[str, Path], option: str) -> None:
    """NaN is a usage error."""
    outcome = tsgt(*import_arguments(files), option, "nan")
    assert outcome.code == 2
    assert "nan is not a finite number" in outcome.err
    assert not files["recording"].exists()


def test_import_does_not_replace_a_track(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Exit code 2."""
    files["track2"] = files["track2"].rename(files["recording"])
    text = files["recording"].read_text(encoding="utf-8")
    outcome = tsgt(*import_arguments(files))
    assert outcome.code == 2
    assert "would replace its own input" in outcome.err
    assert files["recording"].read_text(encoding="utf-8") == text


def test_identical_tracks_are_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Coincident prisms determine no pose."""
    for track in ("track2", "track3"):
        files[track].write_bytes(files["track1"].read_bytes())
    imported(tsgt, files)
    assert_refused(tsgt, process_arguments(files), files["poses"], "in a line or at one place")


def test_recording_without_measurements_is_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """It has header and parameters only."""
    files["recording"].write_text("".join(imported(tsgt, files)[:2]), encoding="utf-8")
    assert_refused(tsgt, process_arguments(files), files["poses"], "holds no measurements")


def test_recording_of_another_version_is_rejected(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The error names both versions."""
    first, *rest = imported(tsgt, files)
    files["recording"].write_text(
        first.replace('"version":1', '"version":2') + "".join(rest), encoding="utf-8"
    )
    assert_refused(
        tsgt, process_arguments(files), files["poses"], "is of version 2, this program reads version 1"
    )


def test_track_is_not_a_recording(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The error names the file."""
    files["recording"] = files["track1"]
    assert_refused(tsgt, process_arguments(files), files["poses"], "trimble1.csv")


def test_unwritable_output_is_one_line(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The error names the file."""
    imported(tsgt, files)
    files["poses"] = Path("/nowhere/poses.tum")
    outcome = tsgt(*process_arguments(files))
    assert (outcome.code, outcome.err.count("\n")) == (1, 1)
    assert "/nowhere/poses.tum: cannot be written" in outcome.err


def test_process_does_not_replace_the_recording(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Exit code 2."""
    lines = imported(tsgt, files)
    outcome = tsgt("process", files["recording"], "--output", files["recording"])
    assert outcome.code == 2
    assert files["recording"].read_text(encoding="utf-8").splitlines(keepends=True) == lines
