"""The real driver on simulated chips in separate processes, over an air server in a third, in real time."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from harness.missions.processes import ROOT, TIMEOUT_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

SERVER = """
import asyncio, sys
from pathlib import Path
import numpy as np
from tsgt.log import configure_logging
from tsgt.simulation.lora.air_server import AirServer
from tsgt.simulation.lora.link import LinkModel

async def main():
    async with AirServer(Path(sys.argv[1]), LinkModel(), np.random.default_rng(0)):
        print("ready", flush=True)
        await asyncio.sleep(600)

configure_logging()
asyncio.run(main())
"""

RADIO = """
import asyncio, sys
from pathlib import Path
import numpy as np
from tsgt.clock import SystemClock
from tsgt.log import configure_logging
from tsgt.radio.base import LoRaSettings
from tsgt.radio.sx127x.driver import SX127x
from tsgt.simulation.lora.air_client import AirClient
from tsgt.simulation.lora.chip import SX1276Chip
from tsgt.simulation.lora.hal import SimulatedHal
from tsgt.simulation.kernel.timeline import LoopTimeline

SETTINGS = LoRaSettings(frequency_hz=905_000_000, spreading_factor=7, bandwidth_hz=250_000, coding_rate=6)

async def answer_to(radio, question):
    while True:  # under load the radio may start to receive too late
        sent = await radio.transmit(question)
        try:
            async with asyncio.timeout(0.5):
                answer = await radio.receive()
        except TimeoutError:
            continue
        return answer.payload.decode(), answer.received_at_ns - sent.done_at_ns

async def ask(radio):
    for number in range(5):
        print(*await answer_to(radio, b"question %d" % number), flush=True)

async def answer(radio):
    print("ready", flush=True)
    while True:
        question = await radio.receive()
        await asyncio.sleep(0.005)
        await radio.transmit(question.payload.replace(b"question", b"answer"))

async def main(path, name):
    timeline = LoopTimeline(asyncio.get_running_loop())
    async with AirClient(Path(path), name, timeline) as client:
        chip = SX1276Chip(timeline, client.join, np.random.default_rng(0))
        radio = SX127x(SimulatedHal(chip), SystemClock())
        try:
            await radio.start(SETTINGS)
            async with asyncio.TaskGroup() as tasks:
                disconnected = tasks.create_task(client.wait_disconnected())
                await {"ask": ask, "answer": answer}[name](radio)
                disconnected.cancel()
        finally:
            await radio.close()

configure_logging()
try:
    asyncio.run(main(*sys.argv[1:]))
except* Exception as errors:
    sys.exit(f"{errors.exceptions[0]}")
"""


@contextmanager
def running(program: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Run a program, at most until the end of the block."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def first_line(process: subprocess.Popen[str]) -> str:
    """Wait for the first line of a program's output."""
    assert process.stdout is not None
    return process.stdout.readline().rstrip()


def test_two_processes_exchange_packets_over_the_air_server(tmp_path: Path) -> None:
    """The end of each reply is at the time on air."""
    path = tmp_path / "air.sock"
    with running(SERVER, path) as server:
        assert first_line(server) == "ready"
        with running(RADIO, path, "answer") as answering:
            assert first_line(answering) == "ready"
            with running(RADIO, path, "ask") as asking:
                out, err = asking.communicate(timeout=TIMEOUT_S)
                assert asking.returncode == 0, err
            answers = [line.rsplit(maxsplit=1) for line in out.splitlines()]
            assert [text for text, _ in answers] == [f"answer {number}" for number in range(5)]
            # 8 bytes at SF7, 250 kHz, 4/6 take 19.584 ms, and 5 ms pass before they are sent.
            assert all(24_584_000 < int(turn_ns) < 500_000_000 for _, turn_ns in answers)

            server.kill()
            _, err = answering.communicate(timeout=TIMEOUT_S)
            assert answering.returncode == 1
            assert err.splitlines()[-1].endswith("the server has closed the connection")
