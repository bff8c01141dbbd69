"""Progress of a target collection: the state behind ``tsgt calibrate collect``. Sans-I/O but ``resume``.

The target file is the whole state: rewritten after every measurement, read again on resumption.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from tsgt.analysis.calibration.targets import solve_stations
from tsgt.analysis.formats import TargetFile, TargetMeasurement, read_partial_target_file
from tsgt.errors import DegenerateGeometryError, InputFileError
from tsgt.geometry.target_calibration import MIN_POINTS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from tsgt.analysis.calibration.targets import TargetCalibration

_HEADER_WITHOUT_PPM = "station,target,horizontal_angle_rad,zenith_angle_rad,slope_distance_m,constant_mm"
"""Of files of earlier versions."""

HEADER = f"{_HEADER_WITHOUT_PPM},atmospheric_ppm"

StationTarget = tuple[int, int]  # Numbers of a station and a target


class TargetCollection:
    """Which station has measured which target, in the order of ``stations`` and ``targets``; ``repeats``: 2 for both faces."""

    def __init__(
        self, path: Path, stations: Sequence[int], targets: Sequence[int], *, repeats: int = 1
    ) -> None:
        self.path = path
        self.stations = tuple(stations)
        self.targets = tuple(targets)
        self._repeats = repeats
        self._measurements: list[tuple[StationTarget, TargetMeasurement]] = []  # in the order of measurement
        self._comments: list[str] = []

    def resume(self) -> None:
        """Read the file, with its comments at the top, if it exists and was written by ``tsgt calibrate collect``.

        Raises InputFileError if it is of another kind, has an invalid line, or cannot be read.
        """
        try:
            lines = self.path.read_text(encoding="utf-8-sig").splitlines()
        except FileNotFoundError:
            return
        except UnicodeDecodeError as error:
            raise InputFileError("is not a text file", path=self.path) from error
        except OSError as error:
            raise InputFileError(error.strerror or str(error), path=self.path) from error
        comments = [line for line in lines if line.lstrip().startswith("#")]
        rest = [line.strip() for line in lines if line.strip() and line not in comments]
        if not rest or rest[0] not in (HEADER, _HEADER_WITHOUT_PPM):
            raise InputFileError(
                "was not written by tsgt calibrate collect; give another --output, or move it away",
                path=self.path,
            )
        self._comments = comments
        if len(rest) > 1:
            file = read_partial_target_file(self.path)
            found = [
                ((station, target), measurement)
                for station, targets in file.measurements.items()
                for target, measurements in targets.items()
                for measurement in measurements
            ]
            self._measurements = sorted(found, key=lambda each: each[1].line)

    def add(self, station: int, target: int, measurement: TargetMeasurement) -> None:
        """Add a measurement of a target; its ``line`` is ignored."""
        self._measurements.append(((station, target), measurement))

    def remove(self, station: int, target: int) -> bool:
        """Remove the measurements of a target by a station; return whether there were any."""
        before = len(self._measurements)
        self._measurements = [each for each in self._measurements if each[0] != (station, target)]
        return len(self._measurements) < before

    def count(self, station: int, target: int) -> int:
        """Return how often a station has measured a target."""
        return sum(pair == (station, target) for pair, _ in self._measurements)

    def next(self, skipped: Collection[StationTarget] = ()) -> StationTarget | None:
        """Return the next station and target to measure; None when all are complete or skipped."""
        return next((pair for pair in self.outstanding() if pair not in skipped), None)

    def outstanding(self) -> Iterator[StationTarget]:
        """Yield the incomplete stations and targets, station by station."""
        for station in self.stations:
            for target in self.targets:
                if self.count(station, target) < self._repeats:
                    yield station, target

    def text(self) -> str:
        """Return the content of the file, in the order of measurement; also stations and targets beyond the requested ones."""
        return "\n".join(
            [
                *self._comments,
                HEADER,
                *(_line(*pair, measurement) for pair, measurement in self._measurements),
                "",
            ]
        )

    def solution(self, station: int) -> TargetCalibration | str:
        """Solve the frames from the present measurements, that of ``station`` among them; a sentence if not yet possible."""
        file = self._file()
        if station == 1 or not {1, station} <= file.measurements.keys():
            return "no targets in common with station 1 yet"
        of_first = set(file.measurements[1])
        solvable = {
            number: targets
            for number, targets in file.measurements.items()
            if number in (1, station) or len(of_first & set(targets)) >= MIN_POINTS
        }
        try:
            return solve_stations(dataclasses.replace(file, measurements=solvable), target_constant_m=0.0)
        except (DegenerateGeometryError, InputFileError) as error:
            return str(error)

    def _file(self) -> TargetFile:
        """Return what reading the file would return."""
        measurements: dict[int, dict[int, list[TargetMeasurement]]] = {}
        first_line = len(self._comments) + 2
        for line, ((station, target), measurement) in enumerate(self._measurements, start=first_line):
            numbered = dataclasses.replace(measurement, line=line)
            measurements.setdefault(station, {}).setdefault(target, []).append(numbered)
        return TargetFile(self.path, measurements, ())


def _line(station: int, target: int, measurement: TargetMeasurement) -> str:
    # repr is the shortest form that reads back to the same bits.
    numbers = (measurement.horizontal_angle_rad, measurement.zenith_angle_rad, measurement.slope_distance_m)
    constant = "" if measurement.constant_m is None else f"{1e3 * measurement.constant_m:.6g}"
    ppm = f"{measurement.atmospheric_ppm:.6g}"
    return ",".join([str(station), str(target), *map(repr, numbers), constant, ppm])
