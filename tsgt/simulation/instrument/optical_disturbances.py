"""Disturbances of the line of sight to a prism: heat shimmer, rain, and multipath of the distance.

Each has its own generator: an instrument without disturbances measures the same as ever.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

if TYPE_CHECKING:
    import numpy as np


class PolarPoint(NamedTuple):
    """A prism as measured, in the frame of the station."""

    horizontal_rad: float
    zenith_rad: float
    distance_m: float

    def displaced(self, right_m: float, down_m: float, away_m: float) -> PolarPoint:
        """Return the point displaced across and along the line of sight."""
        distance_m = max(self.distance_m, 1e-3)
        return PolarPoint(
            self.horizontal_rad + right_m / (distance_m * max(math.sin(self.zenith_rad), 1e-3)),
            self.zenith_rad + down_m / distance_m,
            self.distance_m + away_m,
        )


class OpticalDisturbance(Protocol):
    """What lies between an instrument and its prism."""

    def apply(self, measured: PolarPoint, at_s: float) -> PolarPoint | None:
        """Return what is measured instead at a time in s from the start of the world; None: no distance.

        Times do not decrease from call to call.
        """


APERTURE_M: Final = 0.04
"""Aperture of the telescope, by data sheets of TPS1200 and S7."""

NEUTRAL_HOURS: Final = (7.0, 19.0)
"""Hours of the day between which the ground heats the air: from an hour after sunrise to one before sunset; an assumption."""

SHIMMER_RANGE_SHARE: Final = 0.3
"""Error of the distance as a share of that across the line of sight; an assumption."""


def structure_parameter(noon: float, hour: float) -> float:
    """Return the structure parameter of the refractive index at an hour of the day, in m^(-2/3); ``noon``: that of noon.

    Proportional to the heat flux to the power of 4/3 (J. C. Wyngaard and others, "Behavior of the refractive-index-structure
    parameter near the ground", 1971), with a heat flux that follows the sun.
    """
    first, last = NEUTRAL_HOURS
    sun = math.sin(math.pi * (hour - first) / (last - first)) if first < hour < last else 0.0
    return noon * math.pow(max(sun, 0.0), 4 / 3)


class HeatShimmer:
    """Angles and distances fluctuate with the air near heated ground.

    The angle of arrival of a spherical wave has the variance 1.09 C_n² L D^(-1/3) along each axis, with the range L and the
    aperture D (L. C. Andrews and R. L. Phillips, *Laser Beam Propagation through Random Media*, 2005, chapter 6). Errors are
    first-order Gauss-Markov processes.

    Parameters
    ----------
    noon
        Structure parameter C_n² at noon in m^(-2/3): 1e-14 (calm) to 1e-12 (strong) near the ground.
    start_hour
        Hour of the day at the start of the world.
    correlation_time_s
        Time constant of the errors.
    """

    def __init__(
        self, noon: float, start_hour: float, correlation_time_s: float, generator: np.random.Generator
    ) -> None:
        self._noon = noon
        self._start_hour = start_hour
        self._correlation_time_s = correlation_time_s
        self._rng = generator
        self._at_s = -math.inf
        self._errors = [0.0, 0.0, 0.0]  # right, down, away, with a sigma of 1

    def apply(self, measured: PolarPoint, at_s: float) -> PolarPoint:
        """Return the measured point with the errors of the air."""
        kept = math.exp(-(at_s - self._at_s) / self._correlation_time_s)
        added = math.sqrt(1.0 - kept * kept)
        white = self._rng.standard_normal(3).tolist()
        self._errors = [kept * old + added * new for old, new in zip(self._errors, white, strict=True)]
        self._at_s = at_s
        sigma_m = self.angle_sigma_rad(measured.distance_m, at_s) * measured.distance_m
        right, down, away = (sigma_m * error for error in self._errors)
        return measured.displaced(right, down, SHIMMER_RANGE_SHARE * away)

    def angle_sigma_rad(self, distance_m: float, at_s: float) -> float:
        """Return the standard deviation of an angle at a distance and time in s from the start of the world."""
        parameter = structure_parameter(self._noon, self._start_hour + at_s / 3600.0)
        return math.sqrt(1.09 * parameter * distance_m * math.pow(APERTURE_M, -1 / 3))


CLEAR_RANGE_M: Final = 1000.0
"""Range at which the return is just strong enough in clear air."""

WET_PRISM_DB: Final = 12.0
"""Loss of a prism covered with drops, in and out; an assumption."""

FADING_DB: Final = 6.0
"""One sigma of the return as drops pass the beam; an assumption."""

MISSED_SHARE: Final = 0.25
"""Share of the distances that fail in the heaviest rain at any range, when a drop runs over the optics; an assumption."""

RAIN_SIGMA_M: Final = 0.002
"""One sigma of additional noise across and along the line of sight in the heaviest rain; an assumption."""

HEAVY_RAIN_MMPH: Final = 50.0


class Rain:
    """The return is weak: distances fail and are noisy, and the range is shorter.

    Attenuation in dB/km: 1.076 R^0.67 with the rain rate R in mm/h (ITU-R P.1814). The return falls with the fourth power of
    the range.
    """

    def __init__(self, rate_mmph: float, generator: np.random.Generator) -> None:
        self.intensity = min(rate_mmph / HEAVY_RAIN_MMPH, 1.0)
        self._attenuation_db_per_m = 1.076e-3 * math.pow(rate_mmph, 0.67)
        self._rng = generator

    def apply(self, measured: PolarPoint, at_s: float) -> PolarPoint | None:  # noqa: ARG002 (all errors are white)
        """Return the measured point with more noise; None: the return is too weak."""
        missed = self._rng.random()
        faded, right, down, away = self._rng.standard_normal(4).tolist()
        if missed < MISSED_SHARE * self.intensity or self.margin_db(measured.distance_m) < FADING_DB * faded:
            return None
        sigma_m = RAIN_SIGMA_M * self.intensity
        return measured.displaced(sigma_m * right, sigma_m * down, sigma_m * away)

    def margin_db(self, distance_m: float) -> float:
        """Return by how much the mean return from a distance exceeds the weakest one that can be measured."""
        clear_db = 40.0 * math.log10(CLEAR_RANGE_M / max(distance_m, 1e-3))
        return clear_db - WET_PRISM_DB * self.intensity - 2 * distance_m * self._attenuation_db_per_m


class Multipath:
    """Part of the light takes a way round over a reflecting surface: distances are too long by a constant."""

    def __init__(self, offset_m: float) -> None:
        self._offset_m = offset_m

    def apply(self, measured: PolarPoint, at_s: float) -> PolarPoint:  # noqa: ARG002 (constant)
        """Return the measured point, farther away."""
        return measured.displaced(0.0, 0.0, self._offset_m)
