"""What has been collected of the targets, station by station: the state behind ``tsgt calibrate collect``.

The file of targets is the whole state. It is written anew after every measurement, so that an interruption costs
nothing, and whoever goes on begins by reading it.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from tsgt.analysis.calibration.targets import solve_stations
from tsgt.analysis.formats import TargetFile, TargetMeasurement, read_partial_target_file
from tsgt.errors import DegenerateGeometryError, InputFileError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from tsgt.geometry.calibration import FrameCalibration

HEADER = "station,target,horizontal_angle_rad,zenith_angle_rad,slope_distance_m,constant_mm"

StationTarget = tuple[int, int]
"""A station and a target."""


class TargetCollection:
    """Which station has measured which target.

    Parameters
    ----------
    path
        The file of targets, for messages.
    stations, targets
        Numbers, in the order in which they are to be measured.
    repeats
        How often each target is to be measured: 2 for both faces.
    """

    def __init__(
        self, path: Path, stations: Sequence[int], targets: Sequence[int], *, repeats: int = 1
    ) -> None:
        self.path = path
        self.stations = tuple(stations)
        self.targets = tuple(targets)
        self._repeats = repeats
        self._sights: dict[StationTarget, list[TargetMeasurement]] = {}
        self._comments: list[str] = []

    def resume(self) -> None:
        """Take over what the file holds, if it is there and was written here before; its comments stay, on top.

        Raises
        ------
        InputFileError
            It is a file of another kind, has a bad line, or cannot be read.
        """
        try:
            lines = self.path.read_text(encoding="utf-8").splitlines()
        except FileNotFoundError:
            return
        except UnicodeDecodeError as error:
            raise InputFileError("is not a text file", path=self.path) from error
        except OSError as error:
            raise InputFileError(error.strerror or str(error), path=self.path) from error
        comments = [line for line in lines if line.lstrip().startswith("#")]
        rest = [line.strip() for line in lines if line.strip() and line not in comments]
        if rest[:1] != [HEADER]:
            raise InputFileError(
                "was not written by tsgt calibrate collect; give another --output, or move it away",
                path=self.path,
            )
        self._comments = comments
        if len(rest) > 1:
            file = read_partial_target_file(self.path)
            self._sights = {
                (station, target): list(sights)
                for station, targets in file.sights.items()
                for target, sights in targets.items()
            }

    def add(self, station: int, target: int, sight: TargetMeasurement) -> None:
        """Take a measurement, one of perhaps several of this target; the line of the sight does not matter."""
        self._sights.setdefault((station, target), []).append(sight)

    def drop(self, station: int, target: int) -> bool:
        """Forget a target of a station; return whether there was anything to forget."""
        return self._sights.pop((station, target), None) is not None

    def count(self, station: int, target: int) -> int:
        """Return how often a station has measured a target."""
        return len(self._sights.get((station, target), ()))

    def next(self, skipped: Collection[StationTarget] = ()) -> StationTarget | None:
        """Return which target of which station is to be measured next; None when all is done or skipped."""
        return next((cell for cell in self.missing() if cell not in skipped), None)

    def missing(self) -> Iterator[StationTarget]:
        """Yield what has not been measured often enough, station by station."""
        for station in self.stations:
            for target in self.targets:
                if self.count(station, target) < self._repeats:
                    yield station, target

    def text(self) -> str:
        """Return what the file is to hold; stations and targets beyond those asked for are kept."""
        return "\n".join(
            [*self._comments, HEADER, *(_line(*cell, sight) for cell, sight in self._rows()), ""]
        )

    def residuals(self, station: int) -> FrameCalibration | str:
        """Solve the frame of a station from what there is; a sentence instead where that cannot be done yet."""
        file = self._file()
        if station == 1 or not {1, station} <= file.sights.keys():
            return "no targets in common with station 1 yet"
        pair = dataclasses.replace(file, sights={number: file.sights[number] for number in (1, station)})
        try:
            return solve_stations(pair, target_constant_m=0.0)[station]
        except (DegenerateGeometryError, InputFileError) as error:
            return str(error)

    def _rows(self) -> Iterator[tuple[StationTarget, TargetMeasurement]]:
        for cell, sights in sorted(self._sights.items()):
            for sight in sights:
                yield cell, sight

    def _file(self) -> TargetFile:
        """Return what reading the file would give."""
        sights: dict[int, dict[int, list[TargetMeasurement]]] = {}
        first_line = len(self._comments) + 2
        for line, ((station, target), sight) in enumerate(self._rows(), start=first_line):
            numbered = dataclasses.replace(sight, line=line)
            sights.setdefault(station, {}).setdefault(target, []).append(numbered)
        return TargetFile(self.path, sights, ())


def _line(station: int, target: int, sight: TargetMeasurement) -> str:
    # In the shortest form that reads back to the same bits.
    numbers = (sight.horizontal_angle_rad, sight.zenith_angle_rad, sight.slope_distance_m)
    constant = "" if sight.constant_m is None else f"{1e3 * sight.constant_m:.6g}"
    return ",".join([str(station), str(target), *map(repr, numbers), constant])
