"""The real driver on simulated chips that share one simulated air, on virtual time."""

from __future__ import annotations

import math
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.sx127x import SX127x
from tsgt.simulation.chip import SX1276Chip
from tsgt.simulation.hal import SimulatedHal

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    import numpy as np

    from tsgt.radio.base import LoRaSettings, OpenRadio, Packet, Radio, Transmitted
    from tsgt.simulation.air import Air
    from tsgt.simulation.clocks import SimulatedClock
    from tsgt.simulation.timeline import Timeline


class HostDelay(NamedTuple):
    """How long a host takes from a packet to its answer, log-normally distributed: usually short, with a tail.

    The default is an assumption, not a measurement: a Pi with Python needs about a millisecond of CPU and of SPI
    transfers for a packet and its answer, and its scheduler adds some milliseconds now and then. Median 3 ms; one
    answer in twenty takes 7 ms and more, one in a thousand 14 ms.

    Attributes
    ----------
    median_ms
        Half of the answers take longer.
    sigma
        Of the natural logarithm.
    """

    median_ms: float = 3.0
    sigma: float = 0.5

    def draw_ns(self, rng: np.random.Generator) -> int:
        """Draw one delay in nanoseconds."""
        return round(self.median_ms * 1e6 * math.exp(self.sigma * rng.standard_normal()))


def simulated_radio(
    air: Air, name: str, timeline: Timeline, clock: SimulatedClock, rng: np.random.Generator
) -> SX127x:
    """Make a radio on the air, which is still to be started.

    Parameters
    ----------
    air
        What it shares with others.
    name
        Its own, by which the air's link model knows it.
    timeline, clock
        What the chip waits on, and what the driver's host takes for the time; edges are stamped with the host's.
    rng
        Of the chip's jitter.
    """
    chip = SX1276Chip(timeline, lambda antenna: air.join(antenna, name), rng)
    return SX127x(SimulatedHal(chip, local_ns=clock.local_ns), clock)


def opener(
    air: Air,
    name: str,
    clock: SimulatedClock,
    rng: np.random.Generator,
    settings: LoRaSettings,
    host_delay: HostDelay | None = None,
) -> OpenRadio:
    """Return what opens a radio on the air, as a daemon does; it can be opened again after it was closed.

    Parameters
    ----------
    air, name, clock, rng
        As for :func:`simulated_radio`; the chip waits on the air's timeline.
    settings
        Of the modem.
    host_delay
        The time that the host takes before it sends; None: none, as virtual hosts are.
    """

    @asynccontextmanager
    async def open_radio() -> AsyncGenerator[Radio]:
        radio = simulated_radio(air, name, air.timeline, clock, rng)
        try:
            await radio.start(settings)
            yield radio if host_delay is None else _SlowHost(radio, clock, host_delay, rng)
        finally:
            await radio.close()
            air.leave(name)

    return open_radio


class _SlowHost:
    """A radio whose host takes its time before it sends."""

    def __init__(
        self, radio: Radio, clock: SimulatedClock, delay: HostDelay, rng: np.random.Generator
    ) -> None:
        self._radio = radio
        self._clock = clock
        self._delay = delay
        self._rng = rng

    async def configure(self, settings: LoRaSettings) -> None:
        await self._radio.configure(settings)

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmitted:
        """Send later, but at the instant asked for if there is time enough."""
        await self._clock.sleep_until(self._clock.monotonic_ns() + self._delay.draw_ns(self._rng))
        return await self._radio.transmit(payload, at_ns=at_ns)

    async def receive(self) -> Packet:
        return await self._radio.receive()

    async def close(self) -> None:
        await self._radio.close()
