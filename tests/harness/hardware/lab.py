"""Our driver on its simulated chip, a second chip for a third-party driver, and the air between them."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from harness.hardware.blocking import BlockingProgram
from harness.hardware.radios import make_side, running_timeline

from tsgt.simulation.lora import Air, LinkModel, SX1276Chip

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from tsgt.radio import LoRaSettings
    from tsgt.radio.sx127x import SX127x

SIZES = (5, 17, 34, 251)
"""Payload sizes that all drivers support: Adafruit's takes 5 to 251 bytes."""


@dataclass(frozen=True)
class Lab:
    """Our radio, and the other chip with a program to drive it."""

    radio: SX127x
    chip: SX1276Chip
    program: BlockingProgram


@asynccontextmanager
async def lab(settings: LoRaSettings) -> AsyncGenerator[Lab]:
    """Start our radio for the duration of the block."""
    timeline = running_timeline()
    air = Air(timeline, np.random.default_rng(0), LinkModel())
    ours = make_side(air, "ours")
    other = SX1276Chip(timeline, lambda antenna: air.join(antenna, "peer"), np.random.default_rng(2))
    await ours.radio.start(settings)
    try:
        yield Lab(ours.radio, other, BlockingProgram())
    finally:
        await ours.radio.close()


def payload(size: int) -> bytes:
    """Return bytes that depend on position and size."""
    return bytes((size + 7 * place) % 256 for place in range(size))
