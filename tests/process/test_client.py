"""The client's daemon as a process, with air and instrument in another one, in real time."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tsgt.recording.journal import load_journal

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]

CONFIG = """
kind = "client"
station = 1
prism = 1
status_socket = "client.sock"
[instrument]
kind = "simulated"
socket = "instrument.sock"
[radio]
kind = "simulated"
air_socket = "air.sock"
name = "station1"
frequency_mhz = 905.0
spreading_factor = 7
[protocol]
kind = "classic"
[journal]
directory = "journals"
"""

SURROUNDINGS = """
import asyncio, sys
from pathlib import Path
import numpy as np
from tsgt.clock import SystemClock
from tsgt.config import ScenarioConfig
from tsgt.log import configure_logging
from tsgt.simulation.air_server import AirServer
from tsgt.simulation.instrument import SimulatedInstrument
from tsgt.simulation.instrument_socket import InstrumentServer
from tsgt.simulation.link import LinkModel
from tsgt.simulation.world import scenario_world

async def main(folder):
    scenario, rng, clock = ScenarioConfig(), np.random.default_rng(0), SystemClock()
    station = scenario.stations[0].model_copy(update={"rate_hz": 20.0})
    world = scenario_world(scenario, 60.0, rng)
    instrument = SimulatedInstrument(station, scenario, world, clock, rng, start_ns=clock.monotonic_ns())
    async with AirServer(folder / "air.sock", LinkModel(), rng):
        async with InstrumentServer(folder / "instrument.sock", instrument):
            print("ready", flush=True)
            await asyncio.sleep(60)

configure_logging()
asyncio.run(main(Path(sys.argv[1])))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder with a configuration."""
    (tmp_path / "client.toml").write_text(CONFIG)
    return tmp_path


@contextmanager
def surroundings(folder: Path) -> Iterator[None]:
    """Run air and instrument in another process."""
    with subprocess.Popen(
        [sys.executable, "-c", SURROUNDINGS, str(folder)], stdout=subprocess.PIPE, env=_environment()
    ) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == b"ready\n"
            yield
        finally:
            process.kill()


@contextmanager
def client(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket]]:
    """Run the client, kill it at the end; with the socket that systemd would listen on."""
    notify = folder / "notify.sock"
    notify.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(notify))
        systemd.settimeout(20.0)
        environment = _environment() | {"NOTIFY_SOCKET": str(notify), "WATCHDOG_USEC": "400000"}
        with (
            (folder / "client.log").open("ab") as log_file,
            subprocess.Popen(
                [
                    sys.executable,
                    "-c",
                    "from tsgt.cli.daemons import main_client; main_client()",
                    "--config",
                    str(folder / "client.toml"),
                ],
                env=environment,
                stderr=log_file,
            ) as process,
        ):
            try:
                yield process, systemd
            finally:
                process.kill()


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def asked(folder: Path) -> dict[str, Any]:
    """Ask the client how it does."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(5.0)
        connection.connect(str(folder / "client.sock"))
        with connection.makefile("rb") as file:
            status = json.loads(file.readline())
    assert isinstance(status, dict)
    return status


def wait_for(folder: Path, measurements: int) -> dict[str, Any]:
    """Wait until the client has read so many measurements."""
    for _ in range(200):
        status = asked(folder)
        if status["measurements"] >= measurements:
            return status
        time.sleep(0.05)  # the other process runs in real time
    raise AssertionError(f"no {measurements} measurements in 10 s")


def test_a_client_runs_and_ends_as_systemd_wants_it(folder: Path) -> None:
    """It says when it is ready and that it lives; SIGTERM ends it within a second, with status 0."""
    with surroundings(folder), client(folder) as (process, systemd):
        assert systemd.recv(1000).startswith(b"READY=1\nSTATUS=station 1: ")
        assert systemd.recv(1000).startswith(b"WATCHDOG=1\nSTATUS=")
        status = wait_for(folder, 20)
        assert status["radio_ok"]
        assert status["locked"]
        # It is as small as a client in the field.
        mapped = Path(f"/proc/{process.pid}/maps").read_text()
        assert "/scipy/" not in mapped
        assert "/matplotlib/" not in mapped
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=1.0) == 0
        while (message := systemd.recv(1000)) != b"STOPPING=1":
            assert message.startswith(b"WATCHDOG=1\n")
    assert not (folder / "client.sock").exists()


def test_a_client_that_is_killed_leaves_a_readable_journal(folder: Path) -> None:
    """After kill -9 every journal is whole but for a torn line, and a new client begins another one."""
    for _ in range(2):
        with surroundings(folder), client(folder) as (process, _):
            systemd_ready(folder)
            seen = wait_for(folder, 5)["measurements"]
            process.kill()
            process.wait()
        journal = load_journal(max((folder / "journals").iterdir(), key=lambda path: path.stat().st_mtime_ns))
        assert len(journal.measurements) >= seen - 1
        assert [m.sequence for m in journal.measurements] == list(range(len(journal.measurements)))
    assert len(list((folder / "journals").iterdir())) == 2


def test_a_client_outlives_what_is_around_it(folder: Path) -> None:
    """When air and instrument are gone it waits for them, and goes on with both when they are back."""
    with client(folder):
        systemd_ready(folder)
        with surroundings(folder):
            assert wait_for(folder, 5)["journal_ok"]
        alone = wait_until(folder, radio_ok=False, instrument=None)
        with surroundings(folder):
            wait_until(folder, radio_ok=True, instrument="simulated total station 1")
            wait_for(folder, alone["measurements"] + 5)


def wait_until(folder: Path, **expected: object) -> dict[str, Any]:
    """Wait until the client's status has these values."""
    for _ in range(400):
        status = asked(folder)
        if all(status[key] == value for key, value in expected.items()):
            return status
        time.sleep(0.05)
    raise AssertionError(f"not {expected} within 20 s")


def systemd_ready(folder: Path) -> None:
    """Wait until the client serves its socket."""
    for _ in range(400):
        try:
            asked(folder)
        except OSError:
            time.sleep(0.05)
        else:
            return
    raise AssertionError("the client does not start")


def test_a_bad_configuration_is_told_in_one_line(tmp_path: Path) -> None:
    """Exit code 2 and the key that is wrong."""
    (tmp_path / "client.toml").write_text(CONFIG.replace("spreading_factor = 7", "spreading_factor = 6"))
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from tsgt.cli.daemons import main_client; main_client()",
            "--config",
            str(tmp_path / "client.toml"),
        ],
        capture_output=True,
        text=True,
        check=False,
        env=_environment(),
    )
    assert done.returncode == 2
    assert "radio.spreading_factor = 6" in done.stderr
    assert len(done.stderr.splitlines()) == 1
