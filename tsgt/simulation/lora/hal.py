"""SPI bus and pins of a simulated chip, as the driver sees a real one."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tsgt.radio.sx127x import Edge

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.radio.sx127x import EdgeCallback
    from tsgt.simulation.lora.chip import SX1276Chip


class SimulatedHal:
    """A :class:`tsgt.radio.sx127x.hal.Hal` on a simulated chip; transfers take no time.

    Edges have the time at which the chip raised the pin, converted by ``local_ns`` to the host's CLOCK_MONOTONIC.
    ``stamp_sigma_ns`` is what the host states for them, the chip's jitter included.
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
        self._edges_to_drop = 0
        self._edges_dropped = 0
        self._count_dropped = True

    def transfer(self, data: bytes) -> bytes:
        """Exchange bytes in one chip-select window."""
        return self._chip.transfer(data)

    def set_reset(self, *, low: bool) -> None:
        """Pull NRESET low or release it."""
        self._chip.set_reset(low)

    def dio0(self) -> bool:
        """Return the level of DIO0."""
        return self._chip.dio(0)

    def on_dio0(self, callback: EdgeCallback) -> None:
        """Call back in the running loop; like an interrupt, never within the driver's own code."""
        loop = asyncio.get_running_loop()

        def changed(at_ns: int, level: bool) -> None:  # noqa: FBT001 (a level)
            if not level:
                return
            if self._edges_to_drop > 0:
                self._edges_to_drop -= 1
                self._edges_dropped += self._count_dropped
                return
            loop.call_soon(callback, Edge(self._local_ns(at_ns), self._edges_dropped))
            self._edges_dropped = 0

        self._chip.on_dio(0, changed)

    def drop_edges(self, count: int, *, counted: bool = True) -> None:
        """Suppress the next rising edges; ``counted``: the next edge carries their number, as with gpiod, not with RPi.GPIO."""
        self._edges_to_drop = count
        self._count_dropped = counted

    def close(self) -> None:
        """Do nothing; the chip stays on."""
