"""Trajectories in text files: TUM, KITTI with times, EuRoC, and CSV with column names."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.formats.number_table import joined_times_ns, read_number_table, times_ns
from tsgt.analysis.formats.trajectories.columns import KITTI_COLUMNS, by_name, pose_columns
from tsgt.analysis.formats.trajectories.raw import RawTrajectory
from tsgt.errors import InputFileError
from tsgt.geometry import quaternion_from_rotation

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.formats.number_table import NumberTable
    from tsgt.analysis.formats.trajectories.columns import TextFormat
    from tsgt.geometry import FloatArray

_ROTATION_TOLERANCE = 1e-2  # Of R^T R from the identity: matrices are written with a few digits

_FLAGS = {"1": True, "0": False, "true": True, "false": False}


def read_text(
    path: Path, *, text_format: TextFormat | None = None, times: Path | None = None
) -> RawTrajectory:
    """Read poses from a text file; ``text_format``: unless it shall be told by the columns.

    ``times``: of a KITTI file; default: ``times.txt`` or ``NAME_times.txt`` beside it. Raises InputFileError.
    """
    table = read_number_table(path)
    if text_format == "kitti" or (
        # Names decide: another program's pose may have as many columns.
        text_format is None and len(table.columns) == KITTI_COLUMNS and by_name(table) is None
    ):
        return _kitti(table, times)
    return _table(table, text_format)


def raw_and_valid(
    table: NumberTable, text_format: TextFormat | None
) -> tuple[RawTrajectory, NDArray[np.bool_]]:
    """Return all rows of a table with times, and which of them the file itself calls valid, (M,)."""
    columns = pose_columns(table, text_format)
    if columns.nanoseconds is None:
        stamp_ns, notes = times_ns(table, columns.time, columns.time_unit)
    else:
        stamp_ns, notes = joined_times_ns(table, columns.time, columns.nanoseconds), ()
    valid = np.ones(len(stamp_ns), dtype=np.bool_)
    if columns.valid is not None:
        valid = np.array([_flag(table, columns.valid, row) for row in range(len(stamp_ns))])
    covariance = None
    if columns.sigma:
        sigma = table.numbers(*columns.sigma)
        covariance = np.full((len(sigma), 6, 6), np.nan)
        known = np.isfinite(sigma).all(axis=1)
        covariance[known] = np.eye(6) * np.square(sigma[known])[:, None, :]
    quaternion = columns.orientation_xyzw
    return RawTrajectory(
        stamp_ns=stamp_ns,
        position_m=table.numbers(*columns.position),
        orientation_xyzw=None if quaternion is None else table.numbers(*quaternion),
        covariance=covariance,
        line=np.array(table.line),
        notes=notes,
    ), valid


def _table(table: NumberTable, text_format: TextFormat | None) -> RawTrajectory:
    raw, valid = raw_and_valid(table, text_format)
    if valid.all():
        return raw
    return raw.select(valid, f"{int((~valid).sum())} poses that the file calls invalid left out")


def _flag(table: NumberTable, column: int, row: int) -> bool:
    found = _FLAGS.get(table.columns[column][row].lower())
    if found is None:
        raise table.error("valid is neither 0 nor 1", row)
    return found


def _kitti(table: NumberTable, times: Path | None) -> RawTrajectory:
    path = table.path
    if len(table.columns) != KITTI_COLUMNS:
        raise InputFileError(
            f"has {len(table.columns)} columns; KITTI has {KITTI_COLUMNS}", path=path, line=table.line[0]
        )
    times = times or _times_beside(path)
    stamps = read_number_table(times)
    if len(stamps.columns) != 1 or len(stamps.line) != len(table.line):
        raise InputFileError(
            f"has {len(stamps.line)} lines of {len(stamps.columns)} columns; expected one time for each of the "
            f"{len(table.line)} poses of {path}",
            path=times,
        )
    stamp_ns, notes = times_ns(stamps, 0)
    matrix = table.numbers(*range(KITTI_COLUMNS)).reshape(-1, 3, 4)
    rotation = matrix[:, :, :3]
    finite = np.asarray(np.isfinite(matrix).all(axis=(1, 2)))
    _check_rotations(table, rotation, finite)
    orientation = np.full((len(matrix), 4), np.nan)
    orientation[finite] = quaternion_from_rotation(rotation[finite])
    return RawTrajectory(
        stamp_ns=stamp_ns,
        position_m=matrix[:, :, 3],
        orientation_xyzw=orientation,
        line=np.array(table.line),
        notes=notes,
    )


def _times_beside(path: Path) -> Path:
    names = (f"{path.stem}_times.txt", f"{path.stem}.times", "times.txt")
    for name in names:
        beside = path.with_name(name)
        if beside.is_file() and beside != path:
            return beside
    raise InputFileError(
        f"has poses as KITTI has them (12 columns), but there is no file of their times beside it: {', '.join(names)}",
        path=path,
    )


def _check_rotations(table: NumberTable, rotation: FloatArray, finite: NDArray[np.bool_]) -> None:
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2))
        wrong = finite & ~((error <= _ROTATION_TOLERANCE) & (np.linalg.det(rotation) > 0))
    if wrong.any():
        raise table.error(
            "holds no rotation in columns 1-3, 5-7 and 9-11; expected the upper 3x4 of T_frame_sensor, row by row",
            int(np.argmax(wrong)),
        )
