"""Noise scales between parameters and the estimator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from harness.drives.scene import stationary_scene

from tsgt.estimation import noise_scales, with_noise_scales

PARAMETERS = stationary_scene().parameters


def test_factors_survive_a_round_trip() -> None:
    """Parameters with factors by station and component give these factors back."""
    factors = np.array([[1.0, 2.0, 3.0], [0.5, 1.5, 2.5], [4.0, 1.0, 1.0], [2.0, 2.0, 2.0]])
    found = with_noise_scales(PARAMETERS, factors, 2.0)
    np.testing.assert_allclose(noise_scales(found), factors)


def test_cartesian_points_have_the_factor_of_the_pipeline() -> None:
    """The last row is that of points, whatever the stations' own factors are."""
    pipeline = replace(PARAMETERS.pipeline, noise_scale=3.0)
    assert noise_scales(replace(PARAMETERS, pipeline=pipeline))[-1].tolist() == [3.0, 3.0, 3.0]
