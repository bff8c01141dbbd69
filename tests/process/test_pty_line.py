"""The simulated total station behind a pseudo-terminal, in real time: kept as short as it can be."""

from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest
import serial

from tsgt.config import ScenarioConfig
from tsgt.simulation.instrument import PtyLine, SimulatedTotalStation
from tsgt.simulation.kernel import LoopTimeline
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path


@asynccontextmanager
async def line(link: Path, baud: int = 115_200) -> AsyncGenerator[PtyLine]:
    """Serve an instrument in this loop."""
    scenario = ScenarioConfig()
    timeline = LoopTimeline(asyncio.get_running_loop())
    world = scenario_world(scenario, 10.0, np.random.default_rng(1))
    instrument = SimulatedTotalStation(
        scenario.stations[0], scenario, world, timeline, np.random.default_rng(2), start_ns=timeline.now_ns()
    )
    instrument.baud = baud
    async with PtyLine(instrument, link) as served:
        yield served


def ask(link: Path, baud: int, request: bytes = b"\n%R1Q,5004,1:\r\n") -> tuple[bytes, float]:
    """Ask once, as another program does; the answer and how long it took in s."""
    with serial.Serial(str(link), baud, timeout=0.3) as port:
        began_s = time.monotonic()
        port.write(request)
        answer = port.read_until(b"\r\n")
        return answer, time.monotonic() - began_s


def test_it_is_a_serial_port_with_the_pace_of_one(tmp_path: Path) -> None:
    """A program that opens the link and sets the speed gets an answer, not sooner than the line can carry it."""

    async def run() -> None:
        async with line(tmp_path / "rts0", 9600):
            answer, took_s = await asyncio.to_thread(ask, tmp_path / "rts0", 9600)
        assert answer == b'%R1P,0,1:0,"TCRP1201+"\r\n'
        assert took_s > 0.020 + (15 + len(answer)) * 10 / 9600

    asyncio.run(run())


def test_another_speed_gives_garbage(tmp_path: Path) -> None:
    """The speed that the program has set counts, though a pseudo-terminal has none."""

    async def run() -> None:
        async with line(tmp_path / "rts0"):
            answer, _ = await asyncio.to_thread(ask, tmp_path / "rts0", 57_600)
            assert b"%R1P" not in answer
            answer, _ = await asyncio.to_thread(ask, tmp_path / "rts0", 115_200)
            assert answer.startswith(b"%R1P,0,1:0")

    asyncio.run(run())


def test_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    """The program's port breaks and the link is gone; afterwards the same link leads to a port again."""
    link = tmp_path / "rts0"

    async def run() -> None:
        async with line(link) as served:
            port = serial.Serial(str(link), 115_200, timeout=0.3)
            served.unplug()
            assert not link.is_symlink()
            with pytest.raises((serial.SerialException, OSError)):
                port.read(1)
            served.plug()
            port.close()
            answer, _ = await asyncio.to_thread(ask, link, 115_200)
            assert answer.startswith(b"%R1P,0,1:0")
        assert not link.is_symlink()

    asyncio.run(run())
