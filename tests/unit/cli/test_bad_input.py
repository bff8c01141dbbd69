"""Bad input: one clear line on stderr, a non-zero exit, and no output file, not even half of one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.published import write_prisms, write_targets, write_tracks
from harness.scene import LAYOUT

if TYPE_CHECKING:
    from collections.abc import Callable

    from harness.cli import Tsgt
    from numpy.typing import NDArray

TRACK_EDITS: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
    "empty file": (lambda _: [], "holds no positions"),
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
    "unsorted time stamps": (lambda lines: [lines[1], lines[0], *lines[2:]], "line 2: time runs backwards"),
    "repeated time stamps": (
        lambda lines: [lines[0], *lines],
        "line 2: time stamp 1700000000.1100123 stands here",
    ),
}


def _with_last(line: str, word: str) -> str:
    return " ".join([*line.split()[:-1], word])


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Good files, for a test to spoil one of them."""
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
    """Arguments that import the files without their targets."""
    tracks = [files["track1"], files["track2"], files["track3"]]
    return ["import", "rts", "--tracks", *tracks, "--prisms", files["prisms"], "--output", files["recording"]]


def assert_refused(tsgt: Tsgt, arguments: list[object], output: Path, expected: str) -> None:
    """Check the exit code, the one line, and that the folder holds the same files as before."""
    before = {path: path.stat().st_mtime_ns for path in output.parent.iterdir()}
    outcome = tsgt(*arguments)
    assert outcome.code == 1
    assert outcome.out == ""
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1
    assert expected in outcome.err
    assert {path: path.stat().st_mtime_ns for path in output.parent.iterdir()} == before


def test_the_option_of_the_tracks_said_three_times_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """``import polar`` takes its option once for each file, ``import rts`` once for all: the message says so."""
    tracks = [word for k in (1, 2, 3) for word in ("--tracks", files[f"track{k}"])]
    outcome = tsgt("import", "rts", *tracks, "--prisms", files["prisms"], "--output", files["recording"])
    assert outcome.code == 2
    assert "takes three files, one after the other, but --prisms stands between them" in outcome.err
    assert not files["recording"].exists()


@pytest.mark.parametrize("case", TRACK_EDITS)
def test_a_bad_track_is_refused(tsgt: Tsgt, files: dict[str, Path], case: str) -> None:
    """A track that cannot be used is named with the line and what is wrong in it."""
    edit, expected = TRACK_EDITS[case]
    lines = edit(files["track2"].read_text(encoding="utf-8").splitlines())
    files["track2"].write_text("\n".join(lines), encoding="utf-8")
    assert_refused(tsgt, import_arguments(files), files["recording"], expected)


def test_a_missing_track_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """A file that is not there is named."""
    files["track3"].unlink()
    assert_refused(tsgt, import_arguments(files), files["recording"], "trimble3.csv: No such file")


def test_a_track_that_is_no_text_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """A binary file is called that."""
    files["track1"].write_bytes(b"\xff\xfe\x00\x01")
    assert_refused(tsgt, import_arguments(files), files["recording"], "is not a text file")


def test_a_failed_import_leaves_an_older_recording_alone(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """What was there before is still there, byte for byte."""
    assert tsgt(*import_arguments(files)).code == 0
    files["track1"].write_text("", encoding="utf-8")
    assert_refused(tsgt, import_arguments(files), files["recording"], "holds no positions")


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
def test_a_bad_prism_layout_is_refused(
    tsgt: Tsgt,
    files: dict[str, Path],
    layout: NDArray[np.float64],
    expected: str,
) -> None:
    """A layout from which no pose can come is refused at the door."""
    write_prisms(files["prisms"].parent, layout)
    assert_refused(tsgt, import_arguments(files), files["recording"], expected)


@pytest.mark.parametrize(("stations", "missing"), [((1, 2), "3"), ((1, 3), "2")])
def test_targets_without_a_station_are_refused(
    tsgt: Tsgt,
    files: dict[str, Path],
    stations: tuple[int, ...],
    missing: str,
) -> None:
    """A station that no target was measured from is named."""
    targets = write_targets(files["targets"].parent, stations)
    arguments = [*import_arguments(files), "--targets", targets]
    assert_refused(tsgt, arguments, files["recording"], f"holds no targets of station {missing}")


def process_arguments(files: dict[str, Path]) -> list[object]:
    """Arguments that process the recording."""
    return ["process", files["recording"], "--output", files["poses"]]


def imported(tsgt: Tsgt, files: dict[str, Path]) -> list[str]:
    """Import the files and return the lines of the recording."""
    assert tsgt(*import_arguments(files)).code == 0
    return files["recording"].read_text(encoding="utf-8").splitlines(keepends=True)


def test_a_mirrored_layout_is_found_when_processing(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Distances cannot tell it, but the robot would drive upside down."""
    write_prisms(files["prisms"].parent, LAYOUT * [1.0, -1.0, 1.0])
    imported(tsgt, files)
    assert_refused(
        tsgt, process_arguments(files), files["poses"], "layout is mirrored or two prisms are swapped"
    )


def test_swapped_prisms_are_found_when_processing(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Where the distances differ, the prisms miss their layout, and by how much is said."""
    write_prisms(files["prisms"].parent, LAYOUT[[0, 2, 1]])
    imported(tsgt, files)
    assert_refused(
        tsgt, process_arguments(files), files["poses"], "the prisms miss their layout by 218 mm (median)"
    )


def test_a_recording_without_a_station_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """The prism that nobody measured is named, and the station that should have."""
    lines = imported(tsgt, files)
    files["recording"].write_text("".join(lines[:2] + [x for x in lines[2:] if '"station":3' not in x]))
    expected = "prism 3 has no usable measurement (station 3 sent none of it)"
    assert_refused(tsgt, process_arguments(files), files["poses"], expected)


def test_a_recording_with_a_station_in_error_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """What the instrument said instead of measuring is passed on."""
    lines = imported(tsgt, files)
    spoilt = [x.replace('"ok"', '"tilt"') if '"station":2' in x else x for x in lines[2:]]
    files["recording"].write_text("".join(lines[:2] + spoilt))
    assert_refused(
        tsgt,
        process_arguments(files),
        files["poses"],
        "prism 2 has no usable measurement (25 with status tilt",
    )


def test_tracks_of_different_drives_are_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Tracks that have no time in common cannot belong together."""
    text = files["track1"].read_text(encoding="utf-8")
    files["track1"].write_text(text.replace("17000000", "17000009"), encoding="utf-8")
    expected = "trimble1.csv: begins 890.3 s after the end of"
    assert_refused(tsgt, import_arguments(files), files["recording"], expected)


def test_measurements_of_a_wrong_clock_are_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """A single stamp from 1970 must not make a billion empty poses."""
    lines = imported(tsgt, files)
    old = re.sub(r'"stamp_ns":\d+', '"stamp_ns":5000000000', lines[-1])
    files["recording"].write_text("".join([*lines, old]), encoding="utf-8")
    expected = "its measurements span 19675.9 days"
    assert_refused(tsgt, process_arguments(files), files["poses"], expected)


@pytest.mark.parametrize("option", ["--target-constant-mm", "--prism-constant-mm"])
def test_a_constant_is_a_finite_number(tsgt: Tsgt, files: dict[str, Path], option: str) -> None:
    """The command line takes no NaN either."""
    outcome = tsgt(*import_arguments(files), option, "nan")
    assert outcome.code == 2
    assert "nan is not a finite number" in outcome.err
    assert not files["recording"].exists()


def test_a_track_is_no_output(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Importing never replaces what it reads."""
    text = files["track2"].read_text(encoding="utf-8")
    files["recording"] = files["track2"]
    outcome = tsgt(*import_arguments(files))
    assert outcome.code == 2
    assert "would replace its own input" in outcome.err
    assert files["track2"].read_text(encoding="utf-8") == text


def test_one_track_thrice_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Prisms that were all measured at one place give no pose."""
    for track in ("track2", "track3"):
        files[track].write_bytes(files["track1"].read_bytes())
    imported(tsgt, files)
    assert_refused(tsgt, process_arguments(files), files["poses"], "in a line or at one place")


def test_a_recording_without_measurements_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """There is nothing to process in header and parameters alone."""
    files["recording"].write_text("".join(imported(tsgt, files)[:2]), encoding="utf-8")
    assert_refused(tsgt, process_arguments(files), files["poses"], "holds no measurements")


def test_a_recording_of_another_version_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Both versions are named."""
    first, *rest = imported(tsgt, files)
    files["recording"].write_text(
        first.replace('"version":1', '"version":2') + "".join(rest), encoding="utf-8"
    )
    assert_refused(
        tsgt, process_arguments(files), files["poses"], "is of version 2, this program reads version 1"
    )


def test_a_file_that_is_no_recording_is_refused(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """A track given as a recording is not mistaken for one."""
    files["recording"] = files["track1"]
    assert_refused(tsgt, process_arguments(files), files["poses"], "trimble1.csv")


def test_an_unwritable_output_is_one_line(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """A folder that is not there is said, not traced."""
    imported(tsgt, files)
    files["poses"] = Path("/nowhere/poses.tum")
    outcome = tsgt(*process_arguments(files))
    assert (outcome.code, outcome.err.count("\n")) == (1, 1)
    assert "/nowhere/poses.tum: cannot be written" in outcome.err


def test_the_recording_itself_is_no_output(tsgt: Tsgt, files: dict[str, Path]) -> None:
    """Processing never replaces the measurements that it reads."""
    lines = imported(tsgt, files)
    outcome = tsgt("process", files["recording"], "--output", files["recording"])
    assert outcome.code == 2
    assert files["recording"].read_text(encoding="utf-8").splitlines(keepends=True) == lines
