"""Report figures: stations, clocks, inter-prism distances."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import (
    curve,
    dots,
    hatch,
    legend_above,
    narrow,
    note,
    plain_log,
    shade,
    stroke,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tsgt.analysis.evaluation import Bins, Grid, InterPrismDistances, PairDistances
    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.report.log import ClockSeries, RadioSeries
    from tsgt.analysis.report.motion import DistanceErrorSeries
    from tsgt.analysis.report.stations import StationRecord


def draw_gaps(
    figure: Figure, stations: Sequence[StationRecord], axis: TimeAxis, outage_limit_s: float, end_ns: int
) -> None:
    """Draw times without usable measurements, also from the first and to the last of any station, and unusable measurements."""
    axes = figure.subplots(len(stations), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for panel, station in zip(axes, stations, strict=True):
        times = station.stamp_ns[station.usable]
        if len(times) > 1:
            dots(panel, axis.of(times[1:]), np.diff(times) / 1e9, 1, label="usable measurement")
        if len(times):
            edges_ns = np.array([times[0], end_ns])
            waits_s = np.array([times[0] - axis.origin_ns, end_ns - times[-1]]) / 1e9
            long = waits_s > outage_limit_s
            if long.any():
                panel.plot(
                    axis.of(edges_ns[long]),
                    waits_s[long],
                    linestyle="none",
                    marker="D",
                    markerfacecolor="white",
                    markeredgecolor="black",
                    label="gap at start or end",
                )
        bad = station.stamp_ns[~station.usable]
        if len(bad):
            # At the bottom of the panel, whatever the scale.
            panel.plot(
                axis.of(bad),
                np.full(len(bad), 0.06),
                transform=panel.get_xaxis_transform(),
                linestyle="none",
                marker="x",
                color=stroke(2).color,
                label="unusable",
            )
        panel.axhline(outage_limit_s, color="black", linewidth=0.8, linestyle=":", label="outage limit")
        plain_log(panel.yaxis)
        panel.set_title(f"station {station.station}", loc="left")
        if not len(station.stamp_ns):
            note(panel, "no measurements")
    low, high = axes[0].get_ylim()
    # The highest mark, a gap, must be clear of the edge.
    axes[0].set_ylim(min(low, 0.15), max(1.4 * high, 3.0))
    figure.supylabel("time since the previous usable measurement (s)", fontsize=8)
    axes[-1].set_xlabel(axis.label)
    legend_above(figure, list(axes))


def draw_radio(figure: Figure, radio: Mapping[int, RadioSeries], axis: TimeAxis) -> None:
    """Draw RSSI, SNR and loss of each station over time."""
    axes = figure.subplots(3, 1, sharex=True)
    for row, (station, series) in enumerate(radio.items()):
        time = axis.of(series.stamp_ns)
        for panel, values in zip(axes, (series.rssi_dbm, series.snr_db, 100 * series.loss), strict=True):
            curve(panel, time, values, row, label=f"station {station}")
    for panel, label in zip(axes, ("RSSI (dBm)", "SNR (dB)", "loss (%)"), strict=True):
        panel.set_ylabel(label)
    # A loss of 0 must be visible as a line.
    top = max(5.0, axes[2].get_ylim()[1])
    axes[2].set_ylim(-0.05 * top, top)
    axes[2].set_xlabel(axis.label)
    legend_above(figure, [axes[0]])


def draw_clocks(
    figure: Figure, clocks: Mapping[int, ClockSeries], stations: Sequence[StationRecord], axis: TimeAxis
) -> None:
    """Draw the clock offsets, if synchronisations were recorded, and the timestamp bounds of all stations."""
    bounded = [s for s in stations if np.isfinite(s.bound_ns).any()]
    panels = figure.subplots(bool(clocks) + len(bounded), 1, sharex=True, squeeze=False)[:, 0]
    places = iter(panels)
    if clocks:
        panel = next(places)
        for row, (station, series) in enumerate(clocks.items()):
            time, look = axis.of(series.stamp_ns), stroke(row)
            # Each restart begins a new curve: a step of the clock would hide the drift.
            segments = np.cumsum(series.restarted)
            for segment in np.unique(segments):
                rows = segments == segment
                panel.errorbar(
                    time[rows],
                    (series.offset_ns[rows] - series.offset_ns[rows][0]) / 1e6,
                    yerr=series.bound_ns[rows] / 1e6,
                    color=look.color,
                    linestyle=look.linestyle,
                    marker=look.marker,
                    capsize=2,
                    linewidth=0.9,
                    label=f"station {station}" if segment == segments[0] else None,
                )
        panel.set_ylabel("offset minus\nthe first (ms)")
    for panel, record in zip(places, bounded, strict=True):
        # As points in separate panels: bounds alternate between the same few values.
        known = np.isfinite(record.bound_ns)
        dots(panel, axis.of(record.stamp_ns[known]), record.bound_ns[known] / 1e6, 1)
        panel.set_ylabel(f"station {record.station}\nbound (ms)")
    if bounded:
        below = panels[bool(clocks) :]
        known = np.concatenate([s.bound_ns[np.isfinite(s.bound_ns)] for s in bounded]) / 1e6
        least, most = float(known.min()), float(known.max())
        # The first bounds, before a clock filter converges, may be a hundred times larger.
        wide = least > 0.0 and most > 5 * least
        for panel in below:
            if wide:
                plain_log(panel.yaxis)
            panel.set_ylim(least / 1.2 if wide else 0.0, max(1.2 * most, 1e-3))
    panels[-1].set_xlabel(axis.label)
    figure.align_ylabels(panels)
    legend_above(figure, list(panels))


def draw_histograms(figure: Figure, found: InterPrismDistances) -> None:
    """Draw the distances of each pair minus those of the layout, stationary above moving."""
    axes = figure.subplots(2, len(found.dynamic), squeeze=False, sharex=True)
    spread = [
        np.percentile(np.abs(pair.distances_m - pair.reference_m), 98)
        for pair in (*found.static, *found.dynamic)
        if len(pair.distances_m)
    ]
    reach_mm = 1.1 * 1e3 * max([*spread, 1e-3])
    for column, (static, dynamic) in enumerate(zip(found.static, found.dynamic, strict=True)):
        for row, (pair, name) in enumerate(((static, "standing still"), (dynamic, "all the time"))):
            _histogram(axes[row, column], pair, reach_mm, row)
            if column == 0:
                axes[row, column].set_ylabel(f"{name}\nshare (%)")
        axes[0, column].set_title(f"prisms {static.name}\nlayout {1e3 * static.reference_m:.1f} mm")
    figure.supxlabel("measured distance minus that of the layout (mm)", fontsize=8)
    legend_above(figure, list(axes.ravel()))


def _histogram(panel: Axes, pair: PairDistances, reach_mm: float, row: int) -> None:
    error_mm = 1e3 * (pair.distances_m - pair.reference_m)
    panel.axvline(0.0, color="black", linewidth=1.2, label="layout")
    if not len(error_mm):
        note(panel, "no\ndistances", x=0.25)
        panel.set_yticks([])
        return
    panel.hist(
        np.clip(error_mm, -reach_mm, reach_mm),
        bins=np.linspace(-reach_mm, reach_mm, 51).tolist(),
        weights=np.full(len(error_mm), 100.0 / len(error_mm)),
        color="#c6dbef" if row == 0 else "#ececec",
        edgecolor="#404040",
        linewidth=0.3,
    )
    panel.axvline(float(error_mm.mean()), color="#D55E00", linestyle="--", linewidth=1.2, label="mean")


def draw_distance_errors(
    figure: Figure, errors: DistanceErrorSeries, stationary_ns: Sequence[tuple[int, int]], axis: TimeAxis
) -> None:
    """Draw the error of each distance over time, and speed and angular rate below; shade stationary intervals."""
    pairs = list(errors.error_m.items())
    axes = figure.subplots(len(pairs) + 2, 1, sharex=True)
    time = axis.of(errors.stamp_ns)
    stationary = [(float(axis.of(a)), float(axis.of(b))) for a, b in stationary_ns]
    known = [1e3 * e[np.isfinite(e)] for _, e in pairs]
    reach = max((float(np.percentile(np.abs(e), 99.8)) for e in known if len(e)), default=1.0)
    for panel, (name, error_m) in zip(axes, pairs, strict=False):
        curve(panel, time, 1e3 * error_m, 1, label=None, dashes=False)
        panel.axhline(0.0, color="black", linewidth=0.8)
        panel.set_ylim(-1.1 * reach, 1.1 * reach)
        panel.set_ylabel(f"{name}\nerror (mm)")
    for panel, values, label in (
        (axes[-2], errors.motion.speed_mps, "speed\n(m/s)"),
        (axes[-1], errors.motion.angular_rate_radps, "angular rate\n(rad/s)"),
    ):
        curve(panel, time, values, 0, label=None, dashes=False)
        panel.set_ylabel(label)
        panel.set_ylim(bottom=0.0)
    for panel in axes:
        shade(panel, stationary, "stationary")
    axes[-1].set_xlabel(axis.label)
    figure.align_ylabels(axes)
    legend_above(figure, axes[:1])


def draw_bins(figure: Figure, bins: Sequence[tuple[str, Bins | None]]) -> None:
    """Draw |error| over each quantity, and the number of errors."""
    axes = figure.subplots(
        2, len(bins), squeeze=False, sharex="col", sharey="row", gridspec_kw={"height_ratios": (3, 1)}
    )
    for column, (label, found) in enumerate(bins):
        above, below = axes[:, column]
        below.set_xlabel(label)
        if found is None or not found.counts.any():  # a logarithmic axis cannot be empty
            note(above, "unknown")
            continue
        middle = (found.edges[1:] + found.edges[:-1]) / 2
        for row, (name, values) in enumerate(
            (("median", found.median), ("mean", found.mean), ("95 %", found.p95))
        ):
            look = stroke(row)
            above.plot(
                middle,
                1e3 * values,
                color=look.color,
                linestyle=look.linestyle,
                marker=look.marker,
                label=name,
            )
        below.bar(
            middle,
            found.counts,
            width=0.9 * np.diff(found.edges),
            color="#c6dbef",
            edgecolor="black",
            linewidth=0.4,
        )
        below.set_yscale("log")
        below.locator_params(axis="x", nbins=4)
    axes[0, 0].set_ylim(bottom=0.0)
    # From 1, so that the heights of bars can be compared; last, since it fixes the upper limit.
    axes[1, 0].set_ylim(bottom=1.0)
    axes[0, 0].set_ylabel("|distance error| (mm)")
    axes[1, 0].set_ylabel("distances")
    legend_above(figure, axes[0])


def draw_grids(figure: Figure, grids: Sequence[tuple[str, str, Grid]]) -> None:
    """Draw the mean |error| over two quantities, as numbers on greyscale-safe colours."""
    axes = figure.subplots(1, len(grids), squeeze=False, sharey=True)[0]
    top = max((1e3 * float(np.nanmax(g.mean)) for _, _, g in grids if np.isfinite(g.mean).any()), default=1.0)
    mesh = None
    for panel, (x_label, _, grid) in zip(axes, grids, strict=True):
        mean_mm = 1e3 * grid.mean
        mesh = panel.pcolormesh(
            grid.x_edges, grid.y_edges, np.ma.masked_invalid(mean_mm), cmap="cividis", vmin=0.0, vmax=top
        )
        panel.grid(visible=False)
        for i, j in () if narrow(figure) else np.argwhere(np.isfinite(mean_mm)):
            panel.text(
                grid.x_edges[j : j + 2].mean(),
                grid.y_edges[i : i + 2].mean(),
                f"{mean_mm[i, j]:.1f}",
                ha="center",
                va="center",
                fontsize=5.5,
                color="white" if mean_mm[i, j] < 0.55 * top else "black",
            )
        panel.set_xlabel(x_label)
    axes[0].set_ylabel(grids[0][1])
    if mesh is not None:
        figure.colorbar(mesh, ax=list(axes), label="mean |distance error| (mm)")


def draw_statuses(figure: Figure, stations: Sequence[StationRecord]) -> None:
    """Draw the share of each status among a station's measurements."""
    panel = figure.subplots()
    names = list(dict.fromkeys(name for s in stations for name in s.statuses))
    left = np.zeros(len(stations))
    totals = np.array([max(1, sum(s.statuses.values())) for s in stations])
    for row, name in enumerate(names):
        share = 100 * np.array([s.statuses.get(name, 0) for s in stations]) / totals
        panel.barh(
            [f"station {s.station}" for s in stations],
            share,
            left=left,
            label=name,
            color=("#c6dbef", "#ffffff", "#fdae6b", "#969696", "#e5c494", "#66c2a5", "#404040")[row % 7],
            hatch=hatch(row),
            edgecolor="black",
            linewidth=0.5,
        )
        left += share
    panel.invert_yaxis()
    panel.set_xlabel("share of its measurements (%)")
    panel.set_xlim(0, 100)
    if names:
        legend_above(figure, [panel])
