"""What the studies share: the prism layout, the figure, and the text of a point."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.figures import FORMATS
from tsgt.cli.options import OutputFile
from tsgt.cli.output import require_extra
from tsgt.config import load_prism_layout
from tsgt.errors import ConfigError, GeometryError
from tsgt.estimation import point_label, point_place
from tsgt.geometry import check_layout
from tsgt.model import ROBOT_FRAME

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.model import ReferencePoint, Vector3


class FigureFile(OutputFile):
    """A figure to write; suffix, folder and matplotlib are checked before the study."""

    def __init__(self) -> None:
        super().__init__(*FORMATS)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Check what the figure needs."""
        path = Path(super().convert(value, param, ctx))
        if not path.absolute().parent.is_dir():
            self.fail(f"{path}: no such folder", param, ctx)
        require_extra("figures", "matplotlib", extra="report")
        return path


figure_option = click.option(
    "--figure", type=FigureFile(), help="Figure to draw: .png, .pdf or .svg. Needs tsgt[report]."
)


def usable_layout(prisms: Mapping[int, Vector3], source: Path | str) -> Mapping[int, Vector3]:
    """Return a layout that determines a pose.

    Raises
    ------
    ConfigError
        Fewer than three prisms, or collinear ones.
    """
    try:
        check_layout(np.array(list(prisms.values())).reshape(-1, 3), names=list(prisms))
    except GeometryError as error:
        raise ConfigError(f"{source}: prisms: {error}", key="prisms") from error
    return prisms


def read_layout(path: Path) -> Mapping[int, Vector3]:
    """Read a prism layout (set-up file); raises as :func:`usable_layout`."""
    return usable_layout(dict(sorted(load_prism_layout(path).positions_m.items())), path)


def point_text(point: ReferencePoint) -> str:
    """Return the label of a point, and where it is on the robot."""
    return point_label(point) + ("" if point.name == ROBOT_FRAME else f" at {point_place(point)}")
