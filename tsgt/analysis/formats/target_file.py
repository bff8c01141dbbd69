"""Hand-made measurement files: targets seen by several stations, prisms and body points seen by one.

Both formats and the authors' marker file are described in docs/reference/target-file.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.analysis.formats.csv_table import HORIZONTAL, ZENITH, read_table
from tsgt.errors import InputFileError, quoted
from tsgt.model import MAX_COORDINATE_M

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.formats.csv_table import Row
    from tsgt.model import Vector3

MARKER_COLUMNS = (
    "theodolite_number", "marker_number", "status", "elevation", "azimuth", "distance", "sec", "nsec",
)  # fmt: skip
"""Header of the authors' marker file. Their ``elevation`` is a zenith angle; angles are in rad."""

_SIGHT = [HORIZONTAL, ZENITH, ["slope_distance_m"]]
_CAD = ("x_m", "y_m", "z_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetMeasurement:
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
    sights: dict[int, dict[int, list[TargetMeasurement]]]
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
    prisms: dict[int, list[TargetMeasurement]]
    body: dict[str, list[TargetMeasurement]]
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
    file = read_partial_target_file(path)
    if 1 not in file.sights:
        raise InputFileError(
            "holds no usable target of station 1, whose frame is the world; add them", path=path
        )
    if len(file.sights) == 1:
        raise InputFileError("holds targets of station 1 only; add those of the other stations", path=path)
    return file


def read_partial_target_file(path: Path) -> TargetFile:
    """Read a file of targets as :func:`read_target_file` does, whichever stations it holds.

    Raises
    ------
    InputFileError
        The file cannot be read, is empty, or has a wrong column or number.
    """
    header, rows = read_table(path)
    sights: dict[int, dict[int, list[TargetMeasurement]]] = {}
    skipped: list[str] = []
    is_marker_file = tuple(header.names) == MARKER_COLUMNS
    if not is_marker_file:
        header.expect([["station"], ["target"], *_SIGHT], ["constant_mm"])
    for row in rows:
        station = row.positive_integer("theodolite_number" if is_marker_file else "station")
        target = row.positive_integer("marker_number" if is_marker_file else "target")
        if is_marker_file and row.cells["status"] != "0":
            skipped.append(
                f"{path}, line {row.line}: target {target} of station {station} left out: "
                f"the instrument reported status {row.cells['status']}"
            )
            continue
        sight = _sight(row, "azimuth", "elevation", "distance") if is_marker_file else _sight(row)
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
    header, rows = read_table(path)
    header.expect([["point"], ["kind"], *_SIGHT, *([name] for name in _CAD)], ["constant_mm"])
    prisms: dict[int, list[TargetMeasurement]] = {}
    body: dict[str, list[TargetMeasurement]] = {}
    cad_m: dict[str, Vector3] = {}
    for row in rows:
        kind = row.cells["kind"]
        if kind == "prism":
            if any(row.cells[column] for column in _CAD):
                raise row.error(
                    "a prism has no place from CAD, it is what is looked for; leave x_m, y_m, z_m empty"
                )
            prisms.setdefault(row.positive_integer("point"), []).append(_sight(row))
        elif kind == "body":
            name = row.cells["point"]
            if not name:
                raise row.error("a body point needs a name in the column point")
            place = (_place(row, "x_m"), _place(row, "y_m"), _place(row, "z_m"))
            if cad_m.setdefault(name, place) != place:
                raise row.error(f"body point {name} has another x_m, y_m, z_m further up; keep one of them")
            body.setdefault(name, []).append(_sight(row))
        else:
            raise row.error(f"kind is {quoted(kind)}; it is prism or body")
    if not prisms:
        raise InputFileError("holds no prism; add lines of kind prism", path=path)
    if not body:
        raise InputFileError("holds no body point; add at least three lines of kind body", path=path)
    return PrismFile(path, dict(sorted(prisms.items())), body, cad_m)


def _place(row: Row, column: str) -> float:
    return row.within(column, -MAX_COORDINATE_M, MAX_COORDINATE_M)


def _sight(
    row: Row, horizontal: str | None = None, zenith: str | None = None, distance: str = "slope_distance_m"
) -> TargetMeasurement:
    """Read the measurement of a line; without column names those of our own format."""
    horizontal_rad, zenith_rad = row.angles_rad(horizontal, zenith)
    return TargetMeasurement(
        horizontal_angle_rad=horizontal_rad,
        zenith_angle_rad=zenith_rad,
        slope_distance_m=row.distance_m(distance),
        constant_m=row.within("constant_mm", -1e4, 1e4) / 1e3 if row.cells.get("constant_mm") else None,
        line=row.line,
    )
