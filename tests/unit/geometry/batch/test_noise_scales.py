"""tsgt.geometry.batch.noise_scales: what measurements at rest say about the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.drives.slow_motion import creeping, measure_along

from tsgt.geometry.batch.noise_scales import MIN_SCALE, min_scales
from tsgt.geometry.rest import RestInterval

WHOLE = [RestInterval(0.0, 40.0, 0.0)]


@pytest.mark.parametrize(("noise", "expected"), [(0.8, 0.8), (1.0, 1.0), (0.2, MIN_SCALE)])
def test_least_factors_are_the_scatter_at_rest(noise: float, expected: float) -> None:
    """By station and component, and not below half the sheet."""
    still = measure_along(creeping(0.0), until_s=40.0, seed=3, noise_scale=noise)
    np.testing.assert_allclose(min_scales(still, WHOLE), expected, rtol=0.2)


def test_vibration_at_rest_is_no_noise() -> None:
    """An engine that shakes a standing robot by millimetres does not say that instruments are bad."""
    shaken = measure_along(creeping(0.0), until_s=40.0, seed=3, vibration_m=0.005)
    np.testing.assert_allclose(min_scales(shaken, WHOLE), 1.0)


def test_least_factors_of_stations_that_saw_no_rest() -> None:
    """Half the sheet where nothing is known."""
    still = measure_along(creeping(0.0), until_s=40.0, seed=3)
    two = still.select(still.station != 1)
    assert (min_scales(two, WHOLE)[1] == MIN_SCALE).all()
    np.testing.assert_allclose(min_scales(still, []), MIN_SCALE)


def test_each_stop_has_its_own_mean() -> None:
    """A robot that stood elsewhere before is not noise."""
    still = measure_along(creeping(0.0), until_s=40.0, seed=3)
    points_m = still.points_m + np.where(still.time_s < 20.0, 0.0, 0.1)[:, None]
    stops = [RestInterval(0.0, 19.9, 0.0), RestInterval(20.1, 40.0, 0.0)]
    np.testing.assert_allclose(min_scales(replace(still, points_m=points_m), stops), 1.0, rtol=0.2)
