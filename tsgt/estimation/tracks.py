"""From raw measurements to each prism's track in the frame ``station1``.

Latency, prism constant, atmospheric scale and the station's frame are applied here and nowhere else; the raw
measurement stays as it is.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import (
    corrected_distance,
    measurement_covariance,
    polar_to_cartesian,
    transform_points,
)
from tsgt.model import PointMeasurement, PolarMeasurement

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from tsgt.model import Measurement, Parameters, StationParameters


@dataclass(frozen=True, slots=True)
class Track:
    """Positions of one prism in the order of time.

    Attributes
    ----------
    times_ns
        (M,) instants of measurement on the master's Unix clock, strictly increasing.
    points_m
        (M, 3) positions in the frame ``station1``.
    covariances_m2
        (M, 3, 3) their covariances in the same frame, from the instrument's noise.
    time_sigmas_ns
        (M,) one sigma of the instants.
    stations
        (M,) number of the station that measured.
    """

    times_ns: NDArray[np.int64]
    points_m: NDArray[np.float64]
    covariances_m2: NDArray[np.float64]
    time_sigmas_ns: NDArray[np.int64]
    stations: NDArray[np.int64]

    @classmethod
    def empty(cls) -> Track:
        """Make a track without positions."""
        none = np.empty(0, dtype=np.int64)
        return cls(none, np.empty((0, 3)), np.empty((0, 3, 3)), none, none)

    @classmethod
    def joined(cls, tracks: Sequence[Track]) -> Track:
        """Put tracks one after the other, at least one; only in the order given."""
        return cls(
            np.concatenate([track.times_ns for track in tracks]),
            np.concatenate([track.points_m for track in tracks]),
            np.concatenate([track.covariances_m2 for track in tracks]),
            np.concatenate([track.time_sigmas_ns for track in tracks]),
            np.concatenate([track.stations for track in tracks]),
        )

    def __len__(self) -> int:
        return len(self.times_ns)

    def merged(self, other: Track) -> Track:
        """Return both in the order of time; of two positions at one instant that of the lower station stays.

        A station that has nothing new may send its last measurement again, with the same instant. Which of two
        stations wins must not depend on which came first, or a replay and the desk would differ.
        """
        if not len(self) and len(other) <= 1:
            return other
        joined = Track.joined([self, other])
        if (joined.times_ns[1:] > joined.times_ns[:-1]).all():
            return joined
        ordered = joined.select(np.lexsort((joined.stations, joined.times_ns)))
        return ordered.select(np.unique(ordered.times_ns, return_index=True)[1])

    def since(self, time_ns: int) -> Track:
        """Return the part that later epochs need: from the last position before an instant on."""
        return self.select(slice(max(0, int(self.times_ns.searchsorted(time_ns)) - 1), None))

    def select(self, rows: slice | NDArray[np.intp]) -> Track:
        """Return the given positions, by a slice or by their indices."""
        return Track(
            self.times_ns[rows],
            self.points_m[rows],
            self.covariances_m2[rows],
            self.time_sigmas_ns[rows],
            self.stations[rows],
        )


_EMPTY = Track.empty()

FARTHEST_M = 100_000.0
"""No total station measures so far, and no robot drives there: numbers beyond are garbage."""

AHEAD_AT_MOST_NS = 1_000_000_000
"""A measurement cannot have been made after it arrived; a clock offset that is a little off may make it seem so."""


def usable(measurement: Measurement) -> bool:
    """Tell whether a measurement holds a position: a status that allows it and a possible distance."""
    if not measurement.status.usable:
        return False
    if isinstance(measurement, PointMeasurement):
        return all(abs(coordinate) < FARTHEST_M for coordinate in measurement.position_m)
    distance_m = measurement.slope_distance_m
    return distance_m is not None and 0.0 < distance_m < FARTHEST_M


def measured_at_ns(measurement: Measurement, station: StationParameters) -> int:
    """Return the instant of a measurement: its stamp less the station's latency."""
    return measurement.stamp_ns - station.latency_ns


def believable(measurement: Measurement, station: StationParameters) -> bool:
    """Tell whether a measurement can have been made when its stamp says.

    One from the future cannot, and believing it would stop the stream until then.
    """
    return measured_at_ns(measurement, station) <= measurement.received_ns + AHEAD_AT_MOST_NS


def build_tracks(parameters: Parameters, measurements: Iterable[Measurement]) -> dict[int, Track]:
    """Tracks of all prisms of the layout from the usable measurements of the stations in the parameters.

    Parameters
    ----------
    parameters
        Station frames, constants, latencies, noise; and the prisms.
    measurements
        In any order. Unusable and unbelievable ones, and those of stations or prisms that the parameters do not
        name, are passed over.

    Returns
    -------
    dict[int, Track]
        One track per prism of the layout, an empty one where nothing was measured.
    """
    stations = {station.station: station for station in parameters.stations}
    tracks = dict.fromkeys((prism.prism for prism in parameters.prisms), _EMPTY)
    groups: dict[tuple[int, int, type], list[Measurement]] = defaultdict(list)
    for measurement in measurements:
        station = stations.get(measurement.station)
        if station is None or measurement.prism not in tracks:
            continue
        if usable(measurement) and believable(measurement, station):
            groups[measurement.station, measurement.prism, type(measurement)].append(measurement)
    for (number, prism, _), group in groups.items():
        tracks[prism] = tracks[prism].merged(_track_of(stations[number], group))
    return tracks


def _track_of(station: StationParameters, measurements: Sequence[Measurement]) -> Track:
    """Turn usable measurements of one station and one kind into a track, in the order given."""
    # The sequence is of one kind, but only its elements can tell mypy which.
    polar = [m for m in measurements if isinstance(m, PolarMeasurement)]
    points, covariances = _from_polar(station, polar) if polar else _from_points(station, measurements)
    track = Track(
        np.array([measured_at_ns(m, station) for m in measurements], dtype=np.int64),
        points,
        covariances,
        np.array([m.stamp_sigma_ns for m in polar] or [0] * len(measurements), dtype=np.int64),
        np.full(len(measurements), station.station, dtype=np.int64),
    )
    return _EMPTY.merged(track)


def _from_polar(
    station: StationParameters, measurements: Sequence[PolarMeasurement]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    horizontal = np.array([m.horizontal_angle_rad for m in measurements])
    zenith = np.array([m.zenith_angle_rad for m in measurements])
    slope = np.array([m.slope_distance_m for m in measurements], dtype=np.float64)
    distance = corrected_distance(slope, constant_m=station.prism_constant_m, ppm=station.atmospheric_ppm)
    frame = np.array(station.T_station1_station)
    rotation = frame[:3, :3]
    covariances = measurement_covariance(horizontal, zenith, distance, station.noise)
    return (
        transform_points(frame, polar_to_cartesian(horizontal, zenith, distance)),
        rotation @ covariances @ rotation.T,
    )


def _from_points(
    station: StationParameters, measurements: Sequence[Measurement]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    points = np.array([m.position_m for m in measurements if isinstance(m, PointMeasurement)])
    # Without the direction of the line of sight the range's noise has to stand for all three axes.
    noise = station.noise
    variance = noise.range_sigma_m**2 + noise.pointing_sigma_m**2
    return points, np.broadcast_to(variance * np.eye(3), (len(points), 3, 3)).copy()
