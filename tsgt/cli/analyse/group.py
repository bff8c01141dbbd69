"""The command group ``analyse``: studies of what poses can be expected to be, and how they compare."""

from __future__ import annotations

import click

from tsgt.cli.analyse.gnss import gnss
from tsgt.cli.analyse.layout import layout_command
from tsgt.cli.analyse.perturbation import perturbation_command


@click.group()
def analyse() -> None:
    """Studies: what noise does to poses, where to put prisms and stations, how satellite receivers compare."""


analyse.add_command(gnss)
analyse.add_command(layout_command, "layout")
analyse.add_command(perturbation_command, "perturbation")
