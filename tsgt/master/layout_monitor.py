"""The live alarm for a frame that no longer holds: a tripod has moved, a prism has slipped on the robot.

Pure: poses and instants come in, events go out. The sign is that the prisms miss their layout, by more than noise and
interpolation explain, and for long. One pose says little: a moving robot is measured at different instants and
interpolated between them, which bends the triangle of prisms now and then. A frame that is off bends it always. So
three of four poses over some seconds have to miss by more than allowed, and a fast robot is allowed more.

What does not bend the triangle of prisms cannot be seen: with three prisms a movement across their plane, and any
number of stations that moved as one. docs/how-to/calibrate.md has the figures.
"""

from __future__ import annotations

import bisect
import math
import statistics
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from tsgt.recording import EventRecord

if TYPE_CHECKING:
    from tsgt.recording import PoseRecord

QUARTILE = 4
"""The alarm looks at what three of four poses miss their limit by. Interpolation brings the median of a good frame to
1.1 times the limit at 1.45 Hz per station, and this no higher than 0.7 (``benchmarks/frame_watch.py``)."""

RESTORED = 0.8
"""Share of the limit below which the alarm ends; the same limit for both would let it flicker."""

WINDOW_FILLED = 1 / 3
"""Share of the window that has to hold poses before it is judged."""


class WatchSettings(Protocol):
    """What the alarm needs to know: ``tsgt.config.FrameWatchConfig`` in its units, which this core may not import."""

    @property
    def residual_mm(self) -> float:
        """By how much the prisms of a robot that stands still may miss their layout, root mean square."""

    @property
    def residual_speed_gain_ms(self) -> float:
        """Times the robot's speed: how much more they may miss it by while it moves; mm per m/s."""

    @property
    def window_s(self) -> float:
        """Three of four poses over this time have to miss it by more."""


@dataclass(frozen=True, slots=True)
class _Sample:
    """What one pose says."""

    stamp_ns: int
    residual_mm: float
    limit_mm: float
    by_station_mm: dict[int, float]

    @property
    def ratio(self) -> float:
        """By how many times what is allowed the prisms miss their layout."""
        return self.residual_mm / self.limit_mm


class FrameWatch:
    """Watches how well the prisms fit their layout.

    Parameters
    ----------
    settings
        Limits.
    period_ns
        Step of the poses in ns; tells how many a full window holds.
    """

    def __init__(self, settings: WatchSettings, period_ns: int) -> None:
        self._settings = settings
        self._window_ns = round(settings.window_s * 1e9)
        self._fewest = max(1, math.ceil(WINDOW_FILLED * self._window_ns / period_ns))
        self._samples: deque[_Sample] = deque()
        self._ratios: list[float] = []  # theirs, in the order of size
        self._suspect = False

    def pose(self, record: PoseRecord, now_ns: int) -> list[EventRecord]:
        """Take a pose that came out at ``now_ns``; return ``layout_residual_high`` or ``frame_restored`` where it is so.

        Poses that are not valid for another reason than their residual say nothing of the frames. It is made for the
        estimator ``linear``: the other one bends its trajectory until the prisms fit.
        """
        if record.residual_m is None or record.velocity_mps is None or record.reason not in ("", "residual"):
            return []
        limit_mm = self._settings.residual_mm + self._settings.residual_speed_gain_ms * math.hypot(
            *record.velocity_mps
        )
        shares = {
            share.id: 1e3 * share.residual_m for share in record.stations if share.residual_m is not None
        }
        sample = _Sample(record.stamp_ns, 1e3 * record.residual_m, limit_mm, shares)
        self._samples.append(sample)
        bisect.insort(self._ratios, sample.ratio)
        while self._samples[0].stamp_ns <= record.stamp_ns - self._window_ns:
            del self._ratios[bisect.bisect_left(self._ratios, self._samples.popleft().ratio)]
        if len(self._samples) < self._fewest:
            return []
        ratio = self._ratios[len(self._ratios) // QUARTILE]
        if ratio > 1.0 and not self._suspect:
            self._suspect = True
            return [self._alarm(now_ns)]
        if ratio < RESTORED and self._suspect:
            self._suspect = False
            message = f"{self._figures()}; the frames hold again"
            return [EventRecord(stamp_ns=now_ns, event="frame_restored", message=message)]
        return []

    def _alarm(self, now_ns: int) -> EventRecord:
        totals_mm: dict[int, float] = {}
        for sample in self._samples:
            for station, residual_mm in sample.by_station_mm.items():
                totals_mm[station] = totals_mm.get(station, 0.0) + residual_mm
        likeliest = max(totals_mm, key=lambda station: totals_mm[station], default=None)
        blind = "; a movement across the plane of three prisms would not show" if len(totals_mm) <= 3 else ""
        message = (
            f"{self._figures()}: a tripod or a prism has moved, likeliest that of station {likeliest}; "
            f"check with tsgt calibrate check{blind}"
        )
        return EventRecord(stamp_ns=now_ns, event="layout_residual_high", message=message, station=likeliest)

    def _figures(self) -> str:
        residual_mm = statistics.median(sample.residual_mm for sample in self._samples)
        limit_mm = statistics.median(sample.limit_mm for sample in self._samples)
        return (
            f"the prisms miss their layout by {residual_mm:.1f} mm, allowed are {limit_mm:.1f} mm "
            f"(medians over {self._settings.window_s:g} s)"
        )
