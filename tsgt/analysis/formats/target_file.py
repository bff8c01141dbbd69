"""Target files (several stations) and prism files (prisms and body points): see docs/reference/target-file.md."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.analysis.formats.csv_table import HORIZONTAL, ZENITH, read_table
from tsgt.errors import InputFileError, quoted
from tsgt.geometry import corrected_distance
from tsgt.model import MAX_COORDINATE_M

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.formats.csv_table import Row
    from tsgt.model import Vector3

MARKER_COLUMNS = (
    "theodolite_number", "marker_number", "status", "elevation", "azimuth", "distance", "sec", "nsec",
)  # fmt: skip
"""Header of the authors' marker file. Their ``elevation`` is a zenith angle; angles are in rad."""

_MEASUREMENT_COLUMNS = [HORIZONTAL, ZENITH, ["slope_distance_m"]]
_CAD = ("x_m", "y_m", "z_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetMeasurement:
    """A raw single-shot measurement of a target, in either face.

    The horizontal angle is clockwise, the zenith angle above pi in face 2, the distance without corrections; ``constant_m`` is
    added to it (None: use the constant of the command line), and ``atmospheric_ppm`` scales it. ``line`` is the line number in the
    file, from 1.
    """

    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float
    constant_m: float | None = None
    atmospheric_ppm: float = 0.0
    line: int

    @property
    def face(self) -> int:
        """Face of the instrument, 1 or 2."""
        return 2 if self.zenith_angle_rad % math.tau > math.pi else 1

    def distance_m(self, constant_m: float) -> float:
        """Return the corrected slope distance; ``constant_m`` where it has no constant of its own."""
        own_m = constant_m if self.constant_m is None else self.constant_m
        return float(corrected_distance(self.slope_distance_m, constant_m=own_m, ppm=self.atmospheric_ppm))


@dataclass(frozen=True, slots=True)
class TargetFile:
    """Measurements of common targets by station and target number, at least one each, and a sentence for each skipped line."""

    path: Path
    measurements: dict[int, dict[int, list[TargetMeasurement]]]
    skipped: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PrismFile:
    """Measurements of prisms (by number) and body points (by name), at least one each; CAD positions in ``robot``."""

    path: Path
    prisms: dict[int, list[TargetMeasurement]]
    body: dict[str, list[TargetMeasurement]]
    cad_m: dict[str, Vector3]


def read_target_file(path: Path) -> TargetFile:
    """Read targets measured by station 1 and at least one other, from our CSV or the authors' marker file, by the header line.

    Marker lines with a status other than 0 are skipped (paper section III-D, first step). Raises InputFileError if the file
    cannot be read, is empty, has a wrong column or number, or a station is missing.
    """
    file = read_partial_target_file(path)
    if 1 not in file.measurements:
        raise InputFileError(
            "holds no usable target of station 1, whose frame is the world; add them", path=path
        )
    if len(file.measurements) == 1:
        raise InputFileError(
            "holds targets of station 1 only; add those of the other stations, but a single station needs no "
            "calibration: its frame is station1",
            path=path,
        )
    return file


def read_partial_target_file(path: Path) -> TargetFile:
    """Read a target file as :func:`read_target_file` does, with any stations."""
    header, rows = read_table(path)
    measurements: dict[int, dict[int, list[TargetMeasurement]]] = {}
    skipped: list[str] = []
    is_marker_file = tuple(header.names) == MARKER_COLUMNS
    if not is_marker_file:
        header.expect([["station"], ["target"], *_MEASUREMENT_COLUMNS], ["constant_mm", "atmospheric_ppm"])
    for row in rows:
        station = row.positive_integer("theodolite_number" if is_marker_file else "station")
        target = row.positive_integer("marker_number" if is_marker_file else "target")
        if is_marker_file and row.cells["status"] != "0":
            skipped.append(
                f"{path}, line {row.line}: target {target} of station {station} skipped: "
                f"the instrument reported status {row.cells['status']}"
            )
            continue
        measurement = (
            _measurement(row, "azimuth", "elevation", "distance") if is_marker_file else _measurement(row)
        )
        measurements.setdefault(station, {}).setdefault(target, []).append(measurement)
    return TargetFile(path, dict(sorted(measurements.items())), tuple(skipped))


def read_prism_file(path: Path) -> PrismFile:
    """Read prisms and body points, at least one each, measured by one station.

    Each line of the CSV is a ``prism`` or a ``body`` point, the latter with its position from CAD. Raises InputFileError if
    the file cannot be read, is empty, has a wrong column or number, or lacks prisms or body points.
    """
    header, rows = read_table(path)
    header.expect([["point"], ["kind"], *_MEASUREMENT_COLUMNS, *([name] for name in _CAD)], ["constant_mm"])
    prisms: dict[int, list[TargetMeasurement]] = {}
    body: dict[str, list[TargetMeasurement]] = {}
    cad_m: dict[str, Vector3] = {}
    for row in rows:
        kind = row.cells["kind"]
        if kind == "prism":
            if any(row.cells[column] for column in _CAD):
                raise row.error(
                    "a prism has no position from CAD, it is to be solved; leave x_m, y_m, z_m empty"
                )
            prisms.setdefault(row.positive_integer("point"), []).append(_measurement(row))
        elif kind == "body":
            name = row.cells["point"]
            if not name:
                raise row.error("a body point needs a name in the column point")
            position_m = (_coordinate(row, "x_m"), _coordinate(row, "y_m"), _coordinate(row, "z_m"))
            if cad_m.setdefault(name, position_m) != position_m:
                raise row.error(
                    f"body point {name} has different x_m, y_m, z_m in a previous line; keep one of them"
                )
            body.setdefault(name, []).append(_measurement(row))
        else:
            raise row.error(f"kind is {quoted(kind)}; expected prism or body")
    if not prisms:
        raise InputFileError("holds no prism; add lines of kind prism", path=path)
    if not body:
        raise InputFileError("holds no body point; add at least three lines of kind body", path=path)
    return PrismFile(path, dict(sorted(prisms.items())), body, cad_m)


def _coordinate(row: Row, column: str) -> float:
    return row.within(column, -MAX_COORDINATE_M, MAX_COORDINATE_M)


def _measurement(
    row: Row, horizontal: str | None = None, zenith: str | None = None, distance: str = "slope_distance_m"
) -> TargetMeasurement:
    """Parse the measurement of a line; the default columns are those of our own format."""
    horizontal_rad, zenith_rad = row.angles_rad(horizontal, zenith)
    return TargetMeasurement(
        horizontal_angle_rad=horizontal_rad,
        zenith_angle_rad=zenith_rad,
        slope_distance_m=row.distance_m(distance),
        constant_m=row.within("constant_mm", -1e4, 1e4) / 1e3 if row.cells.get("constant_mm") else None,
        atmospheric_ppm=row.within("atmospheric_ppm", -1e4, 1e4) if row.cells.get("atmospheric_ppm") else 0.0,
        line=row.line,
    )
