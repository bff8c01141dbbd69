"""Live alarm for a layout that no longer fits: a tripod has moved, or a prism has slipped on the robot. Sans-I/O.

A wrong frame distorts the prisms' triangle always, interpolation of a moving robot's only now and then. So three of four
poses over some seconds have to exceed the limit, which grows with speed. Unobservable: with three prisms a movement across
their plane, and stations that moved as one. docs/how-to/calibrate.md has the figures.
"""

from __future__ import annotations

import bisect
import math
import statistics
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.master.publisher import Observer
from tsgt.model import MIN_PRISMS
from tsgt.recording import EventRecord

if TYPE_CHECKING:
    from tsgt.config import FrameWatchConfig
    from tsgt.recording import PoseRecord

QUARTILE = 4
"""The alarm uses the lower quartile of residual over limit. Interpolation brings the median of a good frame to 1.1 at
1.45 Hz per station, and the lower quartile no higher than 0.7 (``benchmarks/run.py frame_watch``)."""

RESTORED_RATIO = 0.8  # share of the limit below which the alarm ends; hysteresis

MIN_WINDOW_SHARE = 1 / 3  # as many poses as in this share of the window are judged, at least
MAX_WINDOWS = 12  # over which they are collected if poses have gaps


@dataclass(frozen=True, slots=True)
class _Sample:
    """Residual and limit of one pose."""

    stamp_ns: int
    residual_mm: float
    limit_mm: float
    by_station_mm: dict[int, float]

    @property
    def ratio(self) -> float:
        """Residual over limit."""
        return self.residual_mm / self.limit_mm


class LayoutMonitor(Observer):
    """Monitors the residuals of the prisms against their layout. ``period_ns``: interval of the poses in ns."""

    def __init__(self, settings: FrameWatchConfig, period_ns: int) -> None:
        self._settings = settings
        self._window_ns = round(settings.window_s * 1e9)
        self._min_samples = max(1, math.ceil(MIN_WINDOW_SHARE * self._window_ns / period_ns))
        self._samples: deque[_Sample] = deque()
        self._ratios: list[float] = []  # sorted
        self._alarmed = False

    def pose(self, record: PoseRecord, now_ns: int) -> list[EventRecord]:
        """Take a pose that was published at ``now_ns``; return ``layout_residual_high`` or ``layout_residual_normal`` on a change.

        Poses of the estimator ``linear`` only: ``continuous`` distorts its trajectory to fit the prisms, unless an IMU
        prevents it. Poses that are invalid for another reason than their residual are ignored.
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
        while self._is_past(record.stamp_ns - self._samples[0].stamp_ns):
            del self._ratios[bisect.bisect_left(self._ratios, self._samples.popleft().ratio)]
        if len(self._samples) < self._min_samples:
            return []
        ratio = self._ratios[len(self._ratios) // QUARTILE]
        if ratio > 1.0 and not self._alarmed:
            self._alarmed = True
            return [self._alarm(now_ns)]
        if ratio < RESTORED_RATIO and self._alarmed:
            self._alarmed = False
            message = f"{self._figures()}; the layout fits again"
            return [EventRecord(stamp_ns=now_ns, event="layout_residual_normal", message=message)]
        return []

    def _is_past(self, age_ns: int) -> bool:
        """Whether the oldest pose counts no longer."""
        scarce = len(self._samples) <= self._min_samples
        return age_ns >= self._window_ns * (MAX_WINDOWS if scarce else 1)

    def _alarm(self, now_ns: int) -> EventRecord:
        totals_mm: dict[int, float] = {}
        for sample in self._samples:
            for station, residual_mm in sample.by_station_mm.items():
                totals_mm[station] = totals_mm.get(station, 0.0) + residual_mm
        likeliest = max(totals_mm, key=lambda station: totals_mm[station], default=None)
        cause, blind = "a tripod or a prism has moved", ""
        if len(totals_mm) == MIN_PRISMS:
            blind = "; a movement across the plane of three prisms is not observable"
        elif len(totals_mm) < MIN_PRISMS:  # poses with the IMU
            cause, blind = (
                "a tripod, a prism or the IMU has moved",
                "; only what the IMU contradicts is observable",
            )
        message = f"{self._figures()}: {cause}, most likely of station {likeliest}; check with tsgt calibrate check{blind}"
        return EventRecord(stamp_ns=now_ns, event="layout_residual_high", message=message, station=likeliest)

    def _figures(self) -> str:
        residual_mm = statistics.median(sample.residual_mm for sample in self._samples)
        limit_mm = statistics.median(sample.limit_mm for sample in self._samples)
        span_s = (self._samples[-1].stamp_ns - self._samples[0].stamp_ns) / 1e9
        return (
            f"the prisms miss their layout by {residual_mm:.1f} mm, limit {limit_mm:.1f} mm "
            f"(medians over {span_s:.0f} s)"
        )
