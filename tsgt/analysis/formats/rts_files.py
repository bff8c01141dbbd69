"""Files that the authors published: prism tracks, and prism positions on the robot."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.text_file import read_text
from tsgt.errors import DegenerateGeometryError, InputFileError, quoted
from tsgt.geometry import check_layout
from tsgt.model import MAX_COORDINATE_M, PrismPosition

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.model import Vector3

PRISMS = 3
TRACK_COLUMNS = 4
NS_MAX = 2**63 - 1


@dataclass(frozen=True, slots=True)
class PublishedTrack:
    """Track of one prism: (M,) Unix times, strictly increasing, and (M, 3) positions in the frame ``station1``."""

    stamps_ns: NDArray[np.int64]
    points_m: NDArray[np.float64]


def read_track(path: Path) -> PublishedTrack:
    """Read the authors' ``trimble<k>.csv``: no header, separated by spaces: Unix time (s), x, y, z (m) in frame 1.

    Decimal times are converted to ns without a float. Raises InputFileError if the file is empty, a line has not four finite
    numbers, or times do not increase.
    """
    stamps: list[int] = []
    points: list[list[float]] = []
    for number, row in _rows(path):
        if len(row) != TRACK_COLUMNS:
            raise InputFileError(
                f"expected 4 columns (Unix time in s, x, y, z in m), got {len(row)}", path=path, line=number
            )
        stamp = _nanoseconds(row[0], path, number)
        if stamps and stamp == stamps[-1]:
            raise InputFileError(
                f"duplicate time {row[0]}; keep one of the two lines",
                path=path,
                line=number,
            )
        if stamps and stamp < stamps[-1]:
            raise InputFileError(
                f"time decreases: {row[0]} is {(stamps[-1] - stamp) / 1e9:.3f} s before the previous line; "
                "sort the file by time or remove the line",
                path=path,
                line=number,
            )
        stamps.append(stamp)
        points.append([_number(text, path, number) for text in row[1:]])
    if not stamps:
        raise InputFileError(
            "contains no positions; expected lines of Unix time in s, x, y, z in m", path=path
        )
    return PublishedTrack(np.array(stamps, dtype=np.int64), np.array(points))


def read_tracks(paths: Sequence[Path]) -> tuple[PublishedTrack, ...]:
    """Read the tracks of one drive in the order of the prisms. Raises InputFileError also if they do not overlap in time."""
    tracks = tuple(read_track(path) for path in paths)
    latest = max(range(len(tracks)), key=lambda i: int(tracks[i].stamps_ns[0]))
    first_to_end = min(range(len(tracks)), key=lambda i: int(tracks[i].stamps_ns[-1]))
    late_ns = int(tracks[latest].stamps_ns[0] - tracks[first_to_end].stamps_ns[-1])
    if late_ns > 0:
        raise InputFileError(
            f"begins {late_ns / 1e9:.1f} s after the end of {paths[first_to_end]}; use the tracks of one drive",
            path=paths[latest],
        )
    return tracks


def read_prisms(
    path: Path, numbers: Sequence[int] = (1, 2, 3), *, imu: bool = False
) -> tuple[PrismPosition, ...]:
    """Read the positions of the tracked prisms on the robot, in the order of ``numbers``.

    From the authors' ``sensor_positions.csv``: separated by spaces, rows 1 to 3 are the prisms 1 to 3, starting with x, y, z
    in m in the robot frame, the rest is ignored; or from a ``.toml`` of kind ``prism_layout``. Raises InputFileError if a
    row or a number is missing, or the prisms coincide or, without ``imu``, lie in a line or are too few; ConfigError if the set-up
    file cannot be used.
    """
    if path.suffix == ".toml":
        from tsgt.config import load_prism_layout  # noqa: PLC0415 (a tenth of the start-up of `tsgt process`)

        positions = load_prism_layout(path).positions_m
    else:
        positions = _read_sensor_positions(path)
    missing = [prism for prism in numbers if prism not in positions]
    if missing:
        raise InputFileError(
            f"has no position of prism {missing[0]}; the tracks are those of {', '.join(map(str, numbers))}",
            path=path,
        )
    prisms = tuple(PrismPosition(prism=prism, position_m=positions[prism]) for prism in numbers)
    try:
        check_layout([prism.position_m for prism in prisms], names=numbers, imu=imu)
    except DegenerateGeometryError as error:
        raise InputFileError(str(error), path=path) from error
    return prisms


def _read_sensor_positions(path: Path) -> dict[int, Vector3]:
    positions: dict[int, Vector3] = {}
    for number, row in _rows(path)[:PRISMS]:
        if len(row) < 3:
            raise InputFileError(
                f"expected at least 3 columns (x, y, z in m in the robot frame), got {len(row)}",
                path=path,
                line=number,
            )
        x, y, z = (_coordinate(text, path, number) for text in row[:3])
        positions[len(positions) + 1] = (x, y, z)
    return positions


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return line number and columns of all non-blank lines."""
    rows = [(number, line.split()) for number, line in enumerate(read_text(path).splitlines(), start=1)]
    return [(number, row) for number, row in rows if row]


def _number(text: str, path: Path, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputFileError(f"expected a finite number, got {quoted(text)}", path=path, line=line)
    return value


def _coordinate(text: str, path: Path, line: int) -> float:
    value = _number(text, path, line)
    if abs(value) > MAX_COORDINATE_M:
        raise InputFileError(
            f"expected at most {MAX_COORDINATE_M:g} m, got {quoted(text)}", path=path, line=line
        )
    return value


def _nanoseconds(text: str, path: Path, line: int) -> int:
    """Convert decimal seconds to whole nanoseconds. A float would be off by up to 120 ns at today's Unix times."""
    try:
        stamp = Decimal(text)
    except InvalidOperation:
        stamp = Decimal("nan")
    if not stamp.is_finite() or not 0 <= stamp <= Decimal(NS_MAX).scaleb(-9):
        raise InputFileError(f"expected a Unix time in s, got {quoted(text)}", path=path, line=line)
    return int(stamp.scaleb(9).to_integral_value())
