"""Tables of numbers in text files, with commas, semicolons or blanks, with or without column names; times to the nanosecond."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from tsgt.analysis.text_file import read_text
from tsgt.errors import InputFileError, quoted
from tsgt.model import MAX_INSTANT_NS

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

TimeUnit = Literal["s", "ms", "us", "ns"]

DIGITS: Final[dict[TimeUnit, int]] = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Decimal places of a unit down to the nanosecond."""

UNIT_NAMES: Final[dict[TimeUnit, str]] = {
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
}

_PLAIN = re.compile(r"[0-9]+(?:\.[0-9]*)?", re.ASCII)
_NUMBER = re.compile(r"[-+]?(?:[0-9.]|(?:nan|inf)$)", re.ASCII | re.IGNORECASE)

# Unix times of 1973 to 5138 by unit: the same number cannot be one of another unit.
_ABSOLUTE: tuple[tuple[float, TimeUnit], ...] = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
# Unix times of less than five years.
_FROM_ZERO = 0.1
# Steps between times from zero on: no estimate has a pose every 1000 s.
_RELATIVE: tuple[tuple[float, TimeUnit], ...] = ((1.5e6, "ns"), (1e3, "us"))


@dataclass(frozen=True, slots=True)
class NumberTable:
    """M rows of C cells, as text."""

    path: Path
    names: list[str] | None  # (C,) from a header line, or a comment before the first row that fits
    columns: list[tuple[str, ...]]  # C columns of M cells
    header_line: int | None  # None: the names stand in a comment
    line: list[int]  # (M,) line of each row
    separated: bool  # By commas or semicolons

    def numbers(self, *columns: int) -> FloatArray:
        """Return some columns as numbers, (M, K); an empty cell is NaN."""
        return np.column_stack([self._column(index) for index in columns])

    def error(self, message: str, row: int) -> InputFileError:
        """Return an error with the line of a row."""
        return InputFileError(message, path=self.path, line=self.line[row])

    def _column(self, index: int) -> FloatArray:
        cells = self.columns[index]
        try:
            return np.array(list(map(float, cells)))
        except (ValueError, OverflowError):
            return np.array([self._number(cell, row) for row, cell in enumerate(cells)])

    def _number(self, cell: str, row: int) -> float:
        if not cell:
            return float("nan")
        try:
            return float(cell)
        except (ValueError, OverflowError) as error:
            raise self.error(f"{quoted(cell)} is no number", row) from error


def read_number_table(path: Path) -> NumberTable:
    """Read a table; ``#`` and ``%`` start comments.

    A first line that does not start with a number names the columns, as does the last comment before the first row if it has
    as many words as the row has cells. Raises InputFileError if the file cannot be read, is empty, or a row has another number
    of cells than the first.
    """
    names: list[str] | None = None
    header_line: int | None = None
    comment = ""
    rows: list[list[str]] = []
    numbers: list[int] = []
    separator: str | None = None
    for number, written in enumerate(read_text(path).splitlines(), start=1):
        line = written.strip()
        if not line:
            continue
        if line[0] in "#%":
            comment = comment if rows else line
            continue
        if not rows:
            separator = "," if "," in line else ";" if ";" in line else None
        if "#" in line:
            line = line.split("#", maxsplit=1)[0].rstrip()
        cells = _cells(line, separator)
        if not rows and names is None and not _NUMBER.match(cells[0]):
            names, header_line = cells, number
            continue
        if rows and len(cells) != len(rows[0]):
            raise InputFileError(
                f"has {len(cells)} columns where the lines before have {len(rows[0])}", path=path, line=number
            )
        rows.append(cells)
        numbers.append(number)
    if not rows:
        raise InputFileError("holds no poses", path=path)
    columns: list[tuple[str, ...]] = list(zip(*rows, strict=True))
    if len(columns) > 1 and not any(columns[-1]) and (names is None or len(names) < len(columns)):
        del columns[-1]  # every line ends with a comma
    if names is None:
        stated = _cells(comment.lstrip("#% "), separator)
        names = stated if len(stated) == len(columns) else None
    elif len(names) != len(columns):
        raise InputFileError(
            f"has {len(columns)} columns where the header names {len(names)}", path=path, line=numbers[0]
        )
    return NumberTable(path, names, columns, header_line, numbers, separator is not None)


def _cells(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    return [cell.strip(' \t"') for cell in line.split(separator)]


def times_ns(
    table: NumberTable, column: int, unit: TimeUnit | None = None
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return a column of times in whole nanoseconds, (M,), exact; without ``unit``, by their size, with a note unless seconds.

    Raises InputFileError for a time that is no number, negative or beyond 64 bits.
    """
    cells = table.columns[column]
    notes: tuple[str, ...] = ()
    if unit is None:
        unit = unit_of(table.numbers(column)[:, 0])
        if unit != "s":
            notes = (f"times are {UNIT_NAMES[unit]}, by their size",)
    digits = DIGITS[unit]
    factor = 10**digits
    stamps = []
    for row, cell in enumerate(cells):
        whole, _, fraction = cell.partition(".")
        if _PLAIN.fullmatch(cell) and len(fraction) <= digits and len(whole) <= 19:
            stamp_ns = int(whole) * factor + (int(fraction.ljust(digits, "0")) if fraction else 0)
        else:
            stamp_ns = _slow_time_ns(table, row, cell, digits)
        if not 0 <= stamp_ns <= MAX_INSTANT_NS:
            raise table.error(f"the time {quoted(cell)} is negative or beyond the year 2262", row)
        stamps.append(stamp_ns)
    return np.array(stamps, dtype=np.int64), notes


def _slow_time_ns(table: NumberTable, row: int, cell: str, digits: int) -> int:
    try:
        value = Decimal(cell)
        # A huge exponent would take forever to expand.
        if not value.is_finite() or value.adjusted() > 20:
            raise ValueError(cell)
        return round(value.scaleb(digits))
    except (ValueError, ArithmeticError) as error:  # decimal raises the latter
        raise table.error(f"the time {quoted(cell)} is no number of this century", row) from error


def unit_of(values: FloatArray) -> TimeUnit:
    """Return the unit of times, (M,): Unix times by their size, times from zero on by the steps between them."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return "s"
    # Numbers of any size may stand here.
    with np.errstate(over="ignore"):
        steps = np.abs(np.diff(finite))
        from_zero = np.ptp(finite) > _FROM_ZERO * np.abs(finite).min()
    table, sizes = (_RELATIVE, steps[steps > 0]) if from_zero else (_ABSOLUTE, finite)
    typical = float(np.quantile(sizes, 0.5, method="lower"))
    return next((unit for least, unit in table if typical >= least), "s")


def joined_times_ns(table: NumberTable, seconds: int, nanoseconds: int) -> NDArray[np.int64]:
    """Return times whose seconds and nanoseconds stand in two columns, (M,); raises as :func:`times_ns`."""
    whole, _ = times_ns(table, seconds, "s")
    part, _ = times_ns(table, nanoseconds, "ns")
    return whole + part
