"""Generate docs/reference/cli.md from the commands: ``python -m tsgt.cli.reference FILE``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsgt.cli.daemons import client, master
from tsgt.cli.main import HELP_OPTIONS, cli

if TYPE_CHECKING:
    from collections.abc import Iterator

_INTRODUCTION = """\
# Commands

Generated from the commands' own `--help` (`make generated`); do not edit.
"""


def markdown() -> str:
    """Return the page: one section per command with its help text."""
    sections = [_INTRODUCTION]
    for name, command in (("tsgt", cli), ("tsgt-client", client), ("tsgt-master", master)):
        for path, context in _walk(name, command, None):
            sections.append(f"## {path}\n\n```\n{context.get_help()}\n```\n")
    return "\n".join(sections)


def _walk(
    path: str, command: click.Command, parent: click.Context | None
) -> Iterator[tuple[str, click.Context]]:
    context = click.Context(
        command,
        parent=parent,
        info_name=path.rsplit(" ", 1)[-1],
        terminal_width=100,
        max_content_width=100,
        **HELP_OPTIONS,
    )
    yield path, context
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            child = command.get_command(context, name)
            if child is not None:
                yield from _walk(f"{path} {name}", child, context)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(markdown())
