"""Which column of a table is what: by its name, or by the number of columns where there are no names."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from tsgt.errors import InputFileError, quoted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.analysis.formats.number_table import NumberTable, TimeUnit

TextFormat = Literal["tum", "kitti", "euroc", "csv"]

KITTI_COLUMNS = 12
_TUM_COLUMNS, _POSITION_COLUMNS, _MIN_EUROC_COLUMNS = 8, 4, 11

_TIME = re.compile(r"(?:.*[./])?(?:t|time|stamp|timestamp)(?:_?(ns|nsec|us|ms|s|sec|secs))?")
_SECONDS = re.compile(r"(?:.*[./_])?(?:s|sec|secs|seconds)")
_NANOSECONDS = re.compile(r"(?:.*[./_])?(?:nsec|nsecs|nanosec|nanosecs|nanoseconds)")
_POSITION = re.compile(r"(?:.*[./])?(?:(?:position|translation|point|pos|trans|p|t)[._]?)?([xyz])(?:_m)?")
_EUROC_POSITION = re.compile(r"p_[a-z0-9]+_[a-z0-9]+_([xyz])")
_ORIENTATION = re.compile(r"(?:.*[./])?(?:orientation|quaternion|rotation|quat|rot|q)[._/]?([xyzw])")
_EUROC_ORIENTATION = re.compile(r"q_[a-z0-9]+(?:_[a-z0-9]+)?_([wxyz])")
_LIKE_ORIENTATION = re.compile(
    r"(?!.*(?:cov|sigma|std))(?:.*[./_])?(?:orientation|quaternion|rotation|quat|rot|q)[._/]?(?:[xyzw]|[0-4])"
)
_NOT_POSITION = re.compile(
    r".*(?:orientation|quaternion|rotation|linear|angular|velocity|acceleration|twist|cov|sigma|std).*"
)
_BRACKETS = re.compile(r"\s*[\[(]\s*([^\])]*)[\])]\s*$")
_UNITS: dict[str, TimeUnit] = {
    "ns": "ns",
    "nsec": "ns",
    "us": "us",
    "ms": "ms",
    "s": "s",
    "sec": "s",
    "secs": "s",
}

EXPECTED = (
    "time, x, y, z and, unless positions alone, qx, qy, qz, qw "
    "(as t|time|stamp, x|position_x|p_x, qx|orientation_x|q_x; EuRoC's names too)"
)


@dataclass(frozen=True, slots=True)
class PoseColumns:
    """Indices of the columns of a pose."""

    time: int
    time_unit: TimeUnit | None  # None: by the size of the times
    nanoseconds: int | None  # Column of the nanoseconds, where the time has two
    position: tuple[int, int, int]
    orientation_xyzw: tuple[int, int, int, int] | None
    valid: int | None = None
    sigma: tuple[int, ...] = ()  # Six, of position and of rotation about the fixed axes


def pose_columns(table: NumberTable, text_format: TextFormat | None) -> PoseColumns:
    """Find the columns; raises InputFileError if they cannot be told.

    Without names: 8 columns are TUM, 4 are time and position, 11 or more with commas are EuRoC's order. ``text_format``
    ``tum`` or ``euroc``: that order, whatever the names are; ``csv``: by the names only.
    """
    count = len(table.columns)
    if text_format in (None, "csv") and table.names is not None:
        found = by_name(table)
        if found is not None:
            return found
        if text_format == "csv" or table.header_line is not None:
            raise InputFileError(
                f"the columns {quoted(', '.join(table.names))} do not name a pose; expected {EXPECTED}",
                path=table.path,
                line=table.header_line,
            )
    if text_format == "csv":
        raise InputFileError(f"has no line of column names; expected {EXPECTED}", path=table.path)
    euroc = text_format == "euroc" or (
        text_format is None and table.separated and count >= _MIN_EUROC_COLUMNS
    )
    if euroc and count >= _TUM_COLUMNS:
        return PoseColumns(0, None, None, (1, 2, 3), (5, 6, 7, 4))
    if not euroc and count == _TUM_COLUMNS:
        return PoseColumns(0, None, None, (1, 2, 3), (4, 5, 6, 7))
    if text_format is None and count == _POSITION_COLUMNS:
        return PoseColumns(0, None, None, (1, 2, 3), None)
    expected = (
        "time x y z qw qx qy qz in 8 columns or more"
        if euroc
        else "stamp_s x y z qx qy qz qw (TUM), stamp_s x y z, 12 columns (KITTI), or a line of column names"
    )
    raise InputFileError(
        f"has {count} columns, which is no pose; expected: {expected}", path=table.path, line=table.line[0]
    )


def by_name(table: NumberTable) -> PoseColumns | None:
    """Find the columns by their names; None unless a time and a whole position are named, each once.

    Raises InputFileError for the names of an orientation in part: without it the same estimate has other errors.
    """
    plain = [_plain(name) for name in table.names or ()]
    positions, quaternion = _axes(plain, "xyz", position=True), _axes(plain, "xyzw", position=False)
    time = _time(plain)
    if time is None or positions is None:
        return None
    if quaternion is None:
        _check_no_orientation(table, plain)
    x, y, z = positions
    sigmas = ("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad")
    stated = [name for name, _ in plain]
    return PoseColumns(
        *time,
        (x, y, z),
        None if quaternion is None else (quaternion[0], quaternion[1], quaternion[2], quaternion[3]),
        valid=stated.index("valid") if "valid" in stated else None,
        sigma=tuple(stated.index(name) for name in sigmas) if set(sigmas) <= set(stated) else (),
    )


def _check_no_orientation(table: NumberTable, plain: Sequence[tuple[str, str]]) -> None:
    alike = [
        name
        for name, (stated, unit) in zip(table.names or (), plain, strict=True)
        if _EUROC_ORIENTATION.fullmatch(stated)
        or _LIKE_ORIENTATION.fullmatch(stated)
        or _LIKE_ORIENTATION.fullmatch(stated + unit)
    ]
    if alike:
        raise InputFileError(
            f"the columns {quoted(', '.join(alike))} are no whole orientation; name one quaternion qx, qy, qz, qw, each once, "
            "or rename them for positions alone",
            path=table.path,
            line=table.header_line,
        )


def _plain(name: str) -> tuple[str, str]:
    """Return a name in lower case, and its unit in brackets."""
    name = name.strip(' \t"#%').lower()
    unit = _BRACKETS.search(name)
    return (name, "") if unit is None else (name[: unit.start()], unit[1].strip())


def _time(plain: Sequence[tuple[str, str]]) -> tuple[int, TimeUnit | None, int | None] | None:
    """Return the column of the time, its unit and the column of its nanoseconds.

    Of several the first, but rather a message's own stamp than the time at which it was recorded.
    """
    found: list[tuple[str, tuple[int, TimeUnit | None, int | None]]] = []
    for index, (name, unit) in enumerate(plain):
        if match := _TIME.fullmatch(name):
            found.append((name, (index, _UNITS.get(match[1] or unit), None)))
    for index, (name, _) in enumerate(plain[:-1]):
        if _SECONDS.fullmatch(name) and _NANOSECONDS.fullmatch(plain[index + 1][0]):
            found.append((name, (index, "s", index + 1)))
    return next((time for name, time in found if "header" in name), found[0][1] if found else None)


def _axes(plain: Sequence[tuple[str, str]], axes: str, *, position: bool) -> list[int] | None:
    """Return the columns of the axes; None unless each is named once."""
    found: dict[str, list[int]] = {axis: [] for axis in axes}
    for index, (name, _) in enumerate(plain):
        if position:
            match = _EUROC_POSITION.fullmatch(name)
            if match is None and not _NOT_POSITION.fullmatch(name):
                match = _POSITION.fullmatch(name)
        else:
            match = _EUROC_ORIENTATION.fullmatch(name) or _ORIENTATION.fullmatch(name)
        if match is not None:
            found[match[1]].append(index)
    if any(len(columns) != 1 for columns in found.values()):
        return None
    return [columns[0] for columns in found.values()]
