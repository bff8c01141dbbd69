"""TODO face."""

from tsgt.analysis.figures.axes import Clock, hatch, stroke
from tsgt.analysis.figures.gnss import draw_gnss
from tsgt.analysis.figures.layout import draw_layouts
from tsgt.analysis.figures.perturbation import draw_perturbation
from tsgt.analysis.figures.stations import panels_height_mm
from tsgt.analysis.figures.style import FORMATS, PAGE_MM, drawing, save

__all__ = [
    "FORMATS",
    "PAGE_MM",
    "Clock",
    "draw_gnss",
    "draw_layouts",
    "draw_perturbation",
    "drawing",
    "hatch",
    "panels_height_mm",
    "save",
    "stroke",
]
