"""Elements of figures: time axis, thinned curves, bands, dots, logarithmic axes, shaded intervals, legends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures.style import PAGE_WIDTH_MM, STROKES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from tsgt.analysis.figures.style import Stroke
    from tsgt.geometry import FloatArray

PANEL_HEIGHT_MM = 26.0

BUCKETS = 1500  # About the number of dots across a page at 200 dpi
HATCHES = ("", "///", "...", "xxx", "\\\\\\", "+++")  # Distinguishable in greyscale


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """Time axis from the first measurement (``origin_ns``), in a unit (``unit_s``) that keeps the numbers small."""

    origin_ns: int
    unit_s: float
    label: str

    @classmethod
    def over(cls, start_ns: int, end_ns: int) -> TimeAxis:
        """Choose the unit for a recording."""
        span_s = (end_ns - start_ns) / 1e9
        unit_s, name = (1.0, "s") if span_s <= 300 else (60.0, "min") if span_s <= 4 * 3600 else (3600.0, "h")
        return cls(start_ns, unit_s, f"time from the first measurement ({name})")

    def of(self, stamp_ns: NDArray[np.int64] | int) -> FloatArray:
        """Convert Unix times to positions on the axis."""
        return np.asarray((np.asarray(stamp_ns, dtype=np.int64) - self.origin_ns) / (1e9 * self.unit_s))


def stroke(row: int) -> Stroke:
    """Return the style of the curve with this number."""
    return STROKES[row % len(STROKES)]


def hatch(row: int) -> str:
    """Return the hatching of the area with this number."""
    return HATCHES[row % len(HATCHES)]


def thinned(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Reduce a long curve, (N,), to minimum and maximum of each segment; NaN in ``y`` leaves a gap."""
    size = len(x) // BUCKETS
    if size < 4:
        return x, y
    n = len(x) // size
    segments = y[: n * size].reshape(n, size)
    blank = np.isnan(segments).all(axis=1)
    low = np.where(blank, 0, np.argmin(np.where(np.isnan(segments), np.inf, segments), axis=1))
    high = np.where(blank, 0, np.argmax(np.where(np.isnan(segments), -np.inf, segments), axis=1))
    ends = np.sort(np.stack([low, high], axis=1), axis=1) + size * np.arange(n)[:, None]
    rows = np.concatenate([ends.ravel(), np.arange(n * size, len(x))])
    return x[rows], y[rows]


def curve(
    panel: Axes, x: FloatArray, y: FloatArray, row: int, *, label: str | None, dashes: bool = True
) -> None:
    """Draw a long curve in the style of this number; without dashes if it is too ragged to show them."""
    look = stroke(row)
    panel.plot(
        *thinned(x, y),
        color=look.color,
        linestyle=look.linestyle if dashes else "-",
        linewidth=0.9,
        label=label,
    )


def envelope(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Reduce a long curve, (N,), to the maximum of each segment; NaN where a segment has no value."""
    size = -(-len(x) // BUCKETS) if len(x) else 1
    if size == 1:
        return x, y
    filled = np.full(-(-len(x) // size) * size, np.nan)
    filled[: len(y)] = y
    segments = filled.reshape(-1, size)
    blank = np.isnan(segments).all(axis=1)
    most = np.max(np.where(np.isnan(segments), -np.inf, segments), axis=1)
    middle = x[np.minimum(np.arange(len(segments)) * size + size // 2, len(x) - 1)]
    return middle, np.where(blank, np.nan, most)


def plain_log(axis: Axis) -> None:
    """Make an axis logarithmic, with plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter  # noqa: PLC0415 (an extra)

    name = "x" if axis is axis.axes.xaxis else "y"
    axis.axes.set(**{f"{name}scale": "log"})
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def shade(panel: Axes, spans: Sequence[tuple[float, float]], label: str) -> None:
    """Shade intervals of the time axis."""
    if spans:
        # One object: an hour has hundreds of intervals.
        panel.broken_barh(
            [(start, end - start) for start, end in spans],
            (0.0, 1.0),
            transform=panel.get_xaxis_transform(),
            color="#e6e6e6",
            linewidth=0,
            zorder=0,
            label=label,
        )


def dots(panel: Axes, x: FloatArray, y: FloatArray, row: int, *, label: str | None = None) -> None:
    """Draw many points in the style of this number, rasterised so that a PDF stays small."""
    look = stroke(row)
    panel.plot(
        x,
        y,
        linestyle="none",
        marker=look.marker,
        markersize=2.0 if len(x) < 3000 else 1.0,
        markeredgewidth=0,
        color=look.color,
        label=label,
        rasterized=True,
    )


def note(panel: Axes, text: str, *, x: float = 0.5) -> None:
    """Write a text in the middle of an empty panel."""
    panel.text(x, 0.5, text, transform=panel.transAxes, ha="center", va="center")


def panels_height_mm(rows: int) -> float:
    """Return the height of a figure with ``rows`` panels below each other."""
    return 18.0 + PANEL_HEIGHT_MM * rows


def legend_above(figure: Figure, axes: Sequence[Axes]) -> None:
    """Draw one legend for all panels; each label appears once."""
    handles: dict[str, Artist] = {}
    for panel in axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(str(label), handle)
    if handles:
        columns = min(len(handles), 2 if narrow(figure) else 6)
        figure.legend(list(handles.values()), list(handles), loc="outside upper center", ncols=columns)


def narrow(figure: Figure) -> bool:
    """Return whether a figure is as wide as a column of text, not as a page."""
    return figure.get_figwidth() * 25.4 < 0.7 * PAGE_WIDTH_MM
