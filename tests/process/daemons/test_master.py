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
from harness.missions.processes import ROOT, TIMEOUT_S, wait_for

from tsgt.master.reload import RELOAD_SIGNAL
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


def test_master_without_calibration_takes_it_while_running(config: Path) -> None:
    """`--apply` writes the file that its configuration names, and the running master uses it; a broken one is rejected."""
    folder = config.parent
    frames = folder / "station_frames.example.toml"
    frames.unlink()
    program = "from tsgt.cli.daemons import main_master; main_master()"
    command = [sys.executable, "-c", program, "--config", str(config)]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as daemon:
        try:
            with connected(folder / "poses.sock", daemon) as reader, reader.makefile("rb") as lines:
                assert (
                    f"{frames} (`tsgt calibrate targets` writes it)"
                    in json.loads(lines.readline())["no_poses"]
                )
                targets = folder / "targets.csv"
                targets.write_text(TARGETS)
                applied = tsgt("calibrate", "targets", str(targets), "--apply", str(config))
                assert (
                    "the running master uses it: new set-up in force: frames of stations 1, 2, 3"
                    in applied.stderr
                )
                assert applied.returncode == 0
                kept = frames.read_text()
                frames.write_text("nonsense")
                daemon.send_signal(RELOAD_SIGNAL)
                events = (json.loads(line) for line in lines if b'"event"' in line)
                names = [next(events)["event"] for _ in range(2)]
                while names[-1] != "setup_rejected":
                    names.append(next(events)["event"])
                assert "setup_applied" in names
            frames.rename(folder / "edited.toml")
            config.write_text(config.read_text().replace(frames.name, "edited.toml"))
            targets.write_text(TARGETS.replace(",18.0,", ",18.01,"))
            frames.write_text(kept)
            applied = tsgt("calibrate", "targets", str(targets), "--apply", str(config))
            assert "are not those of" in applied.stderr
            assert "restart it" in applied.stderr
            assert applied.returncode == 1
            with connected(folder / "poses.sock", daemon) as reader, reader.makefile("rb") as lines:
                hello, setup = (json.loads(lines.readline()) for _ in range(2))
            assert "no_poses" not in hello
            assert [each["id"] for each in setup["stations"]] == [1, 2, 3]
            assert "residual" in kept
        finally:
            daemon.kill()


# Measured from one place with three orientations of the circle.
TARGETS = "station,target,horizontal_angle_deg,zenith_angle_deg,slope_distance_m,constant_mm\n" + "".join(
    f"{station},{target},{(angle + 30 * station) % 360},{zenith},{distance},0\n"
    for station in (1, 2, 3)
    for target, (angle, zenith, distance) in enumerate(
        [(10.0, 88.0, 18.0), (95.0, 91.0, 22.0), (190.0, 86.0, 17.0), (280.0, 93.0, 19.0)], start=1
    )
)


def tsgt(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command."""
    command = [sys.executable, "-m", "tsgt", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)


def test_invalid_configuration_is_one_line(tmp_path: Path) -> None:
    """Exit status 2 and the reason."""
    program = "from tsgt.cli.daemons import main_master; main_master()"
    command = [sys.executable, "-c", program, "--config", str(tmp_path / "none.toml")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f"error: {tmp_path / 'none.toml'}: no such file\n"
