"""From raw measurements to what the estimator ``continuous`` computes with.

Latency, prism constant, atmospheric scale and noise are applied here; the raw measurement stays as it is. Prisms are counted
from their middle, so that it is the middle that moves as the motion prior says: what a layout counts from is anybody's choice,
and a robot that tilts swings a far origin about, which the prior would take for driving.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation.tracks import believable, measured_at_ns, usable
from tsgt.geometry import Observations, corrected_distance, polar_to_cartesian
from tsgt.model import PointMeasurement, PolarMeasurement

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.geometry import FloatArray
    from tsgt.model import InstrumentNoise, Measurement, Parameters

INSTRUMENT_TIME_SIGMA_S = 6e-4
FIRST_TIME_SIGMA_S = 3e-3
FIRST_TIMES = 5
"""One sigma of an instrument's time on its station's clock, which no stamp states: of one told in whole ms; and of a
station's first measurements, from when it falls with the root of their number. It is found from answers that come late
(docs/explanation/instrument-time.md), and is off the same way for many measurements, so this is on the cautious side."""

LEAST_SIGMA_M = 1e-5
"""A tenth of the last digit that instruments give. A configuration may state no noise at all, but nothing can be weighed by it."""


def middle_m(parameters: Parameters) -> FloatArray:
    """(3,) middle (centroid) of the prisms in the robot frame, whose motion is what observations tell of; in m."""
    middle: FloatArray = _layout(parameters).mean(axis=0)
    return middle


def build_observations(
    parameters: Parameters, measurements: Iterable[Measurement], *, origin_ns: int
) -> tuple[Observations, list[Measurement]]:
    """Observations of all usable measurements of the stations and prisms in the parameters.

    Parameters
    ----------
    parameters
        Station frames, constants, latencies, noise; and the prisms.
    measurements
        In any order. Unusable and unbelievable ones, and those of stations or prisms that the parameters do not name,
        are passed over. Of those of one station with the same instant the first stays: a station that has nothing
        new may send its last measurement again.
    origin_ns
        What the observations' times count from, on the master's Unix clock.

    Returns
    -------
    observations : Observations
        In the order of time, with a layout that counts from :func:`middle_m`.
    sources : list of Measurement
        The measurement of each.
    """
    stations = {station.station: row for row, station in enumerate(parameters.stations)}
    prisms = {prism.prism: row for row, prism in enumerate(parameters.prisms)}
    timed: dict[tuple[int, int], Measurement] = {}
    for measurement in measurements:
        row = stations.get(measurement.station)
        if row is None or measurement.prism not in prisms:
            continue
        station = parameters.stations[row]
        if usable(measurement) and believable(measurement, station):
            timed.setdefault((measured_at_ns(measurement, station), row), measurement)
    ordered = sorted(timed.items(), key=lambda item: item[0])
    points, sigmas = np.empty((len(ordered), 3)), np.empty((len(ordered), 3))
    for i, ((_, row), measurement) in enumerate(ordered):
        station = parameters.stations[row]
        if isinstance(measurement, PolarMeasurement):
            assert measurement.slope_distance_m is not None  # noqa: S101 (it is usable)
            distance_m = float(
                corrected_distance(
                    measurement.slope_distance_m,
                    constant_m=station.prism_constant_m,
                    ppm=station.atmospheric_ppm,
                )
            )
            points[i] = polar_to_cartesian(
                measurement.horizontal_angle_rad, measurement.zenith_angle_rad, distance_m
            )
            sigmas[i] = _sigmas_m(station.noise, distance_m)
        else:
            points[i] = measurement.position_m
            # Without the direction of the line of sight the range's noise has to stand for all three axes.
            sigmas[i] = np.hypot(station.noise.range_sigma_m, station.noise.pointing_sigma_m)
    sources = [measurement for _, measurement in ordered]
    is_point = np.array([isinstance(m, PointMeasurement) for m in sources], dtype=bool)
    # Cartesian points are in frame 1 already, whichever station they came from: the row after the stations' frames.
    layout = _layout(parameters)
    frames = np.array([*(s.T_station1_station for s in parameters.stations), np.eye(4)])
    station_rows = np.array([row for (_, row), _ in ordered], dtype=np.intp)
    return (
        Observations(
            time_s=np.array([time_ns - origin_ns for (time_ns, _), _ in ordered], dtype=np.int64) / 1e9,
            time_sigma_s=np.array([_time_sigma_s(m) for m in sources], dtype=np.float64),
            points_m=points,
            sigmas_m=np.maximum(sigmas, LEAST_SIGMA_M),
            polar=~is_point,
            station=np.where(is_point, len(parameters.stations), station_rows),
            prism=np.array([prisms[m.prism] for m in sources], dtype=np.intp),
            frames=frames,
            layout=layout - layout.mean(axis=0),
        ),
        sources,
    )


def _time_sigma_s(measurement: Measurement) -> float:
    """One sigma of when it was made: of its stamp, and of the instrument's time that the stamp rests on."""
    stamp_sigma_s = getattr(measurement, "stamp_sigma_ns", 0) / 1e9
    if not stamp_sigma_s:  # imported: its time is taken at its word
        return 0.0
    return math.hypot(stamp_sigma_s, instrument_time_sigma_s(measurement.sequence))


def instrument_time_sigma_s(sequence: int) -> float:
    """Return one sigma in s of an instrument's time on its station's clock, by the measurement's running number."""
    number = min(max(sequence, 0), 1_000_000)  # a damaged file may say anything
    return math.hypot(INSTRUMENT_TIME_SIGMA_S, FIRST_TIME_SIGMA_S / math.sqrt(1 + number / FIRST_TIMES))


def _layout(parameters: Parameters) -> FloatArray:
    return np.array([prism.position_m for prism in parameters.prisms], dtype=np.float64)


def _sigmas_m(noise: InstrumentNoise, distance_m: float) -> tuple[float, float, float]:
    """One sigma along the line of sight and in both directions across it."""
    along = np.sqrt(
        noise.range_sigma_m**2 + (noise.range_sigma_ppm * 1e-6 * distance_m) ** 2 + noise.pointing_sigma_m**2
    )
    across = float(np.hypot(noise.angle_sigma_rad * distance_m, noise.pointing_sigma_m))
    return float(along), across, across
