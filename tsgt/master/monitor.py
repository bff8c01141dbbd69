"""What came from each station, counted: the content of the ``status`` lines. Pure."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from tsgt.master.stream_records import StationStatus, StatusRecord
from tsgt.master.tracks import usable

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.model import Measurement


class Monitor:
    """Counts measurements and poses for the next status line.

    Parameters
    ----------
    stations
        Numbers of the stations to report on, in the order of the report.
    """

    def __init__(self, stations: Iterable[int]) -> None:
        self._stations = {
            station: StationStatus(id=station, measurements=0, usable=0, age_s=None, status=None)
            for station in stations
        }
        self._last_stamp_ns: dict[int, int] = {}
        self._poses = 0
        self._valid_poses = 0

    def measurement(self, measurement: Measurement) -> None:
        """Count a measurement; one of a station that is not reported on is passed over."""
        before = self._stations.get(measurement.station)
        if before is None:
            return
        self._last_stamp_ns[measurement.station] = measurement.stamp_ns
        self._stations[measurement.station] = dataclasses.replace(
            before,
            measurements=before.measurements + 1,
            usable=before.usable + usable(measurement),
            status=measurement.status,
        )

    def pose(self, *, valid: bool) -> None:
        """Count a pose."""
        self._poses += 1
        self._valid_poses += valid

    def status(self, now_ns: int) -> StatusRecord:
        """Report what was counted so far.

        Parameters
        ----------
        now_ns
            The present on the master's Unix clock.
        """
        stations = []
        for number, station in self._stations.items():
            stamp_ns = self._last_stamp_ns.get(number)
            age_s = None if stamp_ns is None else (now_ns - stamp_ns) / 1e9
            stations.append(dataclasses.replace(station, age_s=age_s))
        return StatusRecord(
            stamp_ns=now_ns, poses=self._poses, valid_poses=self._valid_poses, stations=tuple(stations)
        )
