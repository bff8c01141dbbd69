"""Search directions for stations that have lost their prism, from where the others see the robot. Sans-I/O.

The distance of a prism from the centroid of others follows from the layout, however the robot is oriented. So points
that other stations measured within the last second give a direction, and the layout the spread of the prism about it; the
robot's speed adds to the spread. Nothing is assumed about the robot's orientation.

A station that follows a prism of another robot, or a mirror image, measures on: its points are farther from those of the
others than the layout allows. It gets a direction, too, if the others are consistent with each other, and it was consistent with them before.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import build_tracks, has_plausible_time, measured_at_ns
from tsgt.geometry import cartesian_to_polar, invert, transform_points
from tsgt.model import PolarMeasurement, Status
from tsgt.radio import Direction

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from tsgt.estimation import Track
    from tsgt.model import Parameters

HINT_DELAY_NS = 2_000_000_000
"""By then an instrument has found a prism that it finds by itself, by prediction or a local search."""

HINT_INTERVAL_NS = 5_000_000_000  # a direction is valid for this long; then the next one is given

MAX_FREQUENT_HINTS = 6
SLOW_HINT_INTERVAL_NS = 30_000_000_000
"""After this many directions without success the prism is hidden, or the station's frame is wrong. The longer interval
leaves the instrument time for a full search."""

MAX_POINT_AGE_NS = 1_000_000_000  # an older point does not show where the robot is

MIN_VELOCITY_BASELINE_NS = 200_000_000
"""Velocity is the difference of two points at least this far apart; noise would dominate over less."""

POINT_HISTORY_NS = 2_000_000_000
POINT_HISTORY_CAPACITY = 64
"""History for a recent point and one to take the velocity from; 40 points at 20 Hz."""

PREDICTION_S = 1.0
"""From the decision to the telescope's arrival: a frame, and turning. The direction is predicted by this, and the spread
allows the robot to have stopped or turned, or to continue for as long again."""

START_ALLOWANCE_M = 0.5  # a stationary robot may start: 1 m/s^2 within a second

MAX_SPREAD_RAD = math.radians(45.0)  # a direction with a larger spread is useless: the robot is too near

MAX_DISTANCE_ERROR_M = 0.5
"""By more than this the distance of two points from each other differs from the layout's only if one is of another target: the
points are predicted by up to a second, and the robot may turn."""

MIN_CONSISTENT_POINTS = 2
"""Two points alone that do not fit do not tell whose is wrong."""

COMPARISON_INTERVAL_NS = 400_000_000  # about a frame

MAX_TARGET_HINTS = 2
"""Directions for a station that measures another target. More are useless if that is in the same direction, and harmful if
the station's tripod was moved: each may cost it the lock."""

_LOST = (Status.NO_TARGET, Status.ANGLE_ONLY)


@dataclass(slots=True)
class _Station:
    """State of one station; instants on the master's Unix clock in ns."""

    prism: int
    newest_ns: int = 0
    lost_ns: int | None = None  # when its instrument lost the prism; None while it has it
    wrong_target_since_ns: int | None = None  # since when its points are not of its prism; None: they may be
    was_consistent: bool = False  # whether its points have been consistent with those of others
    second_face: bool = False
    points: deque[PolarMeasurement] = field(default_factory=lambda: deque(maxlen=POINT_HISTORY_CAPACITY))
    hint: Direction | None = None
    hint_ns: int | None = None
    hints: int = 0


class ReacquisitionHints:
    """Decides when a station gets a search direction, and which one."""

    def __init__(self, parameters: Parameters) -> None:
        self._stations = {station.station: _Station(station.prism) for station in parameters.stations}
        self._compared_ns = 0
        self.set_up(parameters)

    def set_up(self, parameters: Parameters) -> None:
        """Use other frames and another layout, for the same stations."""
        self._parameters = parameters
        self._frames = {station.station: station for station in parameters.stations}
        self._layout = {prism.prism: np.array(prism.position_m) for prism in parameters.prisms}
        for station in self._stations.values():
            station.was_consistent = False

    def measured(self, measurement: PolarMeasurement) -> None:
        """Take a measurement; those of a station arrive in any order."""
        station = self._stations.get(measurement.station)
        if station is None or not has_plausible_time(measurement, self._frames[measurement.station]):
            return
        at_ns = measured_at_ns(measurement, self._frames[measurement.station])
        usable = measurement.status.usable
        if usable and at_ns > station.newest_ns - POINT_HISTORY_NS:
            station.points.append(measurement)
        if at_ns > station.newest_ns:
            station.newest_ns = at_ns
            if measurement.status not in _LOST:
                station.lost_ns = None
            elif station.lost_ns is None:
                station.lost_ns = at_ns
            if usable:
                station.second_face = measurement.zenith_angle_rad > math.pi
                self._compare_targets(at_ns)
                if station.wrong_target_since_ns is None:
                    station.hint, station.hint_ns, station.hints = None, None, 0
        elif usable and station.lost_ns is not None:  # a late one: the prism was found and lost again
            station.lost_ns = max(station.lost_ns, at_ns)

    def direction(self, number: int, now_ns: int) -> Direction | None:
        """Return where to search, the same object for 5 s (another is a new command); None: no hint. Master's Unix clock."""
        station = self._stations[number]
        since_ns = min(
            (ns for ns in (station.lost_ns, station.wrong_target_since_ns) if ns is not None), default=now_ns
        )
        if now_ns - since_ns <= HINT_DELAY_NS:
            return None
        if self._parameters.no_poses is not None:
            return None
        if station.hint_ns is not None:
            since_ns = now_ns - station.hint_ns
            if since_ns < HINT_INTERVAL_NS:
                return station.hint
            if station.lost_ns is None and station.hints >= MAX_TARGET_HINTS:
                station.wrong_target_since_ns, station.was_consistent = None, False
                return None
            if since_ns < SLOW_HINT_INTERVAL_NS and station.hints >= MAX_FREQUENT_HINTS:
                return None
        station.hint = self._compute(number, station, now_ns)
        if station.hint is not None:
            station.hint_ns = now_ns
            station.hints += 1
        return station.hint

    def _compare_targets(self, now_ns: int) -> None:
        """Take which stations' points fit those of the others, if two or more of these fit each other."""
        if self._parameters.no_poses is not None or 0 <= now_ns - self._compared_ns < COMPARISON_INTERVAL_NS:
            return
        self._compared_ns = now_ns
        recent = [point for station in self._stations.values() for point in self._recent_of(station, now_ns)]
        tracks = build_tracks(self._parameters, recent)
        prisms = Counter(station.prism for station in self._stations.values())
        points = {
            number: found[0]
            for number, station in self._stations.items()
            if prisms[station.prism] == 1 and (found := _position_and_velocity(tracks[station.prism], now_ns))
        }
        fitting = {pair for pair in combinations(points, 2) if self._fit(points, *pair)}
        for number, station in self._stations.items():
            others = [other for other in points if other != number]
            agree = len(others) >= MIN_CONSISTENT_POINTS and fitting.issuperset(combinations(others, 2))
            if number not in points or not agree:
                station.wrong_target_since_ns = None
            elif any(number in pair for pair in fitting):
                station.was_consistent, station.wrong_target_since_ns = True, None
            elif station.was_consistent and station.wrong_target_since_ns is None:
                station.wrong_target_since_ns = now_ns

    def _fit(self, points: Mapping[int, NDArray[np.float64]], one: int, other: int) -> bool:
        """Whether the points of two stations are as far apart as their prisms."""
        layout_m = self._layout[self._stations[one].prism] - self._layout[self._stations[other].prism]
        apart_m = np.linalg.norm(points[one] - points[other]) - np.linalg.norm(layout_m)
        return bool(abs(apart_m) <= MAX_DISTANCE_ERROR_M)

    def _compute(self, number: int, station: _Station, now_ns: int) -> Direction | None:
        seeing = (other for other in self._stations.values() if other.wrong_target_since_ns is None)
        recent = [point for other in seeing for point in self._recent_of(other, now_ns)]
        tracks = build_tracks(self._parameters, recent)
        known = {
            prism: found
            for prism, track in tracks.items()
            if (found := _position_and_velocity(track, now_ns))
        }
        if station.prism in known:  # another station tracks it as well
            known = {station.prism: known[station.prism]}
        if not known:
            return None
        centroid_m, velocity_mps = np.mean(list(known.values()), axis=0)
        layout_centroid_m = np.mean([self._layout[prism] for prism in known], axis=0)
        spread_m = float(np.linalg.norm(self._layout[station.prism] - layout_centroid_m)) + START_ALLOWANCE_M
        spread_m += PREDICTION_S * float(np.linalg.norm(velocity_mps))
        T_station_station1 = invert(np.array(self._frames[number].T_station1_station))
        point_m = transform_points(T_station_station1, centroid_m + PREDICTION_S * velocity_mps)
        horizontal_rad, zenith_rad, distance_m = map(float, cartesian_to_polar(point_m))
        if spread_m > distance_m * math.sin(MAX_SPREAD_RAD):
            return None
        if station.second_face:
            horizontal_rad, zenith_rad = (horizontal_rad + math.pi) % math.tau, math.tau - zenith_rad
        return Direction(horizontal_rad, zenith_rad, math.asin(spread_m / distance_m))

    def _recent_of(self, station: _Station, now_ns: int) -> list[PolarMeasurement]:
        return [point for point in station.points if point.stamp_ns > now_ns - POINT_HISTORY_NS]


def _position_and_velocity(
    track: Track, now_ns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return a prism's present position in m and velocity in m/s; None where they are not known."""
    if not len(track) or track.times_ns[-1] < now_ns - MAX_POINT_AGE_NS:
        return None
    before = (
        int(np.searchsorted(track.times_ns, track.times_ns[-1] - MIN_VELOCITY_BASELINE_NS, side="right")) - 1
    )
    if before < 0:
        return None
    elapsed_s = float(track.times_ns[-1] - track.times_ns[before]) / 1e9
    velocity_mps = (track.points_m[-1] - track.points_m[before]) / elapsed_s
    age_s = float(now_ns - track.times_ns[-1]) / 1e9
    return track.points_m[-1] + age_s * velocity_mps, velocity_mps
