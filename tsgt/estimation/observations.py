"""Raw measurements to the observations of the estimator ``continuous``.

Applies latency, instrument errors, prism constant, atmospheric scale and noise; the raw measurement stays unchanged. Prism positions are
relative to their centroid, whose motion the motion prior describes: the origin of a layout is arbitrary, and a tilting
robot swings a distant origin about, which the prior would interpret as driving.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation.tracks import MAX_TIME_SIGMA_S, has_plausible_time, measured_at_ns, usable
from tsgt.geometry import corrected_angles, corrected_distance, polar_to_cartesian
from tsgt.geometry.trajectory import Observations
from tsgt.model import PointMeasurement, PolarMeasurement

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from tsgt.geometry import FloatArray
    from tsgt.model import Measurement, Parameters, StationParameters

INSTRUMENT_TIME_SIGMA_S = 6e-4
FIRST_TIME_SIGMA_S = 3e-3
FIRST_TIMES = 5
"""Sigma of the conversion from an instrument's clock to its station's, which no stamp includes: steady state, with
timestamps in whole ms, and first measurements, from where it falls with the square root of their number. The conversion
uses responses with random delays (docs/explanation/instrument-time.md), and its error is correlated over many measurements,
so the values are conservative."""

MIN_SIGMA_M = 1e-5
"""A tenth of the instruments' last digit. A configuration may state no noise, which cannot be used as a weight."""


def centroid_m(parameters: Parameters) -> FloatArray:
    """Return the centroid (3,) of the prisms in the robot frame, in m."""
    centroid: FloatArray = _layout(parameters).mean(axis=0)
    return centroid


def build_observations(
    parameters: Parameters, measurements: Iterable[Measurement], *, origin_ns: int
) -> tuple[Observations, list[Measurement]]:
    """Return the observations of all usable measurements in the order of time, and the measurement of each.

    ``measurements``: in any order. Unusable and implausible ones, and those of unknown stations or prisms, are ignored.
    Of a station's measurements with the same instant the first is used: a station without a new measurement may repeat
    its last one. ``origin_ns``: origin of the observations' times, on the master's Unix clock.
    """
    stations = {station.station: row for row, station in enumerate(parameters.stations)}
    prisms = {prism.prism: row for row, prism in enumerate(parameters.prisms)}
    timed: dict[tuple[int, int], Measurement] = {}
    for measurement in measurements:
        row = stations.get(measurement.station)
        if row is None or measurement.prism not in prisms:
            continue
        station = parameters.stations[row]
        if usable(measurement) and has_plausible_time(measurement, station):
            timed.setdefault((measured_at_ns(measurement, station), row), measurement)
    ordered = sorted(timed.items(), key=lambda item: item[0])
    sources = [measurement for _, measurement in ordered]
    is_point = np.array([isinstance(m, PointMeasurement) for m in sources], dtype=bool)
    points, sigmas = np.empty((len(ordered), 3)), np.empty((len(ordered), 3))
    polar: dict[int, list[int]] = {}
    for i, ((_, row), measurement) in enumerate(ordered):
        if isinstance(measurement, PolarMeasurement):
            polar.setdefault(row, []).append(i)
            continue
        points[i] = measurement.position_m
        # The direction of the line of sight is unknown, so the range noise applies to all three axes.
        noise = parameters.stations[row].noise
        sigmas[i] = np.hypot(noise.range_sigma_m, noise.pointing_sigma_m)
    for row, own in polar.items():
        points[own], sigmas[own] = _polar_points(parameters.stations[row], [sources[i] for i in own])
    # Cartesian points are already in frame 1, whatever their station: the row after the stations' frames.
    layout = _layout(parameters)
    frames = np.array([*(s.T_station1_station for s in parameters.stations), np.eye(4)])
    station_rows = np.array([row for (_, row), _ in ordered], dtype=np.intp)
    return (
        Observations(
            time_s=np.array([time_ns - origin_ns for (time_ns, _), _ in ordered], dtype=np.int64) / 1e9,
            time_sigma_s=np.array(
                [
                    _time_sigma_s(m, parameters.stations[row])
                    for m, ((_, row), _) in zip(sources, ordered, strict=True)
                ],
                dtype=np.float64,
            ),
            points_m=points,
            sigmas_m=np.maximum(sigmas, MIN_SIGMA_M),
            polar=~is_point,
            station=np.where(is_point, len(parameters.stations), station_rows),
            prism=np.array([prisms[m.prism] for m in sources], dtype=np.intp),
            frames=frames,
            layout=layout - layout.mean(axis=0),
        ),
        sources,
    )


def _time_sigma_s(measurement: Measurement, station: StationParameters) -> float:
    """Return one sigma of a measurement's time: of its stamp, and of the instrument's time that the stamp is based on."""
    stamp_sigma_s = getattr(measurement, "stamp_sigma_ns", 0) / 1e9
    if not stamp_sigma_s:  # imported: taken as exact
        return station.time_sigma_s
    instrument_s = instrument_time_sigma_s(measurement.sequence)
    # Beyond the limit a measurement has no weight; its square would overflow the solver.
    stamp_sigma_s = min(stamp_sigma_s, MAX_TIME_SIGMA_S)
    return math.hypot(math.hypot(stamp_sigma_s, instrument_s), station.time_sigma_s)


def instrument_time_sigma_s(sequence: int) -> float:
    """Return one sigma in s of an instrument's time on its station's clock, by the measurement's sequence number."""
    number = min(max(sequence, 0), 1_000_000)  # a damaged file may contain any number
    return math.hypot(INSTRUMENT_TIME_SIGMA_S, FIRST_TIME_SIGMA_S / math.sqrt(1 + number / FIRST_TIMES))


def _layout(parameters: Parameters) -> FloatArray:
    return np.array([prism.position_m for prism in parameters.prisms], dtype=np.float64)


def _polar_points(
    station: StationParameters, measurements: Sequence[Measurement]
) -> tuple[FloatArray, FloatArray]:
    """Points in the station frame of a station's polar measurements, (M, 3) in m, and their sigmas, (M, 3).

    Sigmas along the line of sight and in both directions across it.
    """
    raw = np.array(
        [
            (m.slope_distance_m, m.horizontal_angle_rad, m.zenith_angle_rad)
            for m in measurements
            if isinstance(m, PolarMeasurement)
        ],
        dtype=np.float64,
    )
    distance_m = corrected_distance(
        raw[:, 0], constant_m=station.prism_constant_m, ppm=station.atmospheric_ppm
    )
    angles_rad = corrected_angles(
        raw[:, 1],
        raw[:, 2],
        vertical_index_rad=station.vertical_index_rad,
        collimation_rad=station.collimation_rad,
    )
    noise = station.noise
    along = np.sqrt(
        noise.range_sigma_m**2 + (noise.range_sigma_ppm * 1e-6 * distance_m) ** 2 + noise.pointing_sigma_m**2
    )
    across = np.hypot(noise.angle_sigma_rad * distance_m, noise.pointing_sigma_m)
    sigmas = np.empty((len(raw), 3))
    sigmas[:, 0], sigmas[:, 1:] = along, across[:, None]
    return polar_to_cartesian(*angles_rad, distance_m), sigmas
