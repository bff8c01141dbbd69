"""Stationary intervals from a robot's odometry: a CSV file of time, linear and angular speed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tsgt.analysis.text_file import read_text
from tsgt.errors import InputFileError
from tsgt.model import check_instants

if TYPE_CHECKING:
    from pathlib import Path

MAX_STATIONARY_SPEED_MPS = 0.01
MAX_STATIONARY_RATE_RADPS = 0.01  # Below both: encoders at rest count next to nothing
MIN_STATIONARY_NS = 3_000_000_000
MAX_SAMPLE_GAP_NS = 1_000_000_000  # Between two lines further apart than this the motion is unknown


def read_stationary_intervals(path: Path) -> list[tuple[int, int]]:
    """Read the intervals in which a robot was stationary for 3 s or more: start and end in Unix ns, in the order of time.

    Lines are ``time_s,linear_mps,angular_radps``: Unix time in s, speed in m/s, angular rate in rad/s, separated by commas,
    semicolons or spaces. The first line may name the columns; ``#`` starts a comment. Raises InputFileError if the file
    cannot be read, a line is not three finite numbers, or times do not increase.
    """
    intervals: list[tuple[int, int]] = []
    begin: int | None = None
    last: int | None = None
    first = True
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split("#", maxsplit=1)[0].replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        if first and not _is_number(words[0]):
            first = False
            continue
        first = False
        stamp_ns, stationary = _sample(words, path, number)
        if last is not None and stamp_ns <= last:
            raise InputFileError(
                "its time is not later than that of the previous line; sort the lines", path=path, line=number
            )
        if begin is not None and last is not None and (not stationary or stamp_ns - last > MAX_SAMPLE_GAP_NS):
            intervals.append((begin, last))
            begin = None
        if stationary and begin is None:
            begin = stamp_ns
        last = stamp_ns
    if begin is not None and last is not None:
        intervals.append((begin, last))
    if last is None:
        raise InputFileError("contains no odometry", path=path)
    return [(start, end) for start, end in intervals if end - start >= MIN_STATIONARY_NS]


def _sample(words: list[str], path: Path, number: int) -> tuple[int, bool]:
    """Parse one line: its time, and whether the robot is stationary."""
    try:
        # A float resolves a Unix time to a quarter of a microsecond, which suffices here.
        time_s, linear_mps, angular_radps = map(float, words)
        stamp_ns = round(time_s * 1e9)
        check_instants(stamp_ns)
        if not (math.isfinite(linear_mps) and math.isfinite(angular_radps)):
            raise ValueError("not finite")
    except (ValueError, OverflowError) as error:
        raise InputFileError(
            "is not odometry; expected: time_s,linear_mps,angular_radps", path=path, line=number
        ) from error
    return stamp_ns, abs(linear_mps) <= MAX_STATIONARY_SPEED_MPS and abs(
        angular_radps
    ) <= MAX_STATIONARY_RATE_RADPS


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
