"""What the daemons make sure of before they start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner
from harness.made_up_machine import MadeUpMachine

from tsgt.cli.daemons import client, master
from tsgt.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("daemon", "file"),
    [
        ("client", "client.toml"),
        ("master", "master.toml"),
        ("master", "frames.toml"),
        ("master", "layout.toml"),
    ],
)
def test_no_daemon_starts_with_a_file_that_everybody_may_write(
    tmp_path: Path, daemon: str, file: str
) -> None:
    """Neither configuration, which can have any program run, nor set-up files, which move every pose."""
    MadeUpMachine(tmp_path)
    (tmp_path / file).chmod(0o666)
    command = {"client": client, "master": master}[daemon]
    refused = CliRunner().invoke(command, ["--config", str(tmp_path / f"{daemon}.toml")]).exception
    assert isinstance(refused, ConfigError)
    assert f"`chmod o-w {tmp_path / file}`" in str(refused)
