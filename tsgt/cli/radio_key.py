"""The command ``radio key``: makes the key that all radios of a mission share."""

from __future__ import annotations

from pathlib import Path

import click

from tsgt.radio.key_file import write_key


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
def key_command(file: Path) -> None:
    """Make a random key and write it to FILE, which nobody but its owner may read.

    All radios of a mission that speak the superframe share one key. With it, master and stations take only each
    other's packets, and none that was recorded and played back. An existing file is never overwritten.
    """
    write_key(file)
    click.echo(f"""{file}: a new key, for all radios of one mission. Whoever has it can take part: keep it secret.

On each machine of the mission, for the daemon's user:
  sudo install -o tsgt -g tsgt -m 600 {file.name} /etc/tsgt/radio.key
In the configuration of each daemon, under [protocol]:
  kind = "superframe"
  key_file = "radio.key"
`tsgt status` says of each daemon whether it has one.""")
