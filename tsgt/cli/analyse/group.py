"""The command group ``analyse``."""

from __future__ import annotations

import click

from tsgt.cli.analyse.gnss import gnss
from tsgt.cli.analyse.layout import layout_command
from tsgt.cli.analyse.perturbation import perturbation_command


@click.group()
def analyse() -> None:
    """Study layouts, noise and GNSS receivers."""


analyse.add_command(gnss)
analyse.add_command(layout_command, "layout")
analyse.add_command(perturbation_command, "perturbation")
