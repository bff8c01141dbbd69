"""Bridge programs as real child processes."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from harness.missions.processes import TIMEOUT_S
from structlog.testing import capture_logs

from tsgt.clock import SystemClock
from tsgt.config import BridgeInstrumentConfig
from tsgt.errors import InstrumentError
from tsgt.recording.journal import load_journal
from tsgt.station.bridge import BridgeInstrument

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

EXAMPLE = Path(__file__).parents[3] / "examples" / "bridge_program.py"

HELLO = """printf '{"type":"hello","bridge":1,"make":"Shell","stamps":"arrival"}\\n'; """

ONE = (
    """printf '{"type":"measurement","horizontal_angle_rad":1,"zenith_angle_rad":1.5,"""
    """"slope_distance_m":12.5,"status":"ok"}\\n'; """
)


def with_program(
    *command: str, use: Callable[[BridgeInstrument], Awaitable[None]], stall_timeout_s: float = 5.0
) -> None:
    """Use a program in real time, and end it."""

    async def main() -> None:
        config = BridgeInstrumentConfig(kind="bridge", command=command, stall_timeout_s=stall_timeout_s)
        instrument = BridgeInstrument(config, SystemClock())
        try:
            await use(instrument)
        finally:
            await instrument.close()

    asyncio.run(main())


def alive(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def gone(pid: int) -> bool:
    """Wait until a process is gone."""
    until = time.monotonic() + TIMEOUT_S
    while alive(pid) and time.monotonic() < until:
        time.sleep(0.01)
    return not alive(pid)


def test_example_program_measures_and_accepts_commands(tmp_path: Path) -> None:
    """It reports the rows of a file in order with recent times, and single measurements."""
    table = tmp_path / "rows.csv"
    table.write_text("1.0,1.5,10.0\n1.1,1.5,11.0\n")

    async def use(instrument: BridgeInstrument) -> None:
        assert await instrument.connect() == "Example invented, timestamped by the bridge"
        await instrument.track(3)
        readings = [await instrument.read() for _ in range(2)]
        assert {reading.slope_distance_m for reading in readings} == {10.0, 11.0}
        for reading in readings:
            assert reading.prism == 3
            assert reading.received_ns is not None
            assert 0 <= reading.received_ns - reading.at_ns < 100_000_000
        await instrument.direct()
        assert (await instrument.measure()).prism is None
        record = instrument.record
        assert record is not None
        assert record.prism_type == "360"

    with_program(sys.executable, "-I", str(EXAMPLE), str(table), use=use)


def test_shell_script_is_a_valid_program() -> None:
    """Its output before its end is read; its stderr is in the log and in the error."""

    async def use(instrument: BridgeInstrument) -> None:
        assert await instrument.connect() == "Shell, timestamped on arrival"
        await instrument.track(1)
        assert (await instrument.read()).slope_distance_m == 12.5
        with pytest.raises(InstrumentError, match=r"sh: the program has ended \(exit status 3: no licence\)"):
            await instrument.read()

    with capture_logs() as logs:
        with_program("sh", "-c", f"{HELLO} sleep 0.05; {ONE} echo no licence >&2; exit 3", use=use)
    assert [(entry["event"], entry["text"]) for entry in logs] == [("bridge_stderr", "no licence")]


def test_program_that_cannot_be_started() -> None:
    """The error names the key of the configuration."""

    async def use(instrument: BridgeInstrument) -> None:
        with pytest.raises(
            InstrumentError, match=r"cannot be started \(No such file or directory\); check instr"
        ):
            await instrument.connect()

    with_program("/nonexistent/program", use=use)


def test_program_that_ignores_sigterm_is_killed(tmp_path: Path) -> None:
    """Its child processes are killed as well."""
    pids = tmp_path / "pids"

    async def use(instrument: BridgeInstrument) -> None:
        await instrument.connect()
        started_s = time.monotonic()
        await instrument.close()
        assert time.monotonic() - started_s < 1.0

    with_program(
        "sh",
        "-c",
        f"trap '' TERM; sleep 60 & echo $$ $! > {pids}; {HELLO} while :; do sleep 60; done",
        use=use,
    )
    assert all(gone(int(pid)) for pid in pids.read_text().split())


def test_orphaned_child_is_killed(tmp_path: Path) -> None:
    """A child that holds the output open does not hide the end of the program."""
    pids = tmp_path / "pids"

    async def use(instrument: BridgeInstrument) -> None:
        await instrument.connect()
        await instrument.track(1)
        with pytest.raises(InstrumentError, match="exit status 0"):
            await instrument.read()

    with_program("sh", "-c", f"{HELLO} sleep 60 & echo $! > {pids}; sleep 0.1", use=use)
    assert gone(int(pids.read_text()))


def test_stalled_program_is_killed_and_restarted(tmp_path: Path) -> None:
    """A stopped process does not see SIGTERM."""
    mark = tmp_path / "mark"

    async def use(instrument: BridgeInstrument) -> None:
        await instrument.connect()
        await instrument.track(1)
        with pytest.raises(InstrumentError, match=r"has printed nothing usable for 0\.5 s"):
            await instrument.read()
        await instrument.connect()
        await instrument.track(1)
        assert (await instrument.read()).slope_distance_m == 12.5

    with_program(
        "sh",
        "-c",
        f"{HELLO} test -e {mark} || {{ touch {mark}; kill -STOP $$; }}; sleep 0.05; {ONE} exec sleep 60",
        use=use,
        stall_timeout_s=0.5,
    )


def test_program_cannot_notify_systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has a session of its own."""
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/systemd/notify")

    async def use(instrument: BridgeInstrument) -> None:
        assert (await instrument.connect()).startswith("[] ")

    script = """printf '{"type":"hello","bridge":1,"make":"[%s] %s","stamps":"host"}\\n' "$NOTIFY_SOCKET" $$; cat"""
    with_program("sh", "-c", script, use=use)
    assert "NOTIFY_SOCKET" in os.environ


def test_endless_output_is_bounded() -> None:
    """A program that prints as fast as it can costs neither memory nor time."""

    async def use(instrument: BridgeInstrument) -> None:
        started_s = time.monotonic()
        with pytest.raises(InstrumentError, match="more than 1000 lines in a second"):
            await instrument.connect()
        assert time.monotonic() - started_s < 10.0

    with_program("yes", use=use)
    with_program("cat", "/dev/zero", use=use)


CLIENT = """
kind = "client"
station = 1
prism = 1
status_socket = "client.sock"
[instrument]
kind = "bridge"
command = [{command}]
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

NOTING = """
import json, os, sys, time

def say(record):
    print(json.dumps(record), flush=True)

say({"type": "hello", "bridge": 1, "make": "Noting", "stamps": "host", "commands": ["track"]})
say({"type": "done", "id": json.loads(sys.stdin.readline())["id"]})
with open(sys.argv[1], "a") as notes:
    notes.write(f"start {os.getpid()}\\n")
    while True:
        notes.flush()
        time.sleep(0.005)
        at_ns = time.monotonic_ns()
        line = {"type": "measurement", "status": "ok", "host_time_ns": at_ns, "instrument_time_ns": at_ns}
        say(line | {"horizontal_angle_rad": 1.0, "zenith_angle_rad": 1.5, "slope_distance_m": 10.0})
        notes.write(f"{at_ns}\\n")
"""

ENOUGH = 10
"""So often each program measures before it is killed."""


def test_client_survives_repeated_kills_of_its_program(tmp_path: Path) -> None:
    """The journal has every measurement once."""
    notes = tmp_path / "notes"
    notes.touch()
    (tmp_path / "program.py").write_text(NOTING)
    command = ", ".join(f'"{word}"' for word in (sys.executable, tmp_path / "program.py", notes))
    (tmp_path / "client.toml").write_text(CLIENT.format(command=command))
    with subprocess.Popen(
        [
            sys.executable,
            "-c",
            "from tsgt.cli.daemons import main_client; main_client()",
            "--config",
            str(tmp_path / "client.toml"),
        ],
        env=os.environ | {"PYTHONPATH": str(EXAMPLE.parents[1])},
        stderr=subprocess.DEVNULL,
    ) as client:
        try:
            pid = started_after(notes, 0)
            for _ in range(3):
                with suppress(
                    ProcessLookupError
                ):  # its client has just ended it: it is slow on a busy machine
                    os.kill(pid, signal.SIGKILL)
                pid = started_after(notes, pid)
        finally:
            client.terminate()
        assert client.wait(TIMEOUT_S) == 0
    assert gone(pid)
    (path,) = (tmp_path / "journals").iterdir()
    journalled = [measurement.instrument_time_ns for measurement in load_journal(path).measurements]
    # What the last run printed while the client was ending may not have been read.
    _, *noted_by_run = (run.splitlines() for run in notes.read_text().split("start "))
    noted = [int(at_ns) for _, *run in noted_by_run[:-1] for at_ns in run]
    assert len(noted) >= 3 * ENOUGH
    assert len(set(journalled)) == len(journalled)
    assert set(noted) <= set(journalled)


def started_after(notes: Path, pid: int) -> int:
    """Wait until a program other than this process has started and measured often enough; return its process."""
    for _ in range(6000):
        last = notes.read_text().rpartition("start ")[2]
        if last.count("\n") > ENOUGH and (started := int(last.splitlines()[0])) != pid:
            return started
        time.sleep(0.01)
    raise AssertionError("the program was not started again")
