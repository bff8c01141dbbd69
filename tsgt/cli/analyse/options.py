"""What the studies share: the layout that they are of, and where their figure goes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click
import numpy as np

from tsgt.analysis.figures import FORMATS
from tsgt.cli.options import path_type
from tsgt.config import load_prism_layout
from tsgt.errors import ConfigError, GeometryError
from tsgt.geometry import check_layout

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from tsgt.model import Vector3


def _figure_path(_context: click.Context, _parameter: click.Parameter, value: Path | None) -> Path | None:
    """Refuse what no figure can be written to: before the study, not after it."""
    if value is None:
        return None
    if value.suffix not in FORMATS:
        raise click.BadParameter(f"{value} does not end in {', '.join(FORMATS)}")
    if not value.absolute().parent.is_dir():
        raise click.BadParameter(f"{value}: there is no such folder")
    return value


figure_option = click.option(
    "--figure",
    type=path_type,
    callback=_figure_path,
    help="Draw the study as well; by its ending PNG, PDF or SVG. Needs tsgt[report].",
)


def usable_layout(prisms: Mapping[int, Vector3], source: Path | str) -> Mapping[int, Vector3]:
    """Give back a layout from which poses follow.

    Raises
    ------
    ConfigError
        None follow: fewer than three prisms, or such as lie in a line.
    """
    try:
        check_layout(np.array(list(prisms.values())).reshape(-1, 3), names=list(prisms))
    except GeometryError as error:
        raise ConfigError(f"{source}: prisms: {error}", key="prisms") from error
    return prisms


def read_layout(path: Path) -> Mapping[int, Vector3]:
    """Read a prism layout (set-up file) that poses follow from; raises as :func:`usable_layout`."""
    return usable_layout(dict(sorted(load_prism_layout(path).items())), path)
