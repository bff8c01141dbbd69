"""Signals to real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest
from harness.missions.processes import ROOT, TIMEOUT_S

PROGRAM = """
import asyncio
from tsgt.service import run

async def main():
    print("running", flush=True)
    try:
        await asyncio.sleep(600)
    finally:
        await asyncio.sleep(0)
        print("cleaned up", flush=True)

run(main)
"""

SUMMING_UP = """
import asyncio
from tsgt.service import run

async def main():
    print("running", flush=True)
    try:
        await asyncio.sleep(600)
    except asyncio.CancelledError:
        return "summary"

print(run(main))
"""


HUNG_UP = """
import asyncio, os, signal
from tsgt.service import run

async def main():
    print("running", flush=True)
    os.kill(os.getpid(), signal.SIGHUP)
    await asyncio.sleep(0.1)
    print("still running", flush=True)
    await asyncio.sleep(600)

signal.signal(signal.SIGHUP, signal.SIG_IGN)
run(main)
"""


def ended_by(number: signal.Signals, program: str, *, after_lines: int = 1) -> tuple[int, list[str]]:
    """Run a program, send it a signal after its first lines, return its exit code and its output."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    ) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(after_lines)]
        process.send_signal(number)
        try:
            rest, _ = process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()
        return process.returncode, ("".join(lines) + rest).splitlines()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_a_service_cleanly(number: signal.Signals) -> None:
    """The program is cancelled, its clean-up runs, and it exits with 0."""
    assert ended_by(number, PROGRAM) == (0, ["running", "cleaned up"])


def test_sigint_ends_a_program_cleanly() -> None:
    """SIGINT counts as an interruption."""
    code, lines = ended_by(signal.SIGINT, PROGRAM)
    assert lines == ["running", "cleaned up"]
    assert code == -signal.SIGINT


@pytest.mark.parametrize("number", [signal.SIGTERM])
def test_program_may_return_a_result_after_a_signal(number: signal.Signals) -> None:
    """It catches the cancellation."""
    assert ended_by(number, SUMMING_UP) == (0, ["running", "summary"])


def test_program_under_nohup_survives_the_end_of_its_terminal() -> None:
    """SIGHUP stays ignored where the caller ignores it."""
    assert ended_by(signal.SIGTERM, HUNG_UP, after_lines=2) == (0, ["running", "still running"])
