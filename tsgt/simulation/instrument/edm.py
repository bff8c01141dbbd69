"""Electronic distance measurement: when distances are measured, their noise, and the atmospheric correction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.geometry import cartesian_to_polar

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.model import InstrumentNoise

CONTINUOUS_MODES: Final = frozenset({6, 7, 8, 9})
"""EDM modes that measure until stopped."""

NON_PRISM_MODES: Final = frozenset({1, 5, 8, 12, 14})
"""EDM modes for reflector tape and reflectorless measurement; the others need a prism."""

START_NS: Final = 200_000_000
"""From the command to the earliest first distance; an assumption."""

SINGLE_MEASUREMENT_S: Final = (1.0, 2.0)
"""Minimum and maximum duration of a single measurement: 1.2 s in the data sheet of a Trimble S7."""

RANGE_M: Final = (1.0, 1000.0)
"""Measuring range."""

_JITTER_COUNT: Final = 1024


class EdmSchedule:
    """Times of distance measurements: evenly spaced with jitter in continuous mode, or a single one. Computed on request.

    The jitter (one sigma) is limited to 40 % of the period.
    """

    def __init__(
        self, period_ns: int, jitter_ns: float, phase_ns: int, generator: np.random.Generator
    ) -> None:
        self._usual_period_ns = self._period_ns = period_ns
        self._phase_ns = phase_ns
        limit_ns = 0.4 * period_ns  # keeps the measurements in order
        drawn = generator.normal(0.0, jitter_ns, _JITTER_COUNT).clip(-limit_ns, limit_ns)
        self._jitter_ns: list[int] = [round(jitter) for jitter in drawn.tolist()]
        self._from_ns: int | None = None
        self._to_ns: int | None = None
        self._single_ns: int | None = None

    @property
    def running(self) -> bool:
        """Whether it measures continuously, or a single measurement was started and not cleared."""
        return (self._from_ns is not None and self._to_ns is None) or self._single_ns is not None

    @property
    def has_measurement(self) -> bool:
        """Whether a measurement was started and not cleared."""
        return self._from_ns is not None or self._single_ns is not None

    def start(self, now_ns: int) -> None:
        """Start continuous measurement; no effect while it runs."""
        if self._from_ns is None or self._to_ns is not None:
            self.clear()
            self._from_ns = now_ns + START_NS

    def start_single(self, done_ns: int) -> None:
        """Take one distance at ``done_ns``."""
        self.clear()
        self._single_ns = done_ns

    @property
    def slowed_by(self) -> float:
        """Interval of continuous measurements as a multiple of the usual one."""
        return self._period_ns / self._usual_period_ns

    def slow_down(self, factor: float, now_ns: int) -> None:
        """Measure at this multiple of the usual interval from the newest instant on; 1: as usual."""
        number = self._newest_number(now_ns)
        period_ns = round(factor * self._usual_period_ns)
        self._phase_ns += number * (self._period_ns - period_ns)
        self._period_ns = period_ns

    def stop(self, now_ns: int) -> None:
        """Stop measuring; the last measurement stays."""
        if self._single_ns is not None and self._single_ns > now_ns:
            self._single_ns = None
        if self._from_ns is not None and self._to_ns is None:
            self._to_ns = now_ns

    def clear(self) -> None:
        """Stop measuring and clear the last measurement."""
        self._from_ns = self._to_ns = self._single_ns = None

    def newest(self, now_ns: int) -> int | None:
        """Return the time of the newest measurement, successful or not; None: there is none."""
        if self._single_ns is not None:
            return self._single_ns if self._single_ns <= now_ns else None
        if self._from_ns is None:
            return None
        if self._to_ns is not None:
            now_ns = min(now_ns, self._to_ns)
        tick_ns = self._tick(self._newest_number(now_ns))
        return tick_ns if tick_ns >= self._from_ns else None

    def next_after(self, now_ns: int) -> int | None:
        """Return the time of the next measurement after an instant; None: there is none."""
        if self._single_ns is not None:
            return self._single_ns if self._single_ns > now_ns else None
        if self._from_ns is None or self._to_ns is not None:
            return None
        after_ns = max(now_ns, self._from_ns - 1)
        number = (after_ns - self._phase_ns) // self._period_ns - 1
        while self._tick(number) <= after_ns:
            number += 1
        return self._tick(number)

    def _newest_number(self, now_ns: int) -> int:
        number = (now_ns - self._phase_ns) // self._period_ns + 1
        while self._tick(number) > now_ns:
            number -= 1
        return number

    def _tick(self, number: int) -> int:
        return self._phase_ns + number * self._period_ns + self._jitter_ns[number % _JITTER_COUNT]


def atmospheric_ppm(temperature_c: float, pressure_hpa: float) -> float:
    """Return the atmospheric correction of distances in 1e-6, at 60 % relative humidity.

    Infrared EDM of the TPS1200, by its manual; zero at 12 degrees Celsius and 1013.25 hPa (not reduced to sea level).
    """
    alpha = 1.0 + temperature_c / 273.15
    vapour = 7.5 * temperature_c / (237.3 + temperature_c) + 0.7857
    return 283.05 - (0.29196 * pressure_hpa / alpha - 4.126e-4 * 60.0 / alpha * math.pow(10.0, vapour))


def measure_polar(
    points: NDArray[np.float64], noise: InstrumentNoise, generator: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return noisy polar measurements of points (N, 3), in m in the frame of the station.

    Returns
    -------
    tuple
        Horizontal angle from 0 to 2 pi and zenith angle in rad, distance to the point in m; each (N,). Noise is white.
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
