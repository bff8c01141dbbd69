"""The simulated total station behind a pseudo-terminal, in real time."""

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
    """Serve an instrument in this event loop."""
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
    """Send a request as another program; return the response and its duration in s."""
    with serial.Serial(str(link), baud, timeout=0.3) as port:
        began_s = time.monotonic()
        port.write(request)
        answer = port.read_until(b"\r\n")
        return answer, time.monotonic() - began_s


def test_pseudo_terminal_has_the_pace_of_a_serial_line(tmp_path: Path) -> None:
    """A response does not arrive faster than the line can carry it."""

    async def run() -> None:
        async with line(tmp_path / "rts0", 9600):
            answer, took_s = await asyncio.to_thread(ask, tmp_path / "rts0", 9600)
        assert answer == b'%R1P,0,1:0,"TCRP1201+"\r\n'
        assert took_s > 0.020 + (15 + len(answer)) * 10 / 9600

    asyncio.run(run())


def test_wrong_baud_rate_gives_garbage(tmp_path: Path) -> None:
    """The rate set by the program counts, though a pseudo-terminal has none."""

    async def run() -> None:
        async with line(tmp_path / "rts0"):
            answer, _ = await asyncio.to_thread(ask, tmp_path / "rts0", 57_600)
            assert b"%R1P" not in answer
            answer, _ = await asyncio.to_thread(ask, tmp_path / "rts0", 115_200)
            assert answer.startswith(b"%R1P,0,1:0")

    asyncio.run(run())


def test_unplug_and_plug_in_again(tmp_path: Path) -> None:
    """The open port breaks and the link is gone; afterwards the link leads to a port again."""
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
