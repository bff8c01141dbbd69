"""Checks of the daemons before they start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner
from harness.hardware.fake_machine import FakeMachine

from tsgt.cli.daemons import client, master
from tsgt.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from click import Command

IMU = """
[imu]
command = ["/bin/imu"]
mounting = "imu.toml"
latitude_deg = 46.8
"""

MOUNTING = """
kind = "imu_mounting"
position_m = [0.2, -0.1, 0.4]
orientation_xyzw = [0.0, 0.0, 0.0, 1.0]
latency_ms = 0.0
gyro_matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
"""


@pytest.mark.parametrize(
    ("daemon", "file"),
    [
        ("client", "client.toml"),
        ("master", "master.toml"),
        ("master", "frames.toml"),
        ("master", "layout.toml"),
        ("master", "imu.toml"),
    ],
)
def test_daemon_rejects_world_writable_files(tmp_path: Path, daemon: str, file: str) -> None:
    """A configuration can run any program, and set-up files move every pose."""
    fake = FakeMachine(tmp_path)
    fake.change("master.toml", "[stream]", IMU + "[stream]")
    fake.write("imu.toml", MOUNTING)
    (tmp_path / file).chmod(0o666)
    command = {"client": client, "master": master}[daemon]
    refused = CliRunner().invoke(command, ["--config", str(tmp_path / f"{daemon}.toml")]).exception
    assert isinstance(refused, ConfigError)
    assert f"`chmod o-w {tmp_path / file}`" in str(refused)


@pytest.mark.parametrize(("daemon", "command"), [("client", client), ("master", master)])
def test_daemon_refuses_illegal_settings(tmp_path: Path, daemon: str, command: Command) -> None:
    """One line with the limit and the remedy."""
    fake = FakeMachine(tmp_path)
    fake.change("master.toml", "bandwidth_khz = 500.0", "bandwidth_khz = 250.0")
    fake.change("client.toml", 'region = "EU868"', 'region = "EU868"\npower_dbm = 14')
    arguments = ["--config", str(tmp_path / f"{daemon}.toml")]
    refused = CliRunner().invoke(command, arguments).exception
    assert isinstance(refused, ConfigError)
    assert "Remedy: " in str(refused)
    assert "\n" not in str(refused)
