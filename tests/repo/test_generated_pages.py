"""Generated reference pages are up to date."""

from __future__ import annotations

from pathlib import Path

import click

from tsgt.cli import reference as commands
from tsgt.cli.main import COMMANDS, HELP_OPTIONS, cli
from tsgt.config import reference as configuration

PAGES = Path(__file__).parents[2] / "docs" / "reference"


def test_command_reference_is_fresh() -> None:
    """If not, call `make generated`."""
    assert (PAGES / "cli.md").read_text() == commands.markdown()


def test_configuration_reference_is_fresh() -> None:
    """If not, call `make generated`."""
    assert (PAGES / "configuration.md").read_text() == configuration.markdown()


def test_every_command_and_option_has_help() -> None:
    """Every sub-command is included."""
    context = click.Context(cli, **HELP_OPTIONS)
    for name in COMMANDS:
        command = cli.get_command(context, name)
        assert command is not None
        subcommands = command.commands.values() if isinstance(command, click.Group) else [command]
        for each in (command, *subcommands):
            assert each.help, f"{name}: no help"
            for parameter in each.params:
                if isinstance(parameter, click.Option):
                    assert parameter.help, f"{name} {parameter.opts[0]}: no help"
