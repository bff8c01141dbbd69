"""When a simulated total station takes distances, and what it adds to them.

The noise of a total station's measurements.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.geometry import cartesian_to_polar

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.model import InstrumentNoise

CONTINUOUS: Final = frozenset({6, 7, 8, 9})
"""EDM modes that go on measuring until stopped."""

WITHOUT_PRISM: Final = frozenset({1, 5, 8, 12, 14})
"""EDM modes for reflector tape and without any reflector; the others need a prism."""

START_NS: Final = 200_000_000
"""From the order to the first distance that can come; an assumption."""

SHOT_S: Final = (1.0, 2.0)
"""A single measurement takes a time between these: 1.2 s in the data sheet of a Trimble S7."""

RANGE_M: Final = (1.0, 1000.0)
"""Nearer and farther than this there is no distance."""

_JITTERS: Final = 1024


class DistanceMeter:
    """The instants at which distances are taken: every tick while it measures continuously, or one.

    Ticks come at even intervals that nobody can shift, each a little early or late. They are computed when asked for.

    Parameters
    ----------
    period_ns
        From tick to tick.
    jitter_ns
        One sigma of what a tick is early or late.
    phase_ns
        True time of one of them without jitter.
    generator
        Source of all randomness.
    """

    def __init__(
        self, period_ns: int, jitter_ns: float, phase_ns: int, generator: np.random.Generator
    ) -> None:
        self._period_ns = period_ns
        self._phase_ns = phase_ns
        limit_ns = 0.4 * period_ns  # ticks keep their order
        drawn = generator.normal(0.0, jitter_ns, _JITTERS).clip(-limit_ns, limit_ns)
        self._jitters_ns: list[int] = [round(jitter) for jitter in drawn.tolist()]
        self._from_ns: int | None = None
        self._to_ns: int | None = None
        self._shot_ns: int | None = None

    @property
    def running(self) -> bool:
        """Whether it measures continuously, or a single measurement has been made or is under way."""
        return (self._from_ns is not None and self._to_ns is None) or self._shot_ns is not None

    @property
    def holds(self) -> bool:
        """Whether anything was measured that has not been cleared."""
        return self._from_ns is not None or self._shot_ns is not None

    def start(self, now_ns: int) -> None:
        """Measure continuously from now on; a measurement that runs goes on."""
        if self._from_ns is None or self._to_ns is not None:
            self.clear()
            self._from_ns = now_ns + START_NS

    def shoot(self, done_ns: int) -> None:
        """Take one distance, at that time."""
        self.clear()
        self._shot_ns = done_ns

    def stop(self, now_ns: int) -> None:
        """Measure no longer; what was measured last stays."""
        if self._shot_ns is not None and self._shot_ns > now_ns:
            self._shot_ns = None
        if self._from_ns is not None and self._to_ns is None:
            self._to_ns = now_ns

    def clear(self) -> None:
        """Measure no longer, and forget what was measured."""
        self._from_ns = self._to_ns = self._shot_ns = None

    def newest(self, now_ns: int) -> int | None:
        """Return when the newest distance was taken, or tried to be; None: there is none."""
        if self._shot_ns is not None:
            return self._shot_ns if self._shot_ns <= now_ns else None
        if self._from_ns is None:
            return None
        if self._to_ns is not None:
            now_ns = min(now_ns, self._to_ns)
        number = (now_ns - self._phase_ns) // self._period_ns + 1
        while self._tick(number) > now_ns:
            number -= 1
        tick_ns = self._tick(number)
        return tick_ns if tick_ns >= self._from_ns else None

    def next_after(self, now_ns: int) -> int | None:
        """Return when the next distance is taken after an instant; None: not at all."""
        if self._shot_ns is not None:
            return self._shot_ns if self._shot_ns > now_ns else None
        if self._from_ns is None or self._to_ns is not None:
            return None
        after_ns = max(now_ns, self._from_ns - 1)
        number = (after_ns - self._phase_ns) // self._period_ns - 1
        while self._tick(number) <= after_ns:
            number += 1
        return self._tick(number)

    def _tick(self, number: int) -> int:
        return self._phase_ns + number * self._period_ns + self._jitters_ns[number % _JITTERS]


def atmospheric_ppm(temperature_c: float, pressure_hpa: float) -> float:
    """Return the correction of distances for the air, in 1e-6, at 60 % relative humidity.

    Parameters
    ----------
    temperature_c
        In degrees Celsius.
    pressure_hpa
        In hPa, not reduced to sea level.

    Notes
    -----
    The infrared distance meter of the TPS1200, by its manual; zero at 12 degrees and 1013.25 hPa.
    """
    alpha = 1.0 + temperature_c / 273.15
    vapour = 7.5 * temperature_c / (237.3 + temperature_c) + 0.7857
    return 283.05 - (0.29196 * pressure_hpa / alpha - 4.126e-4 * 60.0 / alpha * math.pow(10.0, vapour))


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
