"""Common style of all figures: legible in a paper's column, by the colour-blind, and in greyscale.

Lines differ in colour, lightness and dashes, so that any one of them suffices. matplotlib is an extra: it is imported when
a figure is made, and never opens a window.
"""

from __future__ import annotations

import io
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from tsgt.errors import MissingExtraError, OutputFileError
from tsgt.recording import write_atomically

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from matplotlib.figure import Figure

PAGE_WIDTH_MM = 180.0  # Width of both columns of most journals
FORMATS = (".png", ".pdf", ".svg")


class Stroke(NamedTuple):
    """Style of one of several curves."""

    color: str
    linestyle: str | tuple[int, tuple[float, ...]]
    marker: str


# Those colours of the palette of Okabe and Ito (2008) that differ in lightness too, darkest first.
STROKES = (
    Stroke("#000000", "-", "o"),
    Stroke("#0072B2", (0, (5, 1.5)), "s"),
    Stroke("#D55E00", (0, (1.2, 1.2)), "^"),
    Stroke("#009E73", (0, (5, 1.5, 1.2, 1.5)), "D"),
    Stroke("#E69F00", (0, (8, 2)), "v"),
    Stroke("#56B4E9", (0, (3, 1, 1, 1, 1, 1)), "P"),
)

_DPI = 200

_STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#d9d9d9",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "lines.markersize": 4,
    "legend.frameon": False,
    "savefig.dpi": _DPI,
    "svg.hashsalt": "tsgt",
    "pdf.fonttype": 42,  # TrueType fonts: searchable text, as publishers require
}


@contextmanager
def drawing(*, width_mm: float, height_mm: float) -> Iterator[Figure]:
    """Yield an empty figure of this size in the common style, to be saved inside; MissingExtraError without matplotlib."""
    try:
        import matplotlib as mpl  # noqa: PLC0415 (an extra)
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("figures", library="matplotlib", extra="report") from error
    with mpl.rc_context(_STYLE):
        yield Figure(figsize=(width_mm / 25.4, height_mm / 25.4), dpi=_DPI, layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the suffix; OutputFileError if it is not in :data:`FORMATS`, or writing fails."""
    if path.suffix not in FORMATS:
        raise OutputFileError(f"figures end in {', '.join(FORMATS)}", path=path)
    # Without a date, so that the same numbers give the same file.
    metadata = {".png": None, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}[path.suffix]
    layout = figure.get_layout_engine()
    if layout is not None:
        # All formats have the same layout, and computing it takes as long as drawing: compute it once.
        layout.execute(figure)
        figure.set_layout_engine(None)
    with write_atomically(path) as file:
        figure.savefig(file, format=path.suffix[1:], metadata=metadata)


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as a PNG image."""
    image = io.BytesIO()
    figure.savefig(image, format="png")
    return image.getvalue()


_PALETTE_SIZE = 128  # enough for smooth edges of the few colours of a figure


def palette_png(png: bytes) -> bytes:
    """Return a PNG image with a palette, which a page can embed: it has about a third of the size."""
    from PIL import Image  # noqa: PLC0415 (comes with matplotlib)

    image = io.BytesIO()
    with Image.open(io.BytesIO(png)) as full:
        full.convert("RGB").quantize(_PALETTE_SIZE).save(image, "PNG", optimize=True)
    return image.getvalue()
