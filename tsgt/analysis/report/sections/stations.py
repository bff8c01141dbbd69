"""Report sections on the stations with their radio, and on their clocks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.figures import panels_height_mm
from tsgt.analysis.report.figures import stations as draw
from tsgt.analysis.report.page import UNKNOWN, ReportFigure, Section, Table, format_number, nan_median

if TYPE_CHECKING:
    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.report.findings import Findings


def station_section(f: Findings, axis: TimeAxis) -> Section:
    """Return what each station measured and how its radio was received."""
    outage_limit_s = f.recording.parameters.pipeline.outage_limit_ns / 1e9
    columns: dict[str, list[str]] = {
        name: [] for name in (
            "station", "prisms", "measured", "usable", "per second", "longest gap (s)",
            f"gaps over {outage_limit_s:g} s (of the time)", "distance (m)", "delay median / 95 % (s)",
            "signal RSSI (dBm)", "signal to noise (dB)", "radio loss (%)",
        )
    }  # fmt: skip
    for record in f.station_records:
        each = f.station_statistics[record.station]
        series = f.log.radio.get(record.station)
        cells = (
            str(record.station),
            ", ".join(map(str, record.prisms)) or "none",
            str(each.measurements),
            str(each.usable),
            format_number(each.rate_hz, 2),
            format_number(each.longest_gap_s, 2),
            f"{each.gaps} ({each.in_gaps:.1%})",
            _pair(each.distance_min_m, " to ", each.distance_max_m, 0),
            _pair(each.delay_median_s, " / ", each.delay_p95_s, 2),
            format_number(nan_median(None if series is None else series.rssi_dbm), 0),
            format_number(nan_median(None if series is None else series.snr_db), 1),
            format_number(nan_median(None if series is None else 100 * series.loss), 1),
        )
        for column, cell in zip(columns.values(), cells, strict=True):
            column.append(cell)
    unknown = [name for name, cells in columns.items() if all(cell == UNKNOWN for cell in cells)]
    shown = {name: cells for name, cells in columns.items() if name not in unknown}
    text = [f"Unknown, because it was not recorded: {', '.join(unknown)}."] if unknown else []
    caption = "Measurements of the stations; median of the radio's figures; delay from a measurement to its arrival at the master"
    table = Table(caption, tuple(shown), tuple(zip(*shown.values(), strict=True)))
    n = len(f.station_records)
    plots = [
        ReportFigure(
            "gaps",
            "Gaps between the measurements of each station",
            "Each point is a usable measurement; its height is the time since the previous one. Points in one line near the "
            "bottom are good; gaps above the dotted line make poses invalid. Crosses: measurements that the instrument could "
            "not make. Diamonds: the station began later, or ended earlier, than the others.",
            panels_height_mm(n),
            lambda figure: draw.draw_gaps(figure, f.station_records, axis, outage_limit_s, f.end_ns),
        )
    ]
    if any(len(s.statuses) > 1 for s in f.station_records):
        plots.append(
            ReportFigure(
                "statuses",
                "What the instruments reported about their measurements",
                "`low_accuracy` is normal while the robot moves.",
                24.0 + 9.0 * n,
                lambda figure: draw.draw_statuses(figure, f.station_records),
            )
        )
    radio = {k: v for k, v in f.log.radio.items() if np.isfinite(v.rssi_dbm).any()}
    if radio:
        plots.append(
            ReportFigure(
                "radio",
                "Radio reception of each station",
                "Strength of the signal (RSSI), ratio of signal to noise (SNR), and lost requests. Losses at a low ratio indicate "
                "distance or antennas, losses at a high one collisions or an overloaded computer.",
                panels_height_mm(3),
                lambda figure: draw.draw_radio(figure, radio, axis),
            )
        )
    return Section("Stations and radio", tuple(text), (table,), tuple(plots))


def _pair(first: float, sign: str, second: float, digits: int) -> str:
    """Format two numbers that are known together."""
    return f"{first:.{digits}f}{sign}{second:.{digits}f}" if math.isfinite(first + second) else UNKNOWN


def clock_section(f: Findings, axis: TimeAxis) -> Section:
    """Return the bounds of the measurements' times, and the synchronisations of the protocol ``classic``."""
    bounded = any(np.isfinite(s.bound_ns).any() for s in f.station_records)
    if not bounded and not f.log.clocks:
        return Section(
            "Clocks of the stations",
            ("Unknown: the recording contains neither synchronisations nor bounds of the time errors.",),
        )
    text = []
    if not f.log.clocks:
        text.append(
            "No synchronisations were recorded. The protocol superframe has none: times of measurements are relative to the "
            "master's beacons, and the bounds below include that."
        )
    caption = (
        "Top, if recorded: offset of the station's clock from the master's (positive: station ahead), with its bound. "
        "Below: bound of the time error of each measurement. At 1 m/s, a millisecond moves a prism by a millimetre."
    )
    rows = bool(f.log.clocks) + sum(bool(np.isfinite(s.bound_ns).any()) for s in f.station_records)
    plot = ReportFigure(
        "clocks",
        "Time errors of the measurements",
        caption,
        panels_height_mm(rows) + 8 * rows,
        lambda figure: draw.draw_clocks(figure, f.log.clocks, f.station_records, axis),
    )
    return Section("Clocks of the stations", tuple(text), plots=(plot,))
