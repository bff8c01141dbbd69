"""Figures as files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from matplotlib.artist import Artist

from tsgt.analysis.figures.style import FORMATS, drawing, save
from tsgt.errors import OutputFileError

if TYPE_CHECKING:
    from pathlib import Path

SIZE = {"width_mm": 40.0, "height_mm": 30.0}


class Undrawable(Artist):
    """Fails in the middle of a figure."""

    def draw(self, renderer: object) -> None:
        """Fail with any renderer."""
        del renderer
        raise RuntimeError("cannot be drawn")


@pytest.mark.parametrize("suffix", FORMATS)
def test_figure_that_cannot_be_drawn_leaves_the_file_as_it_was(tmp_path: Path, suffix: str) -> None:
    """An error while drawing neither replaces an existing figure nor leaves a part of the new one."""
    path = tmp_path / f"figure{suffix}"
    path.write_text("the figure of yesterday")
    with drawing(**SIZE) as figure:
        figure.add_subplot().add_artist(Undrawable())
        with pytest.raises(RuntimeError, match="cannot be drawn"):
            save(figure, path)
    assert path.read_text() == "the figure of yesterday"
    assert list(tmp_path.iterdir()) == [path]


def test_missing_folder_is_an_error_of_the_output_file(tmp_path: Path) -> None:
    """The error names the file."""
    path = tmp_path / "nowhere" / "figure.png"
    with drawing(**SIZE) as figure:
        figure.add_subplot()
        with pytest.raises(OutputFileError, match=r"nowhere/figure\.png"):
            save(figure, path)
