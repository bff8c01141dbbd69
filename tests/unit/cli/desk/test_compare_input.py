"""``tsgt compare`` on wrong input: one line with the file and the way out, before anything is fitted."""

from __future__ import annotations

import os
import resource
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.paired import drive
from harness.files.pose_files import (
    Poses,
    pose_stamped,
    seconds,
    write_bag,
    write_euroc,
    write_kitti,
    write_tum,
)
from rosbags.rosbag2 import StoragePlugin

from tsgt.geometry import quaternion_from_rotation

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from harness.files.cli import Tsgt

START_NS = 1_780_000_000_000_000_000
TRUE = drive(600, 10.0, speed_mps=1.5)


def write(
    path: Path,
    *,
    shift_s: float = 0.0,
    factor: float = 1.0,
    last: int = 600,
    time: Callable[[int], str] = seconds,
    header: str = "",
) -> Path:
    """Write the true poses at 10 Hz, with a mistake."""
    stamp_ns = START_NS + round(shift_s * 1e9) + np.arange(last) * 100_000_000
    rows = np.hstack([factor * TRUE[:last, :3, 3], quaternion_from_rotation(TRUE[:last, :3, :3])])
    lines = [
        f"{time(stamp)} {' '.join(map(repr, row))}\n"
        for stamp, row in zip(stamp_ns.tolist(), rows.tolist(), strict=True)
    ]
    path.write_text(header + "".join(lines))
    return path


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        ({"shift_s": 7200.0}, "they differ by about +2.0 h: is one of them in local time?"),
        (
            {"factor": 1e3},
            "moves 1000 times as fast as the reference: its positions seem to be in millimetres",
        ),
        ({"factor": 0.0}, "the position never changes by more than 0 mm, while the reference moves over"),
        ({"time": lambda _: "nan"}, "line 1: the time 'nan' is no number"),
        ({"header": "stamp a b c d e f g\n"}, "line 1: the columns 'stamp, a, b, c, d, e, f, g' do not name"),
        ({"last": 1}, "holds fewer than two poses"),
    ],
)
def test_wrong_input_is_one_line(tsgt: Tsgt, tmp_path: Path, mistake: dict[str, object], said: str) -> None:
    """The command fails, and prints nothing else."""
    reference, wrong = write(tmp_path / "reference.tum"), write(tmp_path / "wrong.tum", **mistake)  # type: ignore[arg-type]
    outcome = tsgt("compare", reference, wrong)
    assert outcome.code == 1
    assert outcome.out == ""
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"error: {wrong}")
    assert said in line


def test_repairs_are_told(tsgt: Tsgt, tmp_path: Path) -> None:
    """Nanoseconds, repeated and unsorted poses, and 20 s of overlap: it compares, and says each of them."""
    reference = write(tmp_path / "reference.tum")
    wrong = write(tmp_path / "wrong.tum", time=str, last=200)
    lines = wrong.read_text().splitlines(keepends=True)
    wrong.write_text("".join([*lines[100:], *lines[:101]]))
    outcome = tsgt("compare", reference, wrong, "--fit", "none", "--align", "none")
    assert outcome.code == 0
    for said in (
        "times are nanoseconds, by their size",
        "times ran backwards once; the poses were sorted by time",
        "1 pose with the time of another left out; the first one was kept",
        "only 20 s of overlap: the estimate lasts 20 s, the reference 60 s",
    ):
        assert said in outcome.err + outcome.out


@pytest.mark.parametrize(
    ("options", "both", "said"),
    [
        (("--fit", "none", "--align", "none"), False, ""),
        ((), False, ""),
        ((), True, "times of a wrong clock"),
        (("--max-offset-s", "1e8"), False, "times of a wrong clock"),
    ],
)
def test_absurd_time_costs_no_memory(
    tsgt: Tsgt, tmp_path: Path, options: tuple[str, ...], said: str, *, both: bool
) -> None:
    """Poses of the year 1970 before those of 2026, in the estimate or in both files."""
    reference, wrong = write(tmp_path / "reference.tum"), write(tmp_path / "wrong.tum")
    lines = wrong.read_text().splitlines(keepends=True)
    early = [f"{time_s} {lines[0].partition(' ')[2]}" for time_s in (0.0, 0.1, 0.2, 0.3)]
    wrong.write_text("".join([*early, *lines]))
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (4 * 2**30, limits[1]))
    try:
        outcome = tsgt("compare", wrong if both else reference, wrong, *options)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert (outcome.code, said in outcome.err) == (1 if said else 0, True), outcome.err


def test_offset_beyond_the_length_of_the_drive_is_searched(tsgt: Tsgt, tmp_path: Path) -> None:
    """Times without overlap, of a clock an hour ahead, are no reason to refuse where the offset may be an hour."""
    reference = write(tmp_path / "reference.tum")
    late = write(tmp_path / "late.tum", shift_s=3600.0)
    outcome = tsgt("compare", reference, late, "--max-offset-s", 4000, "--json")
    assert outcome.code == 0, outcome.err
    (found,) = outcome.json()["estimates"].values()
    assert found["offset_ms"] == pytest.approx(-3.6e6, abs=1.0)
    assert any("no overlap in time as stamped" in note for note in found["notes"])
    for options in (("--max-offset-s", 3000), ("--max-offset-s", 4000, "--fit", "none")):
        outcome = tsgt("compare", reference, late, *options)
        assert (outcome.code, "no overlap in time: the estimate covers" in outcome.err) == (1, True)


def test_limit_of_sigma_needs_a_covariance(tsgt: Tsgt, tmp_path: Path) -> None:
    """A TUM file as the reference has none: nothing could be left out."""
    reference = write(tmp_path / "reference.tum")
    outcome = tsgt("compare", reference, reference, "--max-sigma-mm", 5)
    assert (outcome.code, "--max-sigma-mm needs" in outcome.err) == (2, True)


def test_topic_needs_a_bag(tsgt: Tsgt, tmp_path: Path) -> None:
    """A text file has no topics: the option would have no effect."""
    reference = write(tmp_path / "reference.tum")
    outcome = tsgt("compare", reference, reference, "--topic", "/nothing")
    assert (outcome.code, "--topic needs a bag" in outcome.err) == (2, True), outcome.err


def test_missing_folder_is_noticed_before_the_comparison(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which may take minutes."""
    monkeypatch.setattr("tsgt.cli.desk.compare.compare_estimate", None)
    reference = write(tmp_path / "reference.tum")
    outcome = tsgt("compare", reference, reference, "--csv", tmp_path / "none" / "errors.csv")
    assert outcome.code == 1
    assert outcome.err.splitlines() == [
        f"error: {tmp_path}/none/errors.csv: cannot be written (No such file or directory)"
    ]


def test_bytes_of_names_that_are_not_utf8_are_replaced(
    tsgt: Tsgt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the file of errors and in the report; a system with Latin-1 has written such names."""
    drawn: list[tuple[str, str]] = []
    monkeypatch.setattr(
        "tsgt.cli.desk.compare.write_comparison_report",
        lambda found, _figures, _folder, reference: drawn.append((found[0].name, reference)),
    )
    reference = write(tmp_path / os.fsdecode(b"r\xe4.tum"))
    estimate = write(tmp_path / os.fsdecode(b"m\xe4.tum"))
    errors = tmp_path / "errors.csv"
    options = ("--fit", "none", "--align", "none", "--csv", errors, "--report", tmp_path / "report")
    outcome = tsgt("compare", reference, estimate, *options)
    assert outcome.code == 0, outcome.err
    assert errors.read_text().splitlines()[1].startswith("m\ufffd,")
    assert drawn == [("m\ufffd", "r\ufffd.tum")]


@pytest.mark.slow
def test_all_formats_give_the_same_errors(tsgt: Tsgt, tmp_path: Path) -> None:
    """The same poses as TUM, EuRoC, KITTI and bags of both kinds, against a TUM file of slightly other ones."""
    reference = write(tmp_path / "reference.tum")
    poses = Poses(300)
    poses.stamp_ns = START_NS + np.arange(300) * 100_000_000 + 12_345_678
    poses.position_m = TRUE[:300, :3, 3] + 0.01
    poses.orientation_xyzw = quaternion_from_rotation(TRUE[:300, :3, :3])
    messages = [(t, pose_stamped(t, p, q)) for t, p, q in poses.rows()]
    files = [
        write_tum(tmp_path / "tum.txt", poses),
        write_euroc(tmp_path / "euroc.csv", poses),
        write_kitti(tmp_path / "kitti.txt", poses, tmp_path / "kitti_times.txt"),
        *(write_bag(tmp_path / each.name, {"/pose": messages}, plugin=each) for each in StoragePlugin),
    ]
    outcome = tsgt("compare", reference, *files, "--fit", "none", "--align", "none", "--json")
    found = outcome.json()["estimates"]
    assert set(found) == {"tum", "euroc", "kitti", "MCAP", "SQLITE3"}
    first = found["tum"]["ate"]
    assert first["n"] == 300
    assert 10.0 < first["position_rms_mm"] < 50.0
    for each in found.values():
        assert each["ate"]["n"] == 300
        for key in ("position_rms_mm", "orientation_rms_deg"):
            assert each["ate"][key] == pytest.approx(first[key], rel=1e-9)
