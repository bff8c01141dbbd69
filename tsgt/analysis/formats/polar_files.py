"""Tracks of raw polar measurements as ``tsgt export --format csv --records measurements`` writes; docs/reference/csv.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.formats.csv_table import HORIZONTAL, TIME, ZENITH, read_table
from tsgt.errors import InputFileError, quoted
from tsgt.model import PointMeasurement, PolarMeasurement, Status

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.formats.csv_table import Row
    from tsgt.model import Measurement

_POINT = ("x_m", "y_m", "z_m")
_OPTIONAL = (
    *("type", "station", "prism", "sequence", "received_ns", "status"),
    *("stamp_sigma_ns", "stamp_bound_ns", "raw_status", "host_time_ns", "instrument_time_ns"),
    *_POINT,
)


def read_polar_tracks(paths: Sequence[Path]) -> list[Measurement]:
    """Read the measurements of one drive in the order of arrival; without ``received_ns`` that is the time of measurement.

    One file has all stations, or one per station: without a column ``station`` all lines belong to the station whose number
    is the position of the file, from 1. Raises InputFileError if a file cannot be read, is empty, has a wrong column or
    number, or contains a measurement twice.
    """
    measurements: list[Measurement] = []
    counts: dict[int, int] = {}
    seen: dict[tuple[int, int, int], str] = {}
    for position, path in enumerate(paths, start=1):
        header, rows = read_table(path)
        header.expect([TIME, HORIZONTAL, ZENITH, ["slope_distance_m"]], _OPTIONAL)
        for row in rows:
            station = row.positive_integer("station") if "station" in row.cells else position
            found = _measurement(row, station, counts.get(station, 0))
            where = f"{path}, line {row.line}"
            if found.status.usable:
                known = seen.setdefault((station, found.prism, found.stamp_ns), where)
                if known != where:
                    raise row.error(
                        f"duplicate of {known}: station {station}, prism {found.prism}, same time; remove one of the lines"
                    )
            counts[station] = counts.get(station, 0) + 1
            measurements.append(found)
    return sorted(measurements, key=lambda m: m.received_ns)


def _measurement(row: Row, station: int, count: int) -> Measurement:
    """Parse one line; ``count`` is the number of previous lines of this station."""
    stamp_ns = row.stamp_ns()
    prism = row.positive_integer("prism") if "prism" in row.cells else station
    sequence = _optional_integer(row, "sequence")
    received_ns = _optional_integer(row, "received_ns")
    sequence = count if sequence is None else sequence
    received_ns = stamp_ns if received_ns is None else received_ns
    status = _status(row)
    match row.cells.get("type", "measurement"):
        case "measurement":
            horizontal_rad, zenith_rad = row.angles_rad()
            return PolarMeasurement(
                station=station,
                prism=prism,
                sequence=sequence,
                stamp_ns=stamp_ns,
                stamp_sigma_ns=_optional_integer(row, "stamp_sigma_ns") or 0,
                stamp_bound_ns=_optional_integer(row, "stamp_bound_ns"),
                received_ns=received_ns,
                horizontal_angle_rad=horizontal_rad,
                zenith_angle_rad=zenith_rad,
                slope_distance_m=_distance_m(row),
                status=status,
                raw_status=row.signed_integer("raw_status") if row.cells.get("raw_status") else 0,
                host_time_ns=_optional_integer(row, "host_time_ns"),
                instrument_time_ns=_optional_integer(row, "instrument_time_ns"),
            )
        case "point" if all(name in row.cells for name in _POINT):
            return PointMeasurement(
                station=station,
                prism=prism,
                sequence=sequence,
                stamp_ns=stamp_ns,
                received_ns=received_ns,
                position_m=(row.number("x_m"), row.number("y_m"), row.number("z_m")),
                status=status,
            )
        case "point":
            raise row.error("a point needs the columns x_m, y_m and z_m")
        case other:
            raise row.error(f"type is {quoted(other)}; expected measurement or point")


def _distance_m(row: Row) -> float | None:
    """Parse the slope distance; an empty cell means that none was measured."""
    if not row.cells["slope_distance_m"]:
        return None
    distance_m = row.number("slope_distance_m")
    if distance_m < 0.0:
        raise row.error(
            f"slope_distance_m is {row.cells['slope_distance_m']}; expected a distance in m, or an empty cell"
        )
    return distance_m


def _optional_integer(row: Row, column: str) -> int | None:
    return row.non_negative_integer(column) if row.cells.get(column) else None


def _status(row: Row) -> Status:
    text = row.cells.get("status") or Status.OK.value
    try:
        return Status(text)
    except ValueError:
        raise row.error(
            f"status is {quoted(text)}; expected one of {', '.join(Status)}, or an empty cell"
        ) from None


def tracked_prisms(measurements: Sequence[Measurement]) -> dict[int, int]:
    """Return the prism that each station measured most often, by station number, sorted."""
    counts: dict[int, dict[int, int]] = {}
    for m in measurements:
        by_prism = counts.setdefault(m.station, {})
        by_prism[m.prism] = by_prism.get(m.prism, 0) + 1
    return {
        station: max(by_prism, key=lambda prism: by_prism[prism])
        for station, by_prism in sorted(counts.items())
    }


def check_tracks(measurements: Sequence[Measurement], paths: Sequence[Path]) -> None:
    """Raise InputFileError, which names the stations, if no measurement is usable or the stations do not overlap in time."""
    spans: dict[int, tuple[int, int]] = {}
    for m in measurements:
        if m.status.usable:
            start, end = spans.get(m.station, (m.stamp_ns, m.stamp_ns))
            spans[m.station] = min(start, m.stamp_ns), max(end, m.stamp_ns)
    if not spans:
        raise InputFileError("no measurement has a usable status", path=paths[0])
    latest = max(spans, key=lambda station: spans[station][0])
    first_to_end = min(spans, key=lambda station: spans[station][1])
    late_ns = spans[latest][0] - spans[first_to_end][1]
    if late_ns > 0:
        raise InputFileError(
            f"the measurements of station {latest} begin {late_ns / 1e9:.1f} s after the last one of station "
            f"{first_to_end}; use the tracks of one drive, on one clock",
            path=paths[0],
        )
