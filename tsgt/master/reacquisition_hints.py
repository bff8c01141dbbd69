"""Where stations that have lost their prism are to look for it: where the others see the robot. Pure.

A prism is as far from the middle of others as the layout says, however the robot stands. So the points that other
stations have measured within the last second give a direction, and the layout how far around it the prism can be; how
fast the robot drives adds to that. Nothing is assumed of how it is turned.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import believable, build_tracks, measured_at_ns
from tsgt.geometry import cartesian_to_polar, invert, transform_points
from tsgt.model import PolarMeasurement, Status
from tsgt.radio import Direction

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from tsgt.estimation import Track
    from tsgt.model import Parameters

LOST_FOR_NS = 2_000_000_000
"""An instrument that finds its prism by itself, in prediction or by looking nearby, has done so by then."""

AGAIN_NS = 5_000_000_000
"""A direction is good for so long, and the next one is given then."""

TRIES = 6
SELDOM_NS = 30_000_000_000
"""After so many directions without success the prism is hidden, or the station's frame is wrong. Between two directions the
instrument then has time to look all around."""

FRESH_NS = 1_000_000_000
"""A point that is older says nothing of where the robot is."""

BASE_NS = 200_000_000
"""Velocity is taken over so long at least; noise would be velocity otherwise."""

KEPT_NS = 2_000_000_000
MOST_POINTS = 64
"""Points are kept for so long: a fresh one, and another one to take the velocity from. At 20 Hz that is 40."""

AHEAD_S = 1.0
"""What passes before the telescope points where it is told: a frame, and turning. The direction is that of then, and the
robot may have stopped or turned off before, or go on for as long again."""

STARTS_M = 0.5
"""A robot that stands may start: 1 m/s^2 within this second."""

WIDEST_RAD = math.radians(45.0)
"""A robot that is so near may be anywhere."""

_LOST = (Status.NO_TARGET, Status.ANGLE_ONLY)


@dataclass(slots=True)
class _Station:
    """What is known of one station; instants on the master's Unix clock in ns."""

    prism: int
    newest_ns: int = 0
    lost_ns: int | None = None
    """Since when its instrument has said nothing else than that it has no prism; None while it has."""
    second_face: bool = False
    points: deque[PolarMeasurement] = field(default_factory=lambda: deque(maxlen=MOST_POINTS))
    told: Direction | None = None
    told_ns: int | None = None
    tries: int = 0


class Searches:
    """Decides when a station is told where to look for its prism, and which direction that is.

    Parameters
    ----------
    parameters
        Frames of the stations, and the layout of the prisms.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._frames = {station.station: station for station in parameters.stations}
        self._layout = {prism.prism: np.array(prism.position_m) for prism in parameters.prisms}
        self._stations = {station.station: _Station(station.prism) for station in parameters.stations}

    def measured(self, measurement: PolarMeasurement) -> None:
        """Take a measurement; those of a station come in any order."""
        station = self._stations.get(measurement.station)
        if station is None or not believable(measurement, self._frames[measurement.station]):
            return
        at_ns = measured_at_ns(measurement, self._frames[measurement.station])
        usable = measurement.status.usable
        if usable and at_ns > station.newest_ns - KEPT_NS:
            station.points.append(measurement)
        if at_ns > station.newest_ns:
            station.newest_ns = at_ns
            if measurement.status not in _LOST:
                station.lost_ns = None
            elif station.lost_ns is None:
                station.lost_ns = at_ns
            if usable:
                station.second_face = measurement.zenith_angle_rad > math.pi
                station.told, station.told_ns, station.tries = None, None, 0
        elif usable and station.lost_ns is not None:  # it was lost and found in between, which has come late
            station.lost_ns = max(station.lost_ns, at_ns)

    def towards(self, number: int, now_ns: int) -> Direction | None:
        """Return where a station is to look for its prism at present; None: wherever it likes.

        The same direction is returned for 5 s; another one is a new order.

        Parameters
        ----------
        number
            Of the station.
        now_ns
            The present on the master's Unix clock.
        """
        station = self._stations[number]
        if station.lost_ns is None or now_ns - station.lost_ns <= LOST_FOR_NS:
            return None
        if station.told_ns is not None:
            since_ns = now_ns - station.told_ns
            if since_ns < AGAIN_NS:
                return station.told
            if since_ns < SELDOM_NS and station.tries >= TRIES:
                return None
        station.told = self._direction(number, station, now_ns)
        if station.told is not None:
            station.told_ns = now_ns
            station.tries += 1
        return station.told

    def _direction(self, number: int, station: _Station, now_ns: int) -> Direction | None:
        tracks = build_tracks(self._parameters, self._recent(now_ns))
        moving = {prism: found for prism, track in tracks.items() if (found := _moving(track, now_ns))}
        if station.prism in moving:  # another station tracks it as well
            moving = {station.prism: moving[station.prism]}
        if not moving:
            return None
        middle_m, velocity_mps = np.mean(list(moving.values()), axis=0)
        in_layout_m = np.mean([self._layout[prism] for prism in moving], axis=0)
        within_m = float(np.linalg.norm(self._layout[station.prism] - in_layout_m)) + STARTS_M
        within_m += AHEAD_S * float(np.linalg.norm(velocity_mps))
        T_station_station1 = invert(np.array(self._frames[number].T_station1_station))
        seen_m = transform_points(T_station_station1, middle_m + AHEAD_S * velocity_mps)
        horizontal_rad, zenith_rad, distance_m = map(float, cartesian_to_polar(seen_m))
        if within_m > distance_m * math.sin(WIDEST_RAD):
            return None
        if station.second_face:
            horizontal_rad, zenith_rad = (horizontal_rad + math.pi) % math.tau, math.tau - zenith_rad
        return Direction(horizontal_rad, zenith_rad, math.asin(within_m / distance_m))

    def _recent(self, now_ns: int) -> Iterable[PolarMeasurement]:
        for station in self._stations.values():
            yield from (point for point in station.points if point.stamp_ns > now_ns - KEPT_NS)


def _moving(track: Track, now_ns: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return where a prism is now, in m, and its velocity in m/s; None where that is not known."""
    if not len(track) or track.times_ns[-1] < now_ns - FRESH_NS:
        return None
    before = int(np.searchsorted(track.times_ns, track.times_ns[-1] - BASE_NS, side="right")) - 1
    if before < 0:
        return None
    elapsed_s = float(track.times_ns[-1] - track.times_ns[before]) / 1e9
    velocity_mps = (track.points_m[-1] - track.points_m[before]) / elapsed_s
    age_s = float(now_ns - track.times_ns[-1]) / 1e9
    return track.points_m[-1] + age_s * velocity_mps, velocity_mps
