"""Figures of the section on the robot's IMU."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from tsgt.analysis.figures import TimeAxis, stroke
from tsgt.analysis.report.sections.imu import _Biases, draw_biases


def test_band_of_a_bias_has_the_colour_of_its_axis() -> None:
    """Each of the three bands is that of its curve, and the legend says what a band is."""
    stamps = np.linspace(0, 4e9, 5, dtype=np.float64)
    figure = Figure()
    draw_biases(figure, _Biases(stamps, np.ones((5, 6)), np.full((5, 6), 0.1)), TimeAxis.over(0, 4 * 10**9))
    for panel in figure.axes:
        bands = [tuple(np.asarray(band.get_facecolor())[0, :3].tolist()) for band in panel.collections]
        assert bands == [to_rgba(stroke(row).color)[:3] for row in range(3)]
    (legend,) = figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"x", "y", "z", "band: 2 standard deviations"}
