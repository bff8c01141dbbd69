"""Measurement noise: each component acts in its direction with its stated size."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tsgt.geometry import polar_to_cartesian
from tsgt.model import ARCSECOND_RAD, InstrumentNoise
from tsgt.simulation.instrument.edm import measure_polar

POINT = np.array([60.0, 45.0, 60.0])
DISTANCE_M = float(np.linalg.norm(POINT))
SILENT = {"range_sigma_m": 0.0, "range_sigma_ppm": 0.0, "angle_sigma_rad": 0.0, "pointing_sigma_m": 0.0}


@pytest.mark.parametrize(
    ("part", "sigma", "direction", "expected_m"),
    [
        ("range_sigma_m", 0.002, "along", 0.002),
        ("range_sigma_ppm", 100.0, "along", 100e-6 * DISTANCE_M),
        ("angle_sigma_rad", 20 * ARCSECOND_RAD, "across", 20 * ARCSECOND_RAD * DISTANCE_M),
        ("angle_sigma_rad", 20 * ARCSECOND_RAD, "up", 20 * ARCSECOND_RAD * DISTANCE_M),
        ("pointing_sigma_m", 0.001, "along", 0.001),
        ("pointing_sigma_m", 0.001, "across", 0.001),
        ("pointing_sigma_m", 0.001, "up", 0.001),
    ],
)
def test_noise_matches_its_sigma(part: str, sigma: float, direction: str, expected_m: float) -> None:
    """Angle and ppm noise grow with the distance; a steep line of sight has no more noise across than a level one."""
    points = np.tile(POINT, (20_000, 1))
    noise = InstrumentNoise(**SILENT | {part: sigma})
    error = polar_to_cartesian(*measure_polar(points, noise, np.random.default_rng(1))) - points
    sight = POINT / DISTANCE_M
    across = np.cross(sight, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    seen_m = error @ {"along": sight, "across": across, "up": np.cross(across, sight)}[direction]
    assert seen_m.std() == pytest.approx(expected_m, rel=0.03)
    assert abs(seen_m.mean()) < 4 * expected_m / math.sqrt(len(seen_m))


def test_zero_noise_gives_the_truth() -> None:
    """Angles and distance of the point itself."""
    seen = measure_polar(POINT[None], InstrumentNoise(**SILENT), np.random.default_rng(1))
    np.testing.assert_allclose(polar_to_cartesian(*seen)[0], POINT, atol=1e-12)
