"""Comma-separated files with named columns, with one clear line for whatever is wrong in them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING

from tsgt.errors import InputFileError, quoted
from tsgt.estimation import MAX_DISTANCE_M
from tsgt.model import MAX_INSTANT_NS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

RAD_PER_UNIT = {"rad": 1.0, "deg": math.pi / 180, "gon": math.pi / 200}

HORIZONTAL = tuple(f"horizontal_angle_{unit}" for unit in RAD_PER_UNIT)
ZENITH = tuple(f"zenith_angle_{unit}" for unit in RAD_PER_UNIT)


@dataclass(frozen=True, slots=True)
class Header:
    """The column names of a file."""

    path: Path
    line: int
    names: list[str]

    def expect(self, columns: Sequence[Sequence[str]], optional: Sequence[str]) -> None:
        """Refuse a header that lacks a column (of each, one of its alternatives), or has an unknown one or one twice."""
        known = {*optional, *(name for alternatives in columns for name in alternatives)}
        for name in self.names:
            if name not in known:
                asked = ", ".join("|".join(alternatives) for alternatives in columns)
                raise self.error(
                    f"unknown column {quoted(name)}; expected {asked} and maybe {', '.join(optional)}"
                )
        for alternatives in (*columns, *([name] for name in optional)):
            found = [name for name in self.names if name in alternatives]
            if len(found) > 1 or (not found and alternatives[0] not in optional):
                raise self.error(
                    f"expected one column {' or '.join(alternatives)}, got {' and '.join(found) or 'none'}"
                )

    def error(self, message: str) -> InputFileError:
        """Make an error that names this line."""
        return InputFileError(message, path=self.path, line=self.line)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a file: its cells by column name."""

    path: Path
    line: int
    cells: dict[str, str]

    def error(self, message: str) -> InputFileError:
        """Make an error that names this line."""
        return InputFileError(message, path=self.path, line=self.line)

    def number(self, column: str) -> float:
        """Read a finite number."""
        try:
            value = float(self.cells[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f"{column} is {quoted(self.cells[column])}; expected a finite number")
        return value

    def within(self, column: str, least: float, most: float) -> float:
        """Read a number between limits, both of which are allowed."""
        value = self.number(column)
        if not least <= value <= most:
            raise self.error(f"{column} is {quoted(self.cells[column])}; expected {least:g} to {most:g}")
        return value

    def positive_integer(self, column: str) -> int:
        """Read a number of a station, a prism or a target."""
        text = self.cells[column]
        if not (text.isascii() and text.isdigit() and 0 < len(text) <= 6 and int(text) > 0):
            raise self.error(f"{column} is {quoted(text)}; expected a whole number from 1 to 999999")
        return int(text)

    def whole(self, column: str) -> int:
        """Read a whole number from 0 on that fits into 64 bits: counts, and times in ns."""
        text = self.cells[column]
        if not (text.isascii() and text.isdigit() and len(text) <= 19 and int(text) <= MAX_INSTANT_NS):
            raise self.error(
                f"{column} is {quoted(text)}; expected a whole number from 0 to {MAX_INSTANT_NS}"
            )
        return int(text)

    def seconds_ns(self, column: str) -> int:
        """Read a Unix time in s to the nanosecond, which a float would not hold."""
        try:
            # Limits first: the power of ten of a huge number would take for ever.
            time_s = Decimal(self.cells[column])
            inside = time_s.is_finite() and 0 <= time_s <= Decimal(MAX_INSTANT_NS).scaleb(-9)
        except InvalidOperation:
            inside = False
        if not inside:
            raise self.error(f"{column} is {quoted(self.cells[column])}; expected a Unix time in s")
        return int(time_s.scaleb(9).to_integral_value())

    def angles_rad(self, horizontal: str | None = None, zenith: str | None = None) -> tuple[float, float]:
        """Read both angles in rad; without column names those whose names end with their unit."""
        horizontal = horizontal or next(name for name in HORIZONTAL if name in self.cells)
        zenith = zenith or next(name for name in ZENITH if name in self.cells)
        horizontal_rad = self.number(horizontal) * RAD_PER_UNIT.get(horizontal.rpartition("_")[2], 1.0)
        zenith_rad = self.number(zenith) * RAD_PER_UNIT.get(zenith.rpartition("_")[2], 1.0)
        if abs(horizontal_rad) > 2 * math.pi:
            raise self.error(
                f"{horizontal} {self.cells[horizontal]} is more than a full circle; is the unit right?"
            )
        if not 0 <= zenith_rad <= 2 * math.pi:
            raise self.error(
                f"{zenith} {self.cells[zenith]} is outside 0 to a full circle; it counts from straight up, "
                "not from the horizon"
            )
        return horizontal_rad, zenith_rad

    def distance_m(self, column: str) -> float:
        """Read a distance above zero."""
        distance_m = self.number(column)
        if distance_m <= 0:
            raise self.error(f"{column} is {self.cells[column]}; expected more than zero, remove the line")
        if distance_m > MAX_DISTANCE_M:
            raise self.error(f"{column} is {quoted(self.cells[column])}; expected at most {MAX_DISTANCE_M:g} m")
        return distance_m


def read_table(path: Path) -> tuple[Header, Iterator[Row]]:
    """Read header and rows of a comma-separated file; blank lines and those that start with # do not count.

    Raises
    ------
    InputFileError
        The file cannot be read, or holds no rows; while rows are taken: one has not as many cells as the header.
    """
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
    header = Header(path, *lines[0])
    return header, _rows(header, lines[1:])


def _rows(header: Header, lines: list[tuple[int, list[str]]]) -> Iterator[Row]:
    """Cells by column name, line by line, so that a bad header is reported before bad lines."""
    for number, cells in lines:
        row = Row(header.path, number, dict(zip(header.names, cells, strict=False)))
        if len(cells) != len(header.names):
            raise row.error(f"expected {len(header.names)} columns as in the header, got {len(cells)}")
        yield row
