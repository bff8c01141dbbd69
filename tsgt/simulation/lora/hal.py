"""Bus and pins of a simulated chip, as the driver sees those of a real one."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tsgt.radio.sx127x import Edge

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.radio.sx127x import EdgeCallback
    from tsgt.simulation.lora.chip import SX1276Chip


class SimulatedHal:
    """A :class:`tsgt.radio.sx127x.hal.Hal` on a chip in this process; transfers take no time.

    Edges are stamped with the time at which the simulated chip raised the pin.

    Parameters
    ----------
    chip
        What is on the bus.
    stamp_sigma_ns
        What the host claims of its time stamps; the chip's own jitter is in them already.
    local_ns
        From the chip's timeline to the host's CLOCK_MONOTONIC; the same unless the host's clock has an error.
    """

    def __init__(
        self,
        chip: SX1276Chip,
        *,
        stamp_sigma_ns: int = 3_000,
        local_ns: Callable[[int], int] = int,
    ) -> None:
        self.stamp_sigma_ns = stamp_sigma_ns
        self._local_ns = local_ns
        self._chip = chip
        self._edges_to_lose = 0
        self._edges_lost = 0
        self._losses_counted = True

    def transfer(self, data: bytes) -> bytes:
        """Exchange bytes in one chip-select window."""
        return self._chip.transfer(data)

    def set_reset(self, *, low: bool) -> None:
        """Pull NRESET low or release it."""
        self._chip.set_reset(low)

    def dio0(self) -> bool:
        """Level of DIO0 now."""
        return self._chip.dio(0)

    def on_dio0(self, callback: EdgeCallback) -> None:
        """Call back in the running loop, but as from an interrupt never in the middle of the driver's own work."""
        loop = asyncio.get_running_loop()

        def changed(at_ns: int, level: bool) -> None:  # noqa: FBT001 (a level)
            if not level:
                return
            if self._edges_to_lose > 0:
                self._edges_to_lose -= 1
                self._edges_lost += self._losses_counted
                return
            loop.call_soon(callback, Edge(self._local_ns(at_ns), self._edges_lost))
            self._edges_lost = 0

        self._chip.on_dio(0, changed)

    def lose_edges(self, count: int, *, counted: bool = True) -> None:
        """Let the next rising edges go unreported, a fault that drivers must survive.

        Parameters
        ----------
        count
            How many.
        counted
            Whether the edge after them tells how many were lost, as gpiod does and RPi.GPIO does not.
        """
        self._edges_to_lose = count
        self._losses_counted = counted

    def close(self) -> None:
        """Do nothing; the chip stays on."""
