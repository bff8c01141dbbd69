"""Two radios with the real driver on simulated chips that share one air."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.radio import LoRaSettings
from tsgt.radio.sx127x import SX127x
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.kernel.event_loop import VirtualEventLoop
from tsgt.simulation.lora import Air, LinkModel, SimulatedHal, SX1276Chip

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from tsgt.simulation.kernel import VirtualTimeline

PAPER = LoRaSettings(frequency_hz=905_000_000, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6)
"""The modem settings of the paper."""

MS = 1_000_000
"""In ns."""


def running_timeline() -> VirtualTimeline:
    """Return the timeline of the running test's event loop."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualEventLoop)
    return loop._timeline


@dataclass(frozen=True)
class Side:
    """One radio from driver to chip."""

    radio: SX127x
    chip: SX1276Chip
    hal: SimulatedHal

    def register(self, address: int) -> int:
        """Read a register, bypassing the driver."""
        return self.chip.transfer(bytes([address, 0]))[1]


@dataclass(frozen=True)
class Bench:
    """Two radios with a good link, and what they share."""

    here: Side
    there: Side
    air: Air
    timeline: VirtualTimeline
    clock: VirtualClock


def make_side(air: Air, name: str, *, allow_20_dbm: bool = False) -> Side:
    """Make a radio that is not started."""
    chip = SX1276Chip(air.timeline, lambda antenna: air.join(antenna, name), np.random.default_rng(1))
    hal = SimulatedHal(chip)
    return Side(SX127x(hal, VirtualClock(0), allow_20_dbm=allow_20_dbm), chip, hal)


@asynccontextmanager
async def bench(
    settings: LoRaSettings = PAPER, there: LoRaSettings | None = None, *, allow_20_dbm: bool = False
) -> AsyncGenerator[Bench]:
    """Start two radios, with the same settings unless the other side has its own, and close them at the end."""
    timeline = running_timeline()
    air = Air(timeline, np.random.default_rng(0), LinkModel())
    one, other = (make_side(air, name, allow_20_dbm=allow_20_dbm) for name in ("here", "there"))
    try:
        await one.radio.start(settings)
        await other.radio.start(there or settings)
        yield Bench(one, other, air, timeline, VirtualClock(0))
    finally:
        await one.radio.close()
        await other.radio.close()
