"""Options that several commands share."""

from __future__ import annotations

import math
from pathlib import Path

import click

DEFAULT_SOCKET = Path("/run/tsgt/poses.sock")
DEFAULT_CLIENT_SOCKET = Path("/run/tsgt/client.sock")

path_type = click.Path(path_type=Path)


def finite(_context: click.Context, _parameter: click.Parameter, value: float | None) -> float | None:
    """Refuse NaN and infinity, which click takes for numbers; for the ``callback`` of an option."""
    if value is not None and not math.isfinite(value):
        raise click.BadParameter(f"{value} is not a finite number")
    return value


def a_number(_context: click.Context, _parameter: click.Parameter, value: float | None) -> float | None:
    """Refuse NaN, but not infinity; for the ``callback`` of an option."""
    if value is not None and math.isnan(value):
        raise click.BadParameter("nan is not a number")
    return value


constant_type = click.FloatRange(-10_000, 10_000)
"""For constants of reflectors in mm: no reflector adds ten metres. With ``finite`` for the ``callback``: NaN is in any range."""

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")

socket_option = click.option(
    "--socket",
    "socket_path",
    type=path_type,
    default=DEFAULT_SOCKET,
    envvar="TSGT_SOCKET",
    show_default=True,
    show_envvar=True,
    help="UNIX socket of the pose stream.",
)

keep_going_option = click.option(
    "--keep-going",
    is_flag=True,
    help="Skip lines that cannot be read, reporting each, instead of stopping at the first.",
)

recording_argument = click.argument("recording", type=path_type)

master_config_option = click.option(
    "--config", "config_path", type=path_type, required=True, help="Configuration of the master, TOML."
)
