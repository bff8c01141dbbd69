"""The master's daemon as a process, in real time, without its channel."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from harness.processes import ROOT, TIMEOUT_S, wait_for

from tsgt.radio.key_file import write_key
from tsgt.recording import read_lines

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Return the example of the repository with a simulated radio and everything in one folder."""
    for name in ("prism_layout", "station_frames"):
        shutil.copy(ROOT / "configs" / f"{name}.example.toml", tmp_path)
    text = (ROOT / "configs" / "master.example.toml").read_text()
    text = re.sub(r"\[radio.wiring\].*?\n\n", "", text, flags=re.DOTALL)
    text = text.replace('kind = "sx127x"', 'kind = "simulated"\nair_socket = "air.sock"\nname = "master"')
    text = text.replace("/run/tsgt", ".").replace("/var/lib/tsgt", "recordings")
    write_key(tmp_path / "radio.key")
    path = tmp_path / "master.toml"
    path.write_text(text)
    return path


@pytest.fixture
def daemon(config: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start the master, and kill it at the end."""
    program = "from tsgt.cli.daemons import main_master; main_master()"
    command = [sys.executable, "-c", program, "--config", str(config)]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE) as process:
        yield process
        process.kill()


def connected(path: Path, daemon: subprocess.Popen[bytes]) -> socket.socket:
    """Connect to the stream as soon as it is served."""

    def connection() -> socket.socket | None:
        reader = socket.socket(socket.AF_UNIX)
        try:
            reader.connect(str(path))
        except OSError:
            reader.close()
            return None
        return reader

    found = wait_for(connection, daemon)
    assert found is not None
    return found


def test_master_streams_without_radio_and_ends_on_sigterm(
    config: Path, daemon: subprocess.Popen[bytes]
) -> None:
    """Readers get a status each second; SIGTERM ends it with status 0 and a whole recording."""
    with connected(config.parent / "poses.sock", daemon) as reader, reader.makefile("rb") as lines:
        while json.loads(lines.readline())["type"] != "status":
            pass
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(TIMEOUT_S) == 0
    (recording,) = (config.parent / "recordings").iterdir()
    types = [line.type for line in read_lines(recording)]
    assert types[:4] == ["recording", "parameters", "setup", "event"]
    assert "status" in types
    assert daemon.stderr is not None
    logged = [json.loads(line)["event"] for line in daemon.stderr]
    assert {"stream_opened", "master_started", "radio_lost", "master_stopped"} <= set(logged)


def test_invalid_configuration_is_one_line(tmp_path: Path) -> None:
    """Exit status 2 and the reason."""
    program = "from tsgt.cli.daemons import main_master; main_master()"
    command = [sys.executable, "-c", program, "--config", str(tmp_path / "none.toml")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f"error: {tmp_path / 'none.toml'}: no such file\n"
