"""``tsgt compare`` on wrong input: one line with the file and the way out, before anything is fitted."""

from __future__ import annotations

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
