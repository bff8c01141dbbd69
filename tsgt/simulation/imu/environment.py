"""Gravity and the Earth's rotation at station 1, in its frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.geometry import exp_so3

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.config import SimulatedImu

EARTH_RATE_RADPS: Final = 7.292115e-5
_SEMI_MAJOR_AXIS_M: Final = 6_378_137.0
_FLATTENING: Final = 1 / 298.257223563
_ECCENTRICITY_SQUARED: Final = _FLATTENING * (2 - _FLATTENING)
_EQUATORIAL_GRAVITY_MPS2: Final = 9.7803253359
_SOMIGLIANA: Final = 0.00193185265241
_CENTRIFUGAL_SHARE: Final = 0.00344978650684


@dataclass(frozen=True, slots=True)
class Environment:
    """Vectors in frame ``station1``, the same all over the working area."""

    gravity_mps2: NDArray[np.float64]  # (3,) points down; includes the centrifugal acceleration
    earth_rate_radps: NDArray[np.float64]  # (3,)


def normal_gravity_mps2(latitude_rad: float, height_m: float) -> float:
    """Return normal gravity by WGS 84 (NGA.STND.0036, 4.2.2 and 4.3.1): formula of Somigliana, free-air to second order."""
    s2 = math.sin(latitude_rad) ** 2
    at_ellipsoid = (
        _EQUATORIAL_GRAVITY_MPS2 * (1 + _SOMIGLIANA * s2) / math.sqrt(1 - _ECCENTRICITY_SQUARED * s2)
    )
    relative = height_m / _SEMI_MAJOR_AXIS_M
    slope = 1 + _FLATTENING + _CENTRIFUGAL_SHARE - 2 * _FLATTENING * s2
    return at_ellipsoid * (1 - 2 * slope * relative + 3 * relative**2)


def draw_environment(config: SimulatedImu, generator: np.random.Generator) -> Environment:
    """Draw the azimuth of the x axis of station 1 and the tilt of its z axis."""
    latitude = math.radians(config.latitude_deg)
    azimuth = generator.uniform(-math.pi, math.pi)
    tilt = generator.normal(0.0, math.radians(config.vertical_sigma_arcsec / 3600), 2)
    north = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    level_to_station1 = exp_so3(np.array([*tilt, 0.0]))
    return Environment(
        level_to_station1 @ [0.0, 0.0, -normal_gravity_mps2(latitude, config.height_m)],
        EARTH_RATE_RADPS
        * (level_to_station1 @ (math.cos(latitude) * north + [0.0, 0.0, math.sin(latitude)])),
    )
