from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.analysis.formats import read_stationary_intervals
from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 1_000_000_000


def written(folder: Path, text: str) -> Path:
    """Write a file of odometry."""
    path = folder / "odometry.csv"
    path.write_text(text, encoding="utf-8")
    return path


def at_10_hz(*stretches: tuple[float, float, float]) -> str:
    """Lines of stretches: duration in s, linear and angular speed."""
    lines, step = [], 0
    for duration_s, linear, angular in stretches:
        for _ in range(round(10 * duration_s)):
            lines.append(f"{1_700_000_000 + step / 10},{linear},{angular}")
            step += 1
    return "\n".join(lines) + "\n"


def test_a_robot_stands_where_both_speeds_are_nothing(tmp_path: Path) -> None:
    """Driving and turning on the spot end an interval; one shorter than 3 s does not count."""
    text = at_10_hz((5, 0, 0), (2, 1.0, 0), (2, 0, 0), (3, 0, 0.5), (4, 0.001, -0.001))
    start = 1_700_000_000 * SECOND
    assert read_stationary_intervals(written(tmp_path, "time_s,linear_mps,angular_radps\n" + text)) == [
        (start, start + round(4.9 * SECOND)),
        (start + 12 * SECOND, start + round(15.9 * SECOND)),
    ]


def test_silence_ends_an_interval(tmp_path: Path) -> None:
    """Nobody knows what the robot did between lines that are more than a second apart."""
    later = "".join(f"{1_700_000_020 + step / 10} 0 0\n" for step in range(41))
    found = read_stationary_intervals(written(tmp_path, at_10_hz((4, 0, 0)) + later))
    assert [(end - start) / SECOND for start, end in found] == pytest.approx([3.9, 4.0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no lines"),
        ("time,v,w\n", "holds no lines"),
        ("1700000000,0\n", "is no odometry"),
        ("1700000000,nan,0\n", "is no odometry"),
        ("1700000000,0,0\n1700000000,0,0\n", "sort the lines"),
        ("1700000000,0,0\nx,0,0\n", "is no odometry"),
        ("1e300,0,0\n", "is no odometry"),
    ],
)
def test_what_is_no_odometry_is_refused(tmp_path: Path, text: str, said: str) -> None:
    """The message names the file, and the line where there is one."""
    with pytest.raises(InputFileError, match=said):
        read_stationary_intervals(written(tmp_path, text))


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """The message says why it cannot be read."""
    with pytest.raises(InputFileError, match="No such file"):
        read_stationary_intervals(tmp_path / "none.csv")
