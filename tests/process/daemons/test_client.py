"""The client's daemon as a process, with channel and instrument in another one, in real time."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from harness.missions.processes import ROOT, TIMEOUT_S, wait_for

from tsgt.recording.journal import load_journal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


CONFIG = """
kind = "client"
station = 1
prism = 1
status_socket = "client.sock"
[instrument]
kind = "leica"
port = "instrument.tty"
prism_type = "user"
prism_constant_mm = 0.0
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
import asyncio, json, os, sys, time
from pathlib import Path
import numpy as np
from tsgt.config import ScenarioConfig
from tsgt.config.scenario import InstrumentModelConfig
from tsgt.log import configure_logging
from tsgt.simulation.lora.air_server import AirServer
from tsgt.simulation.lora.link import LinkModel
from tsgt.simulation.instrument.pty import PtyLine
from tsgt.simulation.kernel.timeline import LoopTimeline
from tsgt.simulation.instrument.total_station import SimulatedTotalStation
from tsgt.simulation.world import scenario_world

async def main(folder):
    scenario, rng, timeline = ScenarioConfig(), np.random.default_rng(0), LoopTimeline(asyncio.get_running_loop())
    quick = InstrumentModelConfig(processing_min_ms=1.0, processing_max_ms=5.0)
    station = scenario.stations[0].model_copy(update={"rate_hz": 20.0, "instrument": quick})
    world = scenario_world(scenario, 60.0, rng)
    start_ns = timeline.now_ns()
    instrument = SimulatedTotalStation(station, scenario, world, timeline, rng, start_ns=start_ns)
    tty = folder / "instrument.tty"
    async with AirServer(folder / "air.sock", LinkModel(), rng):
        async with PtyLine(instrument, tty) as line:
            # As long as somebody has a terminal open, another one cannot get its name.
            os.open(tty, os.O_RDWR | os.O_NOCTTY)
            print("ready", flush=True)
            while command := (await asyncio.to_thread(sys.stdin.readline)).strip():
                getattr(line, command)()
                times_ns = [[each.instrument_ms * 1_000_000, each.true_ns] for each in instrument.reported_distances]
                where = os.readlink(tty) if tty.is_symlink() else None
                state = {"now_ns": time.monotonic_ns(), "tty": where, "offered": times_ns}
                print(json.dumps(state), flush=True)

configure_logging()
asyncio.run(main(Path(sys.argv[1])))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a configuration."""
    (tmp_path / "client.toml").write_text(CONFIG)
    return tmp_path


@contextmanager
def surroundings(folder: Path) -> Iterator[Callable[[str], dict[str, Any]]]:
    """Run channel and instrument in another process; yield its control."""
    with subprocess.Popen(
        [sys.executable, "-c", SURROUNDINGS, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=_environment(),
        text=True,
    ) as process:
        stdin, said = process.stdin, process.stdout
        assert stdin is not None
        assert said is not None

        def control(command: str) -> dict[str, Any]:
            print(command, file=stdin, flush=True)
            state = json.loads(said.readline())
            assert isinstance(state, dict)
            return state

        try:
            assert said.readline() == "ready\n"
            yield control
        finally:
            process.kill()


@contextmanager
def client(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket]]:
    """Run the client with the socket of systemd, kill it at the end."""
    notify = folder / "notify.sock"
    notify.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(notify))
        systemd.settimeout(TIMEOUT_S)
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
    """Request the status of the client."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(TIMEOUT_S)
        connection.connect(str(folder / "client.sock"))
        with connection.makefile("rb") as file:
            status = json.loads(file.readline())
    assert isinstance(status, dict)
    return status


def measured(folder: Path, measurements: int) -> dict[str, Any]:
    """Wait until the client has read the given number of measurements."""
    for _ in range(1200):
        status = asked(folder)
        if status["measurements"] >= measurements:
            return status
        time.sleep(0.05)  # the other process runs in real time
    raise AssertionError(f"no {measurements} measurements in 60 s")


def test_client_notifies_systemd_and_ends_on_sigterm(folder: Path) -> None:
    """It reports readiness and liveness; SIGTERM ends it with status 0."""
    with surroundings(folder), client(folder) as (process, systemd):
        assert systemd.recv(1000).startswith(b"READY=1\nSTATUS=station 1: ")
        assert systemd.recv(1000).startswith(b"WATCHDOG=1\nSTATUS=")
        status = measured(folder, 20)
        assert status["radio_ok"]
        assert status["locked"]
        # It is as small as a client in the field.
        mapped = Path(f"/proc/{process.pid}/maps").read_text()
        assert "/scipy/" not in mapped
        assert "/matplotlib/" not in mapped
        drain(systemd)  # it holds few messages, and drops further ones silently
        process.send_signal(signal.SIGTERM)
        assert process.wait(TIMEOUT_S) == 0
        while (message := systemd.recv(1000)) != b"STOPPING=1":
            assert message.startswith(b"WATCHDOG=1\n")
    assert not (folder / "client.sock").exists()


def drain(systemd: socket.socket) -> None:
    """Receive all waiting messages."""
    patience_s = systemd.gettimeout()
    systemd.setblocking(False)
    with suppress(BlockingIOError):
        while systemd.recv(1000):
            pass
    systemd.settimeout(patience_s)


def test_killed_client_leaves_a_readable_journal(folder: Path) -> None:
    """At most the last line is torn, and a new client starts another journal."""
    for _ in range(2):
        with surroundings(folder), client(folder) as (process, _):
            served(folder, process)
            seen = measured(folder, 5)["measurements"]
            process.kill()
            process.wait()
        journal = load_journal(max((folder / "journals").iterdir(), key=lambda path: path.stat().st_mtime_ns))
        assert len(journal.measurements) >= seen - 1
        assert [m.sequence for m in journal.measurements] == list(range(len(journal.measurements)))
    assert len(list((folder / "journals").iterdir())) == 2


def test_client_recovers_channel_and_instrument(folder: Path) -> None:
    """It waits while both are gone, and continues with both."""
    with client(folder) as (process, _):
        served(folder, process)
        with surroundings(folder):
            assert measured(folder, 5)["journal_ok"]
        alone = wait_until(folder, radio_ok=False, instrument=None)
        with surroundings(folder):
            wait_until(folder, radio_ok=True, instrument="Leica TCRP1201+ 230001")
            measured(folder, alone["measurements"] + 5)


def test_cable_that_returns_under_another_name(folder: Path) -> None:
    """The stable name leads to another terminal: measurements come within 3 s."""
    with surroundings(folder) as control, client(folder) as (process, _):
        served(folder, process)
        measured(folder, 5)
        name = str((folder / "instrument.tty").readlink())
        assert control("unplug")["tty"] is None
        before = wait_until(folder, instrument=None)
        back = control("plug")
        assert back["tty"] not in (None, name)
        measured(folder, before["measurements"] + 20)
        state = control("plug")  # already plugged in
        measured(folder, asked(folder)["measurements"] + 2)  # what was under way has come
        assert process.poll() is None
    (path,) = (folder / "journals").iterdir()
    journal = load_journal(path)
    back_ns = journal.head.unix_at_zero_ns + back["now_ns"]
    first = next(each for each in journal.measurements if each.status.usable and each.received_ns > back_ns)
    assert first.received_ns - back_ns < 3_000_000_000
    read = [each.instrument_time_ns for each in journal.measurements if each.slope_distance_m is not None]
    offered = {given_ns for given_ns, true_ns in state["offered"] if true_ns > back["now_ns"]}
    assert len(offered) >= 15
    assert offered <= set(read)
    assert len(set(read)) == len(read)


def wait_until(folder: Path, **expected: object) -> dict[str, Any]:
    """Wait until the client's status has these values."""
    for _ in range(1200):
        status = asked(folder)
        if all(status[key] == value for key, value in expected.items()):
            return status
        time.sleep(0.05)
    raise AssertionError(f"not {expected} within 60 s")


def served(folder: Path, process: subprocess.Popen[bytes]) -> None:
    """Wait until the client serves its socket."""

    def answers() -> bool:
        with suppress(OSError):
            return bool(asked(folder))
        return False

    wait_for(answers, process, shows=folder / "client.log")


def test_invalid_configuration_is_one_line(tmp_path: Path) -> None:
    """Exit code 2 and the invalid key."""
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
