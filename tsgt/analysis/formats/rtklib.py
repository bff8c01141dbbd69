"""RTKLIB solution files (``.pos``): positions of one GNSS receiver with quality and number of satellites.

The header names the time system and the columns; times are calendar dates or GPS week and seconds in one of three time
systems, positions in one of three kinds of coordinates. A file without a header is rejected. Formats: RTKLIB 2.4.2
manual, appendix B.1.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import date
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from tsgt.errors import InputFileError, quoted

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

TimeSystem = Literal["GPST", "UTC", "JST"]
Coordinates = Literal["geodetic", "ecef", "baseline"]

QUALITIES = {
    0: "none",
    1: "fix",
    2: "float",
    3: "sbas",
    4: "dgps",
    5: "single",
    6: "ppp",
    7: "dead reckoning",
}
"""Meaning of the column Q; 0 and 7 are missing in the files' own legend, but defined in RTKLIB."""

SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * SECOND_NS
WEEK_NS = 7 * DAY_NS
GPS_EPOCH_NS = 315_964_800 * SECOND_NS  # 1980-01-06
_UNIX_EPOCH_DAY = date(1970, 1, 1).toordinal()
_FIRST_YEAR, _LAST_YEAR, _LAST_WEEK = 1980, 2199, 11_000

_MAX_COORDINATE_M = 1e8  # Upper limit of coordinates: no receiver is so far from the Earth or its base
_FIRST_COLUMN: dict[str, tuple[Coordinates, bool]] = {
    "latitude(deg)": ("geodetic", False),
    "latitude(d'\")": ("geodetic", True),
    "x-ecef(m)": ("ecef", False),
    "e-baseline(m)": ("baseline", False),
}
_TIME_FIELDS = 2
_CALENDAR = re.compile(r"(\d{4})/(\d{1,2})/(\d{1,2}) (\d{1,2}):(\d{1,2}):(\d{1,2})(?:\.(\d*))?", re.ASCII)
_WEEK = re.compile(r"(\d{1,5}) (\d{1,6})(?:\.(\d*))?", re.ASCII)
_SEPARATORS = str.maketrans(",;\t", "   ")


@dataclass(frozen=True, slots=True)
class PosFile:
    """Positions of one receiver as in its file, in the order of time.

    Attributes
    ----------
    time_system : GPS time, UTC, or Japan standard time (UTC + 9 h).
    times_ns : (M,) ns from 1970-01-01 00:00:00 on the calendar of ``time_system``, strictly increasing.
    coordinates
        ``geodetic``: latitude and longitude in rad, height in m. ``ecef``: x, y, z in m. ``baseline``: east, north and up
        from the base in m.
    positions : (M, 3) in these coordinates.
    quality : (M,) RTKLIB's Q, see :data:`QUALITIES`.
    satellites : (M,) number of satellites.
    base : Latitude, longitude (rad) and height (m) of the base; None unless the coordinates are relative to it.
    """

    path: Path
    time_system: TimeSystem
    times_ns: NDArray[np.int64]
    coordinates: Coordinates
    positions: NDArray[np.float64]
    quality: NDArray[np.int64]
    satellites: NDArray[np.int64]
    base: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True)
class _Columns:
    """Positions of the fields in a line."""

    time_system: TimeSystem
    coordinates: Coordinates
    sexagesimal: bool
    fields: int
    quality: int
    satellites: int


@dataclass(frozen=True, slots=True)
class _Place:
    """A line of a file, for messages."""

    path: Path
    line: int

    def error(self, message: str) -> InputFileError:
        return InputFileError(message, path=self.path, line=self.line)


def read_pos(path: Path) -> PosFile:
    """Read a solution file as RTKPOST, rnx2rtkp or RTKNAVI write it with the header switched on, sorted by time.

    Columns are separated by spaces, tabs, commas or semicolons. A backward solution is stored last epoch first. Raises
    InputFileError without a header, for another format, a truncated or invalid line, a duplicate epoch, or no positions at
    all.
    """
    columns: _Columns | None = None
    base: tuple[list[str], _Place] | None = None
    times: list[int] = []
    lines: list[int] = []
    rows: list[tuple[float, float, float, int, int]] = []
    for number, line in enumerate(_text(path).split("\n"), start=1):
        words = line.translate(_SEPARATORS).split()
        place = _Place(path, number)
        if not words:
            continue
        if words[0].startswith("%"):
            named = _columns(words, place)
            if columns is not None and named not in (None, columns):
                raise place.error("the columns change here; split files that were joined")
            columns = named or columns
            if re.match(r"%\s*(ref|slave) pos\s*:", line):
                base = line.split(":", 1)[1].translate(_SEPARATORS).split(), place
            if "=Tokyo" in line:
                raise place.error("is in the datum Tokyo; set RTKLIB's output datum to WGS84")
            continue
        if columns is None:
            raise place.error(_no_header(words[0]))
        if len(words) < columns.fields:
            raise place.error(
                f"expected {columns.fields} fields as in the header, got {len(words)}; remove the line if it was cut off"
            )
        times.append(_time_ns(words, place))
        lines.append(number)
        rows.append(_row(words, columns, place))
    if columns is None or not rows:
        raise InputFileError("contains no positions; expected a solution file of RTKLIB", path=path)
    order = np.argsort(times, kind="stable")
    times_ns = np.array(times, dtype=np.int64)[order]
    duplicates = np.flatnonzero(np.diff(times_ns) == 0)
    if len(duplicates):
        first, second = (lines[order[duplicates[0] + k]] for k in (0, 1))
        raise _Place(path, second).error(f"has the time of line {first}; keep one of the two")
    numbers = np.array(rows)[order]
    return PosFile(
        path=path,
        time_system=columns.time_system,
        times_ns=times_ns,
        coordinates=columns.coordinates,
        positions=numbers[:, :3],
        quality=numbers[:, 3].astype(np.int64),
        satellites=numbers[:, 4].astype(np.int64),
        base=_base(base, path) if columns.coordinates == "baseline" else None,
    )


def _text(path: Path) -> str:
    """Return the file's text; file names in the header may have any encoding."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputFileError(error.strerror or str(error), path=path) from error
    if b"\0" in content:
        raise InputFileError("is not a text file", path=path)
    return content.decode("utf-8-sig", errors="replace")


def _columns(words: Sequence[str], place: _Place) -> _Columns | None:
    """Parse the header line that names the columns; None for other lines."""
    names = " ".join(words).lstrip("% ").split()
    kinds = [(i, _FIRST_COLUMN[name]) for i, name in enumerate(names) if name in _FIRST_COLUMN]
    if not kinds:
        return None
    first, (coordinates, sexagesimal) = kinds[0]
    system = " ".join(names[:first])
    if system not in get_args(TimeSystem):
        raise place.error(
            f"expected the time system GPST, UTC or JST before the columns, got {quoted(system)}"
        )
    names = names[first:]
    if "Q" not in names[3:] or "ns" not in names[3:]:
        raise place.error("names no columns Q and ns; configure RTKLIB to write them")
    # Degrees, minutes and seconds of latitude and longitude are three fields each.
    shift = _TIME_FIELDS + (4 if sexagesimal else 0)
    return _Columns(
        time_system=system,  # type: ignore[arg-type]  # one of them, see above
        coordinates=coordinates,
        sexagesimal=sexagesimal,
        fields=shift + len(names),
        quality=shift + names.index("Q"),
        satellites=shift + names.index("ns"),
    )


def _no_header(word: str) -> str:
    if word.startswith("$"):
        return "is NMEA or a status; configure RTKLIB to write its solution as lat/lon/height or x/y/z"
    return (
        "precedes the line that names time system and columns (%  GPST  latitude(deg) ...); "
        "switch the header on in RTKLIB's output options"
    )


def _row(words: Sequence[str], columns: _Columns, place: _Place) -> tuple[float, float, float, int, int]:
    given = words[_TIME_FIELDS : columns.quality]
    if columns.coordinates == "geodetic":
        position = _geodetic(given, place, sexagesimal=columns.sexagesimal)
    else:
        position = _metres(given[0], place), _metres(given[1], place), _metres(given[2], place)
    quality = _integer(words[columns.quality], "Q", max(QUALITIES), place)
    return *position, quality, _integer(words[columns.satellites], "ns", 999, place)


def _base(given: tuple[list[str], _Place] | None, path: Path) -> tuple[float, float, float]:
    if given is None:
        raise InputFileError(
            "contains positions relative to a base, but no line with its position (% ref pos); "
            "configure RTKLIB to write lat/lon/height instead",
            path=path,
        )
    words, place = given
    if len(words) not in (3, 7):
        raise place.error("expected latitude, longitude and height of the base")
    return _geodetic(words, place, sexagesimal=len(words) == 7)


def _geodetic(words: Sequence[str], place: _Place, *, sexagesimal: bool) -> tuple[float, float, float]:
    if sexagesimal:
        latitude, longitude = _sexagesimal(words[:3], place), _sexagesimal(words[3:6], place)
    else:
        latitude, longitude = _number(words[0], place), _number(words[1], place)
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise place.error(f"latitude {latitude:g}, longitude {longitude:g} deg is not on Earth")
    return math.radians(latitude), math.radians(longitude), _metres(words[6 if sexagesimal else 2], place)


def _sexagesimal(words: Sequence[str], place: _Place) -> float:
    degrees, minutes, seconds = (_number(word, place) for word in words)
    if not (0 <= minutes < 60 and 0 <= seconds <= 60):  # RTKLIB may round seconds up to 60
        raise place.error(f"expected degrees, minutes and seconds, got {quoted(' '.join(words))}")
    size = abs(degrees) + minutes / 60 + seconds / 3600
    return -size if words[0].startswith("-") else size  # the sign of -0 counts too


def _metres(word: str, place: _Place) -> float:
    value = _number(word, place)
    if abs(value) > _MAX_COORDINATE_M:
        raise place.error(f"{word} m is too far from the Earth")
    return value


def _number(word: str, place: _Place) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise place.error(f"expected a finite number, got {quoted(word)}")
    return value


def _integer(word: str, name: str, largest: int, place: _Place) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 4 and int(word) <= largest):
        raise place.error(f"column {name}: expected 0 to {largest}, got {quoted(word)}")
    return int(word)


def _time_ns(words: Sequence[str], place: _Place) -> int:
    """Return ns since 1970 on the file's own calendar, without a float, which would lose them."""
    text = " ".join(words[:_TIME_FIELDS])
    if found := _CALENDAR.fullmatch(text):
        year, month, day, hour, minute, second = map(int, found.groups()[:6])
        if _FIRST_YEAR <= year <= _LAST_YEAR and hour < 24 and minute < 60 and second < 60:
            try:
                days = date(year, month, day).toordinal() - _UNIX_EPOCH_DAY
            except ValueError:  # a 31st of February
                pass
            else:
                return days * DAY_NS + (3600 * hour + 60 * minute + second) * SECOND_NS + _fraction(found[7])
    elif found := _WEEK.fullmatch(text):
        week, second = int(found[1]), int(found[2])
        if week <= _LAST_WEEK and second * SECOND_NS < WEEK_NS:
            return GPS_EPOCH_NS + week * WEEK_NS + second * SECOND_NS + _fraction(found[3])
    raise place.error(
        f"expected a time (2022/03/14 14:47:49.000, or GPS week and seconds), got {quoted(text)}"
    )


def _fraction(digits: str | None) -> int:
    return int(((digits or "") + "000000000")[:9])
