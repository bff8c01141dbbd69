"""Hand-made measurement files: targets seen by several stations, prisms and body points seen by one.

Both formats and the authors' marker file are described in docs/reference/target-file.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from tsgt.model import Vector3

RAD_PER_UNIT = {"rad": 1.0, "deg": math.pi / 180, "gon": math.pi / 200}

MARKER_COLUMNS = (
    "theodolite_number", "marker_number", "status", "elevation", "azimuth", "distance", "sec", "nsec",
)  # fmt: skip
"""Header of the authors' marker file. Their ``elevation`` is a zenith angle; angles are in rad."""

_HORIZONTAL = [f"horizontal_angle_{unit}" for unit in RAD_PER_UNIT]
_ZENITH = [f"zenith_angle_{unit}" for unit in RAD_PER_UNIT]
_SIGHT = [_HORIZONTAL, _ZENITH, ["slope_distance_m"]]
_CAD = ("x_m", "y_m", "z_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """One measurement of a target, raw, in either face.

    Attributes
    ----------
    horizontal_angle_rad
        Horizontal circle in rad, clockwise.
    zenith_angle_rad
        Angle from straight up in rad; above pi in the second face.
    slope_distance_m
        As the instrument gave it, in m.
    constant_m
        Constant to be added to this distance in m; None: that of the command line.
    line
        Line of the file it stands in, from 1.
    """

    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float
    constant_m: float | None = None
    line: int


@dataclass(frozen=True, slots=True)
class TargetFile:
    """What several stations measured of common targets.

    Attributes
    ----------
    path
        Where it was read from.
    sights
        By station number and target number: its measurements, at least one.
    skipped
        One sentence for each line that was left out because the instrument reported an error.
    """

    path: Path
    sights: dict[int, dict[int, list[Sight]]]
    skipped: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PrismFile:
    """What one station measured of the robot's prisms and body points.

    Attributes
    ----------
    path
        Where it was read from.
    prisms
        By prism number: its measurements, at least one.
    body
        By name of the body point: its measurements, at least one.
    cad_m
        By name of the body point: its position in the frame ``robot`` from CAD in m.
    """

    path: Path
    prisms: dict[int, list[Sight]]
    body: dict[str, list[Sight]]
    cad_m: dict[str, Vector3]


def read_target_file(path: Path) -> TargetFile:
    """Read targets seen by several stations, from our CSV or from the authors' marker file.

    Parameters
    ----------
    path
        The file. The header line tells which of the two it is.

    Returns
    -------
    TargetFile
        At least station 1 and one other. Marker lines with a status other than 0 are left out and told of:
        the instrument itself said that they are wrong (paper section III-D, first step).

    Raises
    ------
    InputFileError
        The file cannot be read, is empty, has a wrong column or number, or a station is missing.
    """
    file = read_some_targets(path)
    if 1 not in file.sights:
        raise InputFileError(
            "holds no usable target of station 1, whose frame is the world; add them", path=path
        )
    if len(file.sights) == 1:
        raise InputFileError("holds targets of station 1 only; add those of the other stations", path=path)
    return file


def read_some_targets(path: Path) -> TargetFile:
    """Read a file of targets as :func:`read_target_file` does, whichever stations it holds.

    Raises
    ------
    InputFileError
        The file cannot be read, is empty, or has a wrong column or number.
    """
    header, rows = _table(path)
    sights: dict[int, dict[int, list[Sight]]] = {}
    skipped: list[str] = []
    is_marker_file = tuple(header.names) == MARKER_COLUMNS
    if not is_marker_file:
        header.expect([["station"], ["target"], *_SIGHT], "constant_mm")
    for row in rows:
        station = row.positive_integer("theodolite_number" if is_marker_file else "station")
        target = row.positive_integer("marker_number" if is_marker_file else "target")
        if is_marker_file and row.cells["status"] != "0":
            skipped.append(
                f"{path}, line {row.line}: target {target} of station {station} left out: "
                f"the instrument reported status {row.cells['status']}"
            )
            continue
        sight = row.sight("azimuth", "elevation", "distance") if is_marker_file else row.sight()
        sights.setdefault(station, {}).setdefault(target, []).append(sight)
    return TargetFile(path, dict(sorted(sights.items())), tuple(skipped))


def read_prism_file(path: Path) -> PrismFile:
    """Read prisms and body points seen by one station.

    Parameters
    ----------
    path
        Our CSV: each line is a ``prism`` or a ``body`` point, the latter with its place from CAD.

    Returns
    -------
    PrismFile
        At least one prism and one body point.

    Raises
    ------
    InputFileError
        The file cannot be read, is empty, has a wrong column or number, or holds no prism or no body point.
    """
    header, rows = _table(path)
    header.expect([["point"], ["kind"], *_SIGHT, *([name] for name in _CAD)], "constant_mm")
    prisms: dict[int, list[Sight]] = {}
    body: dict[str, list[Sight]] = {}
    cad_m: dict[str, Vector3] = {}
    for row in rows:
        kind = row.cells["kind"]
        if kind == "prism":
            if any(row.cells[column] for column in _CAD):
                raise row.error(
                    "a prism has no place from CAD, it is what is looked for; leave x_m, y_m, z_m empty"
                )
            prisms.setdefault(row.positive_integer("point"), []).append(row.sight())
        elif kind == "body":
            name = row.cells["point"]
            if not name:
                raise row.error("a body point needs a name in the column point")
            place = (row.number("x_m"), row.number("y_m"), row.number("z_m"))
            if cad_m.setdefault(name, place) != place:
                raise row.error(f"body point {name} has another x_m, y_m, z_m further up; keep one of them")
            body.setdefault(name, []).append(row.sight())
        else:
            raise row.error(f"kind is {kind!r}; it is prism or body")
    if not prisms:
        raise InputFileError("holds no prism; add lines of kind prism", path=path)
    if not body:
        raise InputFileError("holds no body point; add at least three lines of kind body", path=path)
    return PrismFile(path, dict(sorted(prisms.items())), body, cad_m)


@dataclass(frozen=True, slots=True)
class _Header:
    """The column names of a file."""

    path: Path
    line: int
    names: list[str]

    def expect(self, columns: Sequence[Sequence[str]], optional: str) -> None:
        """Refuse a header that lacks a column (of each, one of its alternatives), or has an unknown one."""
        known = {optional, *(name for alternatives in columns for name in alternatives)}
        for name in self.names:
            if name not in known:
                asked = ", ".join("|".join(alternatives) for alternatives in columns)
                raise self.error(f"unknown column {name!r}; expected {asked} and maybe {optional}")
        for alternatives in (*columns, [optional]):
            found = [name for name in self.names if name in alternatives]
            if len(found) > 1 or (not found and optional not in alternatives):
                raise self.error(
                    f"expected one column {' or '.join(alternatives)}, got {' and '.join(found) or 'none'}"
                )

    def error(self, message: str) -> InputFileError:
        return InputFileError(message, path=self.path, line=self.line)


@dataclass(frozen=True, slots=True)
class _Row:
    """One line of a file: its cells by column name."""

    path: Path
    line: int
    cells: dict[str, str]

    def error(self, message: str) -> InputFileError:
        return InputFileError(message, path=self.path, line=self.line)

    def number(self, column: str) -> float:
        try:
            value = float(self.cells[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f"{column} is {self.cells[column]!r}; expected a finite number")
        return value

    def positive_integer(self, column: str) -> int:
        text = self.cells[column]
        if not (text.isascii() and text.isdigit() and 0 < len(text) <= 6 and int(text) > 0):
            raise self.error(f"{column} is {text!r}; expected a whole number from 1 to 999999")
        return int(text)

    def sight(
        self, horizontal: str | None = None, zenith: str | None = None, distance: str = "slope_distance_m"
    ) -> Sight:
        """Read the measurement; without column names those of our own format."""
        horizontal = horizontal or next(name for name in _HORIZONTAL if name in self.cells)
        zenith = zenith or next(name for name in _ZENITH if name in self.cells)
        horizontal_rad = self.number(horizontal) * RAD_PER_UNIT.get(horizontal.rpartition("_")[2], 1.0)
        zenith_rad = self.number(zenith) * RAD_PER_UNIT.get(zenith.rpartition("_")[2], 1.0)
        distance_m = self.number(distance)
        if abs(horizontal_rad) > 2 * math.pi:
            raise self.error(
                f"{horizontal} {self.cells[horizontal]} is more than a full circle; is the unit right?"
            )
        if not 0 <= zenith_rad <= 2 * math.pi:
            raise self.error(
                f"{zenith} {self.cells[zenith]} is outside 0 to a full circle; it counts from straight up, "
                "not from the horizon"
            )
        if distance_m <= 0:
            raise self.error(
                f"{distance} is {self.cells[distance]}; expected more than zero, remove the line"
            )
        return Sight(
            horizontal_angle_rad=horizontal_rad,
            zenith_angle_rad=zenith_rad,
            slope_distance_m=distance_m,
            constant_m=self.number("constant_mm") / 1e3 if self.cells.get("constant_mm") else None,
            line=self.line,
        )


def _table(path: Path) -> tuple[_Header, Iterator[_Row]]:
    """Header and rows of a comma-separated file; blank lines and those that start with # do not count."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets write a byte order mark
    except UnicodeDecodeError as error:
        raise InputFileError("is not a text file", path=path) from error
    except OSError as error:
        raise InputFileError(error.strerror or str(error), path=path) from error
    lines = [
        (number, [cell.strip() for cell in line.split(",")])
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InputFileError("is empty; expected a header line and one line per measurement", path=path)
    if len(lines) == 1:
        raise InputFileError("holds a header but no measurements", path=path)
    header = _Header(path, *lines[0])
    return header, _rows(header, lines[1:])


def _rows(header: _Header, lines: list[tuple[int, list[str]]]) -> Iterator[_Row]:
    """Cells by column name, line by line, so that a bad header is reported before bad lines."""
    for number, cells in lines:
        row = _Row(header.path, number, dict(zip(header.names, cells, strict=False)))
        if len(cells) != len(header.names):
            raise row.error(f"expected {len(header.names)} columns as in the header, got {len(cells)}")
        yield row
