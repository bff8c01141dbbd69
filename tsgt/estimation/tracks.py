"""Raw measurements to each prism's track in the frame ``station1``.

Applies latency, instrument errors, prism constant, atmospheric scale and the station's frame; the raw measurement stays unchanged.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import (
    corrected_angles,
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

MAX_TIME_SIGMA_S = 100.0


@dataclass(frozen=True, slots=True)
class Track:
    """Positions of one prism in the order of time."""

    times_ns: NDArray[np.int64]
    """(M,) instants of measurement on the master's Unix clock, strictly increasing."""
    points_m: NDArray[np.float64]  # (M, 3) positions in the frame ``station1``
    covariances_m2: NDArray[np.float64]
    """(M, 3, 3) their covariances in the same frame, from the instrument's noise."""
    time_sigmas_ns: NDArray[np.int64]  # (M,) one sigma of the instants
    stations: NDArray[np.int64]  # (M,) number of the station that measured

    @classmethod
    def empty(cls) -> Track:
        """Return a track without positions."""
        none = np.empty(0, dtype=np.int64)
        return cls(none, np.empty((0, 3)), np.empty((0, 3, 3)), none, none)

    @classmethod
    def joined(cls, tracks: Sequence[Track]) -> Track:
        """Concatenate at least one track in the given order."""
        return cls(*(np.concatenate([getattr(track, f.name) for track in tracks]) for f in fields(cls)))

    def __len__(self) -> int:
        return len(self.times_ns)

    def merged(self, other: Track) -> Track:
        """Return both in the order of time; of two positions at one instant that of the lower station is kept.

        A station without a new measurement may repeat its last one, with the same instant. Which of two stations wins
        must not depend on the order of arrival, or live and post-processed poses would differ.
        """
        if not len(self) and len(other) <= 1:
            return other
        joined = Track.joined([self, other])
        if (joined.times_ns[1:] > joined.times_ns[:-1]).all():
            return joined
        ordered = joined.select(np.lexsort((joined.stations, joined.times_ns)))
        return ordered.select(np.unique(ordered.times_ns, return_index=True)[1])

    def since(self, time_ns: int) -> Track:
        """Return the part from the last position before an instant, which later epochs need."""
        return self.select(slice(max(0, int(self.times_ns.searchsorted(time_ns)) - 1), None))

    def select(self, rows: slice | NDArray[np.intp]) -> Track:
        """Return the positions at a slice or at indices."""
        return Track(*(getattr(self, f.name)[rows] for f in fields(self)))


_EMPTY = Track.empty()

MAX_DISTANCE_M = 100_000.0  # longer than the range of any total station

MAX_FUTURE_NS = 1_000_000_000
"""A small error of the clock offset may date a measurement after its arrival by this much."""


def usable(measurement: Measurement) -> bool:
    """Return whether a measurement has a usable status and a possible distance or position."""
    if not measurement.status.usable:
        return False
    if isinstance(measurement, PointMeasurement):
        return all(abs(coordinate) < MAX_DISTANCE_M for coordinate in measurement.position_m)
    distance_m = measurement.slope_distance_m
    return distance_m is not None and 0.0 < distance_m < MAX_DISTANCE_M


def measured_at_ns(measurement: Measurement, station: StationParameters) -> int:
    """Return the instant of a measurement: its stamp minus the station's latency."""
    return measurement.stamp_ns - station.latency_ns


def has_plausible_time(measurement: Measurement, station: StationParameters) -> bool:
    """Return whether a measurement is not from the future, which would stop the stream until then."""
    return measured_at_ns(measurement, station) <= measurement.received_ns + MAX_FUTURE_NS


def build_tracks(parameters: Parameters, measurements: Iterable[Measurement]) -> dict[int, Track]:
    """Return the track of every prism of the layout, possibly empty.

    Unusable and implausible measurements, and those of unknown stations or prisms, are ignored; the others may be in any
    order.
    """
    stations = {station.station: station for station in parameters.stations}
    tracks = dict.fromkeys((prism.prism for prism in parameters.prisms), _EMPTY)
    groups: dict[tuple[int, int, type], list[Measurement]] = defaultdict(list)
    for measurement in measurements:
        station = stations.get(measurement.station)
        if station is None or measurement.prism not in tracks:
            continue
        if usable(measurement) and has_plausible_time(measurement, station):
            groups[measurement.station, measurement.prism, type(measurement)].append(measurement)
    for (number, prism, _), group in groups.items():
        tracks[prism] = tracks[prism].merged(_track_of(stations[number], group))
    return tracks


def _track_of(station: StationParameters, measurements: Sequence[Measurement]) -> Track:
    """Return the track of usable measurements of one station and one type."""
    # All have the same type; mypy needs the elements' types.
    polar = [m for m in measurements if isinstance(m, PolarMeasurement)]
    points, covariances = _from_polar(station, polar) if polar else _from_points(station, measurements)
    track = Track(
        np.array([measured_at_ns(m, station) for m in measurements], dtype=np.int64),
        points,
        covariances,
        np.array([_time_sigma_ns(m, station) for m in polar] or [0] * len(measurements), dtype=np.int64),
        np.full(len(measurements), station.station, dtype=np.int64),
    )
    return _EMPTY.merged(track)


def _time_sigma_ns(measurement: PolarMeasurement, station: StationParameters) -> int:
    # Beyond the limit a measurement has no weight; its square would overflow.
    stamp_sigma_ns = min(measurement.stamp_sigma_ns, 1e9 * MAX_TIME_SIGMA_S)
    return round(math.hypot(stamp_sigma_ns, 1e9 * station.time_sigma_s))


def _from_polar(
    station: StationParameters, measurements: Sequence[PolarMeasurement]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    horizontal, zenith = corrected_angles(
        [m.horizontal_angle_rad for m in measurements],
        [m.zenith_angle_rad for m in measurements],
        vertical_index_rad=station.vertical_index_rad,
        collimation_rad=station.collimation_rad,
    )
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
    # The direction of the line of sight is unknown, so the range noise applies to all three axes.
    noise = station.noise
    variance = noise.range_sigma_m**2 + noise.pointing_sigma_m**2
    return points, np.broadcast_to(variance * np.eye(3), (len(points), 3, 3)).copy()
