"""Figure of ``tsgt analyse gnss``: errors over time and their distribution, satellites, quality."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.analysis.figures.style import PAGE_WIDTH_MM, STROKES, drawing, save
from tsgt.analysis.formats import QUALITIES
from tsgt.analysis.gnss import QUALITY_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from tsgt.analysis.figures.style import Stroke
    from tsgt.analysis.gnss import DistanceSeries, Receiver

_SMALLEST_MM = 0.1  # Lower limit of the logarithmic axis; smaller errors are drawn here
_LARGEST_AT_LEAST_MM = 10.0
_BINS_PER_DECADE = 12
_POINTS_PER_BIN = 10
_MAX_BINS = 200


class _Series(NamedTuple):
    """Errors of one pair over time."""

    label: str
    times_ns: NDArray[np.int64]
    errors_mm: NDArray[np.float64]


def draw_gnss(
    receivers: Sequence[Receiver],
    gnss: Sequence[DistanceSeries],
    prisms: Sequence[DistanceSeries],
    path: Path,
) -> None:
    """Draw median and 90 % band of the errors of distances between receivers, and between prisms if any, over their time.

    Raises MissingExtraError if matplotlib is not installed, OutputFileError if the file cannot be written.
    """
    series = [_series(f"receivers {pair.name}", [pair]) for pair in gnss if len(pair.times_ns)]
    if prisms:
        series.append(_series("prisms, all pairs", prisms))
    times_ns = np.concatenate([each.times_ns for each in series])
    start_ns, end_ns = int(times_ns.min()), int(times_ns.max())
    largest_mm = max(float(each.errors_mm.max()) for each in series)
    decades = np.log10(max(1.3 * largest_mm, _LARGEST_AT_LEAST_MM) / _SMALLEST_MM)
    bins = _SMALLEST_MM * np.logspace(0, decades, round(_BINS_PER_DECADE * decades) + 1)
    with drawing(width_mm=PAGE_WIDTH_MM, height_mm=115) as figure:
        grid = figure.add_gridspec(3, 2, width_ratios=(3, 1), height_ratios=(4, 1.3, 1.3))
        errors = figure.add_subplot(grid[0, 0])
        shares = figure.add_subplot(grid[0, 1], sharey=errors)
        satellites = figure.add_subplot(grid[1, 0], sharex=errors)
        quality = figure.add_subplot(grid[2, 0], sharex=errors)
        # The prisms' stroke differs from those of the receivers below.
        strokes = _strokes(max(len(series), len(receivers) + 1))
        chosen = [*strokes[: len(series) - 1], strokes[-1] if prisms else strokes[len(series) - 1]]
        for each, stroke in zip(series, chosen, strict=True):
            _curve(errors, each.times_ns, each.errors_mm, start_ns, end_ns, stroke)
            counts, _ = np.histogram(each.errors_mm, bins)
            shares.stairs(
                100 * counts / len(each.errors_mm),
                bins,
                orientation="horizontal",
                color=stroke.color,
                linestyle=stroke.linestyle,
                label=each.label,
            )
        errors.set(yscale="log", ylabel="|distance - reference| (mm)", ylim=(bins[0], bins[-1]))
        errors.yaxis.set_major_formatter("{x:g}")
        errors.yaxis.set_minor_formatter("")
        shares.set(xlabel="share of distances (%)", xlim=(0, None))
        shares.tick_params(labelleft=False)
        for number, (receiver, stroke) in enumerate(zip(receivers, _strokes(len(receivers)), strict=True)):
            inside = (receiver.times_ns >= start_ns) & (receiver.times_ns <= end_ns)
            seen_ns, counts = receiver.times_ns[inside], receiver.satellites[inside]
            _curve(satellites, seen_ns, counts, start_ns, end_ns, stroke, label=receiver.name)
            shift = 0.2 * ((len(receivers) - 1) / 2 - number)
            rows = _rows(receivers)[receiver.quality[inside]] + shift
            quality.plot((seen_ns - start_ns) / 1e9, rows, color=stroke.color, marker="|", ms=2, ls="none")
        satellites.set(ylabel="satellites", ylim=(0, 1.1 * satellites.get_ylim()[1]))
        names = [QUALITIES[q] for q in _seen(receivers)]
        quality.set(
            xlabel="time from the first distance (s)",
            ylim=(-0.6, len(names) - 0.4),
            xlim=(0, max((end_ns - start_ns) / 1e9, 0.1)),
        )
        quality.set_yticks(range(len(names)), names)
        for axes in (errors, satellites):
            axes.tick_params(labelbottom=False)
        key = figure.add_subplot(grid[1:, 1])
        key.axis("off")
        drawn, labels = shares.get_legend_handles_labels()
        key.add_artist(
            key.legend(drawn, labels, loc="upper left", title="distances between", alignment="left")
        )
        drawn, labels = satellites.get_legend_handles_labels()
        key.legend(drawn, labels, loc="lower left", title="receivers", alignment="left")
        save(figure, path)


def _series(label: str, pairs: Sequence[DistanceSeries]) -> _Series:
    errors_mm = 1e3 * np.concatenate([pair.errors_m for pair in pairs])
    times_ns = np.concatenate([pair.times_ns for pair in pairs])
    return _Series(label, times_ns, np.maximum(errors_mm, _SMALLEST_MM))


def _strokes(count: int) -> list[Stroke]:
    return [STROKES[i % len(STROKES)] for i in range(count)]


def _curve(
    axes: Axes,
    times_ns: NDArray[np.int64],
    values: NDArray[np.float64] | NDArray[np.int64],
    start_ns: int,
    end_ns: int,
    stroke: Stroke,
    *,
    label: str | None = None,
) -> None:
    """Draw median and 90 % band per time bin; thousands of points would hide each other."""
    pieces = int(np.clip(len(values) // _POINTS_PER_BIN, 1, _MAX_BINS))
    edges_s = np.linspace(0, (end_ns - start_ns) / 1e9, pieces + 1)
    piece = np.clip(np.searchsorted(edges_s, (times_ns - start_ns) / 1e9, side="right") - 1, 0, pieces - 1)
    low, middle, high = (np.full(pieces, np.nan) for _ in range(3))
    for i in np.unique(piece):
        low[i], middle[i], high[i] = np.percentile(values[piece == i], [5, 50, 95])
    # A bin without values is a gap. Steps show a single bin between two gaps, a curve would not.
    axes.stairs(middle, edges_s, baseline=None, color=stroke.color, linestyle=stroke.linestyle, label=label)
    axes.stairs(high, edges_s, baseline=low, fill=True, color=stroke.color, alpha=0.25, linewidth=0)


def _seen(receivers: Sequence[Receiver]) -> list[int]:
    """Return the qualities that occur, worst first."""
    return [
        q for q in reversed(QUALITY_ORDER) if any(np.any(receiver.quality == q) for receiver in receivers)
    ]


def _rows(receivers: Sequence[Receiver]) -> NDArray[np.float64]:
    """Return the height of each quality, by its number."""
    rows = np.full(len(QUALITIES), np.nan)
    for height, q in enumerate(_seen(receivers)):
        rows[q] = height
    return rows
