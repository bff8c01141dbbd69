"""matplotlib figures: common style, time axis and curves, and the figures of ``tsgt analyse``.

Comes in: arrays and statistics of other rooms. Goes out: PNG, PDF or SVG files. The figures of a report are in the room
``report``. matplotlib is an extra and imported when a figure is made.
"""

from tsgt.analysis.figures.axes import (
    TimeAxis,
    curve,
    dots,
    envelope,
    hatch,
    legend_above,
    narrow,
    note,
    panels_height_mm,
    plain_log,
    shade,
    stroke,
)
from tsgt.analysis.figures.design import draw_layouts, draw_perturbation
from tsgt.analysis.figures.gnss import draw_gnss
from tsgt.analysis.figures.style import FORMATS, PAGE_WIDTH_MM, drawing, palette_png, png_bytes, save

__all__ = [
    "FORMATS",
    "PAGE_WIDTH_MM",
    "TimeAxis",
    "curve",
    "dots",
    "draw_gnss",
    "draw_layouts",
    "draw_perturbation",
    "drawing",
    "envelope",
    "hatch",
    "legend_above",
    "narrow",
    "note",
    "palette_png",
    "panels_height_mm",
    "plain_log",
    "png_bytes",
    "save",
    "shade",
    "stroke",
]
