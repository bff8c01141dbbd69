"""Simulated measurements of a scenario without daemons and radio; each arrives after a random delay."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import scenario_parameters
from tsgt.geometry import invert, raw_distance, transform_points
from tsgt.model import PolarMeasurement
from tsgt.simulation.instrument.edm import measure_polar

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.config import ScenarioConfig
    from tsgt.model import StationParameters
    from tsgt.simulation.world import World

DELAY_S = (0.05, 0.25)
"""Limits of the uniform delay from a measurement to its arrival."""


def simulated_measurements(
    scenario: ScenarioConfig, world: World, generator: np.random.Generator, *, start_ns: int
) -> list[PolarMeasurement]:
    """Return the measurements of all stations of a scenario in the order of arrival, until the world ends.

    The world's prisms are in the order of the scenario's; ``start_ns`` is the Unix time of its start.
    """
    end_ns = start_ns + round(world.duration_s * 1e9)
    rows = {prism.prism: row for row, prism in enumerate(scenario.prisms)}
    measurements: list[PolarMeasurement] = []
    for station, config in zip(scenario_parameters(scenario).stations, scenario.stations, strict=True):
        period_s = 1.0 / config.rate_hz
        times_s = np.arange(generator.uniform(0.0, period_s), world.duration_s, period_s)
        points = world.prism_at(times_s, rows[station.prism])
        measurements.extend(_measured(station, times_s, points, generator, start_ns))
    return sorted((m for m in measurements if m.received_ns <= end_ns), key=lambda m: m.received_ns)


def _measured(
    station: StationParameters,
    times_s: NDArray[np.float64],
    points: NDArray[np.float64],
    generator: np.random.Generator,
    start_ns: int,
) -> Iterator[PolarMeasurement]:
    """Yield one station's measurements of a prism at points (N, 3) in ``station1``."""
    delays_s = generator.uniform(*DELAY_S, len(times_s))
    seen = transform_points(invert(np.array(station.T_station1_station)), points)
    horizontal, zenith, distance = measure_polar(seen, station.noise, generator)
    slope = raw_distance(distance, constant_m=station.prism_constant_m, ppm=station.atmospheric_ppm)
    stamps = start_ns + np.rint(times_s * 1e9).astype(np.int64)
    received = stamps + np.rint(delays_s * 1e9).astype(np.int64)
    columns = (stamps, received, horizontal, zenith, slope)
    for sequence, row in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        stamp_ns, received_ns, horizontal_rad, zenith_rad, slope_m = row
        yield PolarMeasurement(
            station=station.station,
            prism=station.prism,
            sequence=sequence,
            stamp_ns=stamp_ns,
            received_ns=received_ns,
            horizontal_angle_rad=horizontal_rad,
            zenith_angle_rad=zenith_rad,
            slope_distance_m=slope_m,
            host_time_ns=stamp_ns,
        )
