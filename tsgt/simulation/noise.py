"""The noise of a total station's measurements."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import cartesian_to_polar

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.model import InstrumentNoise


def with_noise(
    points: NDArray[np.float64], noise: InstrumentNoise, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Measure points as a total station does.

    Parameters
    ----------
    points
        (N, 3) in the frame of the station, in m.
    noise
        One sigma; all of it white.
    generator
        Source of the noise.

    Returns
    -------
    tuple
        Horizontal angle from 0 to 2 pi and zenith angle in rad, distance to the point in m; each (N,).
    """
    points = points + generator.normal(0.0, noise.pointing_sigma_m, points.shape)
    horizontal, zenith, distance = cartesian_to_polar(points)
    angle_noise = generator.normal(0.0, noise.angle_sigma_rad, (2, len(points)))
    horizontal = np.mod(horizontal + angle_noise[0] / np.sin(zenith), 2 * math.pi)
    range_sigma = np.hypot(noise.range_sigma_m, noise.range_sigma_ppm * 1e-6 * distance)
    return (
        horizontal,
        zenith + angle_noise[1],
        distance + range_sigma * generator.standard_normal(len(points)),
    )
