"""CSV files with named columns, and error messages with path, line and column."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING

from tsgt.analysis.text_file import read_text
from tsgt.errors import InputFileError, quoted
from tsgt.estimation import MAX_DISTANCE_M
from tsgt.model import MAX_INSTANT_NS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

RAD_PER_UNIT = {"rad": 1.0, "deg": math.pi / 180, "gon": math.pi / 200}

HORIZONTAL = tuple(f"horizontal_angle_{unit}" for unit in RAD_PER_UNIT)
ZENITH = tuple(f"zenith_angle_{unit}" for unit in RAD_PER_UNIT)
TIME = ("stamp_ns", "time_s")

_FULL_CIRCLE_RAD = 2 * math.pi + 1e-4
"""An instrument rounds the last angles before zero up, to 400 gon or 6.2832."""


@dataclass(frozen=True, slots=True)
class Header:
    """The column names of a file."""

    path: Path
    line: int
    names: list[str]

    def expect(self, columns: Sequence[Sequence[str]], optional: Sequence[str]) -> None:
        """Raise unless each tuple of ``columns`` has exactly one of its names, and no name is unknown or doubled."""
        known = {*optional, *(name for alternatives in columns for name in alternatives)}
        for name in self.names:
            if name not in known:
                expected = ", ".join("|".join(alternatives) for alternatives in columns)
                if optional:
                    expected += f" and optionally {', '.join(optional)}"
                hint = ""
                if len(self.names) == 1 and any(separator in name for separator in ";\t"):
                    hint = "; columns are separated by commas"
                elif name[:1].isdigit():
                    hint = "; the first line that is no comment (#) must have the names of the columns"
                raise self.error(f"unknown column {quoted(name)}{hint}; expected {expected}")
        for alternatives in (*columns, *([name] for name in optional)):
            found = [name for name in self.names if name in alternatives]
            if len(found) > 1 or (not found and alternatives[0] not in optional):
                raise self.error(
                    f"expected one column {' or '.join(alternatives)}, got {' and '.join(found) or 'none'}"
                )

    def error(self, message: str) -> InputFileError:
        """Return an error with the number of this line."""
        return InputFileError(message, path=self.path, line=self.line)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a file: its cells by column name."""

    path: Path
    line: int
    cells: dict[str, str]

    def error(self, message: str) -> InputFileError:
        """Return an error with the number of this line."""
        return InputFileError(message, path=self.path, line=self.line)

    def number(self, column: str) -> float:
        """Parse a finite number."""
        try:
            value = float(self.cells[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f"{column} is {quoted(self.cells[column])}; expected a finite number")
        return value

    def within(self, column: str, minimum: float, maximum: float) -> float:
        """Parse a number between two limits, inclusive."""
        value = self.number(column)
        if not minimum <= value <= maximum:
            raise self.error(f"{column} is {quoted(self.cells[column])}; expected {minimum:g} to {maximum:g}")
        return value

    def positive_integer(self, column: str) -> int:
        """Parse the number of a station, prism or target."""
        text = self.cells[column]
        if not (text.isascii() and text.isdigit() and 0 < len(text) <= 6 and int(text) > 0):
            raise self.error(f"{column} is {quoted(text)}; expected a whole number from 1 to 999999")
        return int(text)

    def non_negative_integer(self, column: str) -> int:
        """Parse a non-negative 64-bit integer: counts, and times in ns."""
        text = self.cells[column]
        if not (text.isascii() and text.isdigit() and len(text) <= 19 and int(text) <= MAX_INSTANT_NS):
            raise self.error(
                f"{column} is {quoted(text)}; expected a whole number from 0 to {MAX_INSTANT_NS}"
            )
        return int(text)

    def signed_integer(self, column: str) -> int:
        """Parse a 64-bit integer of either sign."""
        text = self.cells[column]
        digits = text.removeprefix("-")
        if not (
            digits.isascii() and digits.isdigit() and len(digits) <= 19 and int(digits) <= MAX_INSTANT_NS
        ):
            raise self.error(f"{column} is {quoted(text)}; expected a whole number")
        return int(text)

    def seconds_ns(self, column: str) -> int:
        """Parse a Unix time in s as whole nanoseconds, without a float, which would lose them."""
        try:
            # Check the limits first: expanding a huge exponent would take forever.
            time_s = Decimal(self.cells[column])
            inside = time_s.is_finite() and 0 <= time_s <= Decimal(MAX_INSTANT_NS).scaleb(-9)
        except InvalidOperation:
            inside = False
        if not inside:
            raise self.error(f"{column} is {quoted(self.cells[column])}; expected a Unix time in s")
        return int(time_s.scaleb(9).to_integral_value())

    def stamp_ns(self) -> int:
        """Parse the Unix time in ns, or in s."""
        stated_ns = "stamp_ns" in self.cells
        return self.non_negative_integer("stamp_ns") if stated_ns else self.seconds_ns("time_s")

    def angles_rad(self, horizontal: str | None = None, zenith: str | None = None) -> tuple[float, float]:
        """Parse horizontal and zenith angle; the default columns are those whose names end with their unit."""
        horizontal = horizontal or next(name for name in HORIZONTAL if name in self.cells)
        zenith = zenith or next(name for name in ZENITH if name in self.cells)
        horizontal_rad = self.number(horizontal) * RAD_PER_UNIT.get(horizontal.rpartition("_")[2], 1.0)
        zenith_rad = self.number(zenith) * RAD_PER_UNIT.get(zenith.rpartition("_")[2], 1.0)
        if abs(horizontal_rad) > _FULL_CIRCLE_RAD:
            raise self.error(
                f"{horizontal} {self.cells[horizontal]} is more than a full circle; is the unit right?"
            )
        if not 0 <= zenith_rad <= _FULL_CIRCLE_RAD:
            raise self.error(
                f"{zenith} {self.cells[zenith]} is outside 0 to a full circle; it is measured from the zenith, "
                "not from the horizon"
            )
        return horizontal_rad, zenith_rad

    def distance_m(self, column: str) -> float:
        """Parse a positive distance."""
        distance_m = self.number(column)
        if distance_m <= 0:
            raise self.error(f"{column} is {self.cells[column]}; expected more than zero, remove the line")
        if distance_m > MAX_DISTANCE_M:
            raise self.error(
                f"{column} is {quoted(self.cells[column])}; expected at most {MAX_DISTANCE_M:g} m"
            )
        return distance_m


def read_table(path: Path) -> tuple[Header, Iterator[Row]]:
    """Read header and rows of a CSV file; blank lines and comments (``#``) are ignored.

    Raises InputFileError if it cannot be read or has no rows; on iteration: if a row has not as many cells as the header.
    """
    lines = [
        (number, _cells(line, path, number))
        for number, line in enumerate(read_text(path).splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InputFileError("is empty; expected a header line and one line per measurement", path=path)
    if len(lines) == 1:
        raise InputFileError("holds a header but no measurements", path=path)
    header = Header(path, *lines[0])
    return header, _rows(header, lines[1:])


def _cells(line: str, path: Path, number: int) -> list[str]:
    try:
        (cells,) = csv.reader([line], skipinitialspace=True)
    except csv.Error as error:
        raise InputFileError(f"is not CSV: {error}", path=path, line=number) from error
    return [cell.strip() for cell in cells]


def _rows(header: Header, lines: list[tuple[int, list[str]]]) -> Iterator[Row]:
    """Yield rows one by one, so that an invalid header is reported before invalid rows."""
    for number, cells in lines:
        row = Row(header.path, number, dict(zip(header.names, cells, strict=False)))
        if len(cells) != len(header.names):
            raise row.error(f"expected {len(header.names)} columns as in the header, got {len(cells)}")
        yield row
