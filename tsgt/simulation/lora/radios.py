"""The real driver on simulated chips that share one simulated air, on virtual time."""

from __future__ import annotations

import math
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.sx127x import SX127x
from tsgt.simulation.lora.chip import SX1276Chip
from tsgt.simulation.lora.hal import SimulatedHal

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    import numpy as np

    from tsgt.radio import LoRaSettings, OpenRadio, Packet, Radio, Transmitted
    from tsgt.simulation.kernel import SimulatedClock, Timeline
    from tsgt.simulation.lora.air import Air


class HostDelay(NamedTuple):
    """How long a host takes before it sends, log-normally distributed: usually short, with a tail.

    The default is an assumption, not a measurement: a Pi with Python needs about a millisecond of CPU and of SPI
    transfers for a packet and its answer, and its scheduler adds some milliseconds now and then. Median 3 ms; one
    answer in twenty takes 7 ms and more, one in a thousand 14 ms.

    What is to begin at an instant is prepared before it. The host is woken for that, and works for a millisecond; and it
    is woken again for the start. Each time it is late, by 0.3 ms in the median, by 3 ms and more once in a hundred, by
    5 ms and more once in four hundred: what four such programs do on two cores that are busy with other things.

    Attributes
    ----------
    median_ms
        Half of the answers take longer.
    sigma
        Of the natural logarithm.
    work_ms
        What it takes to prepare what begins at an instant.
    wake_median_ms, wake_sigma
        As for an answer, of how late the host is woken.
    """

    median_ms: float = 3.0
    sigma: float = 0.5
    work_ms: float = 1.0
    wake_median_ms: float = 0.3
    wake_sigma: float = 1.0

    def draw_ns(self, rng: np.random.Generator) -> int:
        """Draw the delay of an answer in nanoseconds."""
        return round(self.median_ms * 1e6 * math.exp(self.sigma * rng.standard_normal()))

    def draw_wake_ns(self, rng: np.random.Generator) -> int:
        """Draw in nanoseconds how late the host is woken."""
        return round(self.wake_median_ms * 1e6 * math.exp(self.wake_sigma * rng.standard_normal()))


class RadioHardware(NamedTuple):
    """What is behind an open radio.

    Attributes
    ----------
    chip, hal
        The chip, and the host's bus and pins.
    """

    chip: SX1276Chip
    hal: SimulatedHal


class StampJitter(NamedTuple):
    """What a host's stamps of its radio's interrupts are off by.

    Attributes
    ----------
    sigma_ns
        One sigma.
    rng
        Draws it.
    """

    sigma_ns: int
    rng: np.random.Generator


CHIP_SIGMA_NS = 3_000
"""One sigma of the interrupts of the simulated chip itself."""


def simulated_radio(
    air: Air,
    name: str,
    timeline: Timeline,
    clock: SimulatedClock,
    rng: np.random.Generator,
    jitter: StampJitter | None = None,
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
    jitter
        Of the host's stamps; None: they are as good as the chip.
    """
    return SX127x(_hardware(air, name, timeline, clock, rng, jitter).hal, clock)


def _hardware(
    air: Air,
    name: str,
    timeline: Timeline,
    clock: SimulatedClock,
    rng: np.random.Generator,
    jitter: StampJitter | None,
) -> RadioHardware:
    chip = SX1276Chip(timeline, lambda antenna: air.join(antenna, name), rng)
    if jitter is None:
        return RadioHardware(chip, SimulatedHal(chip, local_ns=clock.local_ns))

    def stamped_ns(true_ns: int) -> int:
        return clock.local_ns(true_ns) + round(jitter.sigma_ns * jitter.rng.standard_normal())

    sigma_ns = round(math.hypot(CHIP_SIGMA_NS, jitter.sigma_ns))
    return RadioHardware(chip, SimulatedHal(chip, stamp_sigma_ns=sigma_ns, local_ns=stamped_ns))


def opener(
    air: Air,
    name: str,
    clock: SimulatedClock,
    rng: np.random.Generator,
    settings: LoRaSettings,
    host_delay: HostDelay | None = None,
    jitter: StampJitter | None = None,
    on_open: Callable[[RadioHardware], None] = lambda _: None,
) -> OpenRadio:
    """Return what opens a radio on the air, as a daemon does; it can be opened again after it was closed.

    Parameters
    ----------
    air, name, clock, rng, jitter
        As for :func:`simulated_radio`; the chip waits on the air's timeline.
    settings
        Of the modem.
    host_delay
        The time that the host takes before it sends; None: none, as virtual hosts are.
    on_open
        Told each time what is behind the radio.
    """

    @asynccontextmanager
    async def open_radio() -> AsyncGenerator[Radio]:
        hardware = _hardware(air, name, air.timeline, clock, rng, jitter)
        on_open(hardware)
        radio = SX127x(hardware.hal, clock)
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
        """Send later; at the instant asked for, or when this host is ready or woken for it."""
        if at_ns is None:
            delay_ns = self._delay.draw_ns(self._rng)
        else:
            delay_ns = self._delay.draw_wake_ns(self._rng) + round(self._delay.work_ms * 1e6)
            at_ns += self._delay.draw_wake_ns(self._rng)
        await self._clock.sleep_until(self._clock.monotonic_ns() + delay_ns)
        return await self._radio.transmit(payload, at_ns=at_ns)

    async def receive(self) -> Packet:
        return await self._radio.receive()

    async def close(self) -> None:
        await self._radio.close()
