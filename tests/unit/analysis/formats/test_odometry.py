from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.analysis.formats import read_stationary_intervals
from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 1_000_000_000


def written(folder: Path, text: str) -> Path:
    """Write an odometry file."""
    path = folder / "odometry.csv"
    path.write_text(text, encoding="utf-8")
    return path


def at_10_hz(*stretches: tuple[float, float, float]) -> str:
    """Return lines of segments: duration in s, linear and angular speed."""
    lines, step = [], 0
    for duration_s, linear, angular in stretches:
        for _ in range(round(10 * duration_s)):
            lines.append(f"{1_700_000_000 + step / 10},{linear},{angular}")
            step += 1
    return "\n".join(lines) + "\n"


def test_interval_requires_both_speeds_near_zero(tmp_path: Path) -> None:
    """Driving and turning on the spot end an interval; one shorter than 3 s does not count."""
    text = at_10_hz((5, 0, 0), (2, 1.0, 0), (2, 0, 0), (3, 0, 0.5), (4, 0.001, -0.001))
    start = 1_700_000_000 * SECOND
    assert read_stationary_intervals(written(tmp_path, "time_s,linear_mps,angular_radps\n" + text)) == [
        (start, start + round(4.9 * SECOND)),
        (start + 12 * SECOND, start + round(15.9 * SECOND)),
    ]


def test_gap_ends_an_interval(tmp_path: Path) -> None:
    """The motion between lines more than a second apart is unknown."""
    later = "".join(f"{1_700_000_020 + step / 10} 0 0\n" for step in range(41))
    found = read_stationary_intervals(written(tmp_path, at_10_hz((4, 0, 0)) + later))
    assert [(end - start) / SECOND for start, end in found] == pytest.approx([3.9, 4.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "contains no odometry"),
        ("time,v,w\n", "contains no odometry"),
        ("1700000000,0\n", "is not odometry"),
        ("1700000000,nan,0\n", "is not odometry"),
        ("1700000000,0,0\n1700000000,0,0\n", "sort the lines"),
        ("1700000000,0,0\nx,0,0\n", "is not odometry"),
        ("1e300,0,0\n", "is not odometry"),
    ],
)
def test_invalid_file_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    """The message names the file, and the line where there is one."""
    with pytest.raises(InputFileError, match=message):
        read_stationary_intervals(written(tmp_path, text))


def test_missing_file_is_rejected(tmp_path: Path) -> None:
    """The message contains the reason of the operating system."""
    with pytest.raises(InputFileError, match="No such file"):
        read_stationary_intervals(tmp_path / "none.csv")
