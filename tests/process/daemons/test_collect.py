"""``tsgt calibrate collect`` as a process, against the client's daemon as another one, in real time."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import pytest
from harness.missions.processes import ROOT, TIMEOUT_S

from tsgt.analysis.formats import read_partial_target_file
from tsgt.radio.key_file import write_key

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}

RADIO = """
[radio]
kind = "simulated"
air_socket = "air.sock"
name = "{name}"
frequency_mhz = 905.0
spreading_factor = 7
[protocol]
{protocol}
"""

PROTOCOLS = {
    "classic": 'kind = "classic"',
    "superframe": 'kind = "superframe"\nkey_file = "mission.key"',
}

CLIENT = """
kind = "client"
station = 1
prism = 1
status_socket = "client.sock"
[instrument]
kind = "leica"
port = "instrument.tty"
prism_type = "user"
prism_constant_mm = 0.0
[journal]
directory = "journals"
"""

MASTER = """
kind = "master"
[setup]
station_frames = "station_frames.toml"
prism_layout = "prism_layout.toml"
[[stations]]
station = 1
prism = 1
prism_constant_mm = 10.0
[stream]
socket = "poses.sock"
"""

# Somebody aims the instrument at one target as soon as it has been set to foil.
SURROUNDINGS = """
import asyncio, sys
from pathlib import Path
import numpy as np
from tsgt.config import ScenarioConfig
from tsgt.config.scenario import InstrumentModelConfig
from tsgt.log import configure_logging
from tsgt.simulation.lora.air_server import AirServer
from tsgt.simulation.instrument.edm import NON_PRISM_MODES
from tsgt.simulation.lora.link import LinkModel
from tsgt.simulation.instrument.pty import PtyLine
from tsgt.simulation.kernel.timeline import LoopTimeline
from tsgt.simulation.instrument.total_station import SimulatedTotalStation
from tsgt.simulation.world import scenario_world

async def main(folder):
    scenario, rng = ScenarioConfig(targets_m=((12.0, 5.0, 1.0),)), np.random.default_rng(0)
    timeline = LoopTimeline(asyncio.get_running_loop())
    world = scenario_world(scenario, 60.0, rng)
    start_ns = timeline.now_ns()
    quick = InstrumentModelConfig(processing_min_ms=1.0, processing_max_ms=5.0)
    station = scenario.stations[0].model_copy(update={"instrument": quick})
    instrument = SimulatedTotalStation(station, scenario, world, timeline, rng, start_ns=start_ns)
    async with AirServer(folder / "air.sock", LinkModel(), rng):
        async with PtyLine(instrument, folder / "instrument.tty"):
            print("ready", flush=True)
            while True:
                if instrument.settings.edm_mode in NON_PRISM_MODES:
                    instrument.aim_at_target(1)
                await asyncio.sleep(0.1)

configure_logging()
asyncio.run(main(Path(sys.argv[1])))
"""


@contextmanager
def process(*arguments: str, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Run Python, kill it at the end."""
    with subprocess.Popen([sys.executable, *arguments], env=ENVIRONMENT, **options) as started:
        try:
            yield started
        finally:
            started.kill()


@pytest.fixture(params=["superframe", "classic"])
def folder(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """Return a folder with both configurations; channel, instrument and client run."""
    protocol = PROTOCOLS[request.param]
    (tmp_path / "client.toml").write_text(CLIENT + RADIO.format(name="station1", protocol=protocol))
    (tmp_path / "master.toml").write_text(MASTER + RADIO.format(name="master", protocol=protocol))
    write_key(tmp_path / "mission.key")
    run_client = "from tsgt.cli.daemons import main_client; main_client()"
    with ExitStack() as stack:
        around = stack.enter_context(process("-c", SURROUNDINGS, str(tmp_path), stdout=subprocess.PIPE))
        assert around.stdout is not None
        assert around.stdout.readline() == b"ready\n"
        log = stack.enter_context((tmp_path / "client.log").open("wb"))
        stack.enter_context(process("-c", run_client, "--config", str(tmp_path / "client.toml"), stderr=log))
        wait_for_mode(tmp_path, "tracking")
        yield tmp_path


def wait_for_mode(folder: Path, mode: str) -> None:
    """Wait until the client's instrument is connected and in a mode."""
    found = None
    deadline_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline_s:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            if connection.connect_ex(str(folder / "client.sock")) == 0:
                with connection.makefile("rb") as file:
                    status = json.loads(file.readline())
                found = status["instrument"] and status["mode"]
                if found == mode:
                    return
        time.sleep(0.05)  # the other process runs in real time
    raise AssertionError(f"the client is {found}, not {mode}")


def collect_command(folder: Path, output: Path) -> tuple[str, ...]:
    """Return Python arguments that collect targets into a file."""
    config = str(folder / "master.toml")
    return (
        "-m",
        "tsgt",
        "calibrate",
        "collect",
        "--config",
        config,
        "--output",
        str(output),
        "--target-constant-mm",
        "0",
    )


@pytest.mark.parametrize("waiting", [True, False])
def test_ctrl_c_keeps_measurements_and_returns_to_tracking(folder: Path, *, waiting: bool) -> None:
    """While waiting for a key and while measuring; the exit code is that of Ctrl-C."""
    path = folder / "targets.csv"
    command = collect_command(folder, path)
    with process(*command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as collect:
        assert collect.stdin is not None
        collect.stdin.write(b"\n" if waiting else b"\n\n")
        collect.stdin.flush()
        deadline_s = time.monotonic() + TIMEOUT_S
        while not (path.exists() and len(path.read_text().splitlines()) == 2):
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        wait_for_mode(folder, "direct")
        time.sleep(0.5)  # into the second measurement, which takes at least a second
        collect.send_signal(signal.SIGINT)
        # Ends without a key: nothing hangs on the input.
        assert collect.wait(TIMEOUT_S) == 130
        assert collect.stderr is not None
        assert collect.stderr.read().endswith(b"stopped\n")
    wait_for_mode(folder, "tracking")
    (sight,) = read_partial_target_file(path).measurements[1][1]
    assert sight.slope_distance_m == pytest.approx((12.0**2 + 5.0**2 + 1.0) ** 0.5, abs=0.03)


def test_keys_are_read_from_stdin(folder: Path) -> None:
    """The end of the input ends the command, which reports missing measurements."""
    path = folder / "targets.csv"
    command = collect_command(folder, path)
    for _ in range(
        5
    ):  # the radio of a busy machine may be too late for all tries of a command; the next run continues
        done = subprocess.run(
            [sys.executable, *command, "--target-count", "3"],
            env=ENVIRONMENT, input=b"\ns\n", capture_output=True, timeout=2 * TIMEOUT_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        if b"3 measurements are missing" not in done.stderr:
            break
    assert b"2 measurements are missing" in done.stderr
    wait_for_mode(folder, "tracking")
    check = ("-m", "tsgt", "calibrate", "check", "--config", str(folder / "master.toml"), "--json")
    for _ in range(5):  # likewise
        done = subprocess.run(
            [sys.executable, *check, "--targets", str(path)],
            env=ENVIRONMENT, input=b"\n", capture_output=True, timeout=2 * TIMEOUT_S, check=False,
        )  # fmt: skip
        if b"has not sent a measurement" not in done.stderr:
            break
    assert done.returncode == 0, done.stderr
    station = json.loads(done.stdout)["stations"]["1"]
    assert station["ok"]
    assert station["moved_mrad"] is None
    assert station["moved_mm"] < 7.0
