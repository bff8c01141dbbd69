"""Reference pages that are generated say what the code says."""

from __future__ import annotations

from pathlib import Path

import click

from tsgt.cli import reference as commands
from tsgt.cli.main import COMMANDS, cli
from tsgt.config import reference as configuration

PAGES = Path(__file__).parents[2] / "docs" / "reference"


def test_the_command_reference_is_fresh() -> None:
    """The page is what the commands say of themselves; if not, call `make generated`."""
    assert (PAGES / "cli.md").read_text() == commands.markdown()


def test_the_configuration_reference_is_fresh() -> None:
    """The page is what the models say of themselves; if not, call `make generated`."""
    assert (PAGES / "configuration.md").read_text() == configuration.markdown()


def test_every_command_says_what_it_is_for() -> None:
    """Each command has a help text, and each of its options too."""
    context = click.Context(cli)
    for name in COMMANDS:
        command = cli.get_command(context, name)
        assert command is not None
        subcommands = command.commands.values() if isinstance(command, click.Group) else [command]
        for each in (command, *subcommands):
            assert each.help, f"{name}: no help"
            for parameter in each.params:
                if isinstance(parameter, click.Option):
                    assert parameter.help, f"{name} {parameter.opts[0]}: no help"
