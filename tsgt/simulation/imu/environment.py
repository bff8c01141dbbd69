"""Gravity and the Earth's rotation at station 1, in its frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.config import normal_gravity_mps2
from tsgt.geometry import exp_so3

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.config import SimulatedImu

EARTH_RATE_RADPS: Final = 7.292115e-5


@dataclass(frozen=True, slots=True)
class Environment:
    """Vectors in frame ``station1``, the same all over the working area."""

    gravity_mps2: NDArray[np.float64]  # (3,) points down; includes the centrifugal acceleration
    earth_rate_radps: NDArray[np.float64]  # (3,)


def draw_environment(config: SimulatedImu, generator: np.random.Generator) -> Environment:
    """Draw the azimuth of the x axis of station 1 and the tilt of its z axis."""
    latitude = math.radians(config.latitude_deg)
    azimuth = generator.uniform(-math.pi, math.pi)
    tilt = generator.normal(0.0, math.radians(config.vertical_sigma_arcsec / 3600), 2)
    north = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    level_to_station1 = exp_so3(np.array([*tilt, 0.0]))
    return Environment(
        level_to_station1 @ [0.0, 0.0, -normal_gravity_mps2(config.latitude_deg, config.height_m)],
        EARTH_RATE_RADPS
        * (level_to_station1 @ (math.cos(latitude) * north + [0.0, 0.0, math.sin(latitude)])),
    )
