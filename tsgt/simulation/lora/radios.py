"""The real SX127x driver on simulated chips."""

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

    from tsgt.radio import LoRaSettings, Packet, Radio, RadioOpener, Transmission
    from tsgt.simulation.kernel import SimulatedClock, Timeline
    from tsgt.simulation.lora.air import Air


class HostDelay(NamedTuple):
    """Delay of a host before it transmits, log-normally distributed.

    The defaults are an assumption, not a measurement: a Pi with Python needs about a millisecond of CPU and SPI time per
    packet, and its scheduler occasionally adds some milliseconds. Median 3 ms; one in twenty takes 7 ms or more, one in a
    thousand 14 ms.

    A transmission at a given instant is prepared before it. The host wakes up for the preparation, which takes a
    millisecond, and again for the start. Each wake-up is late by 0.3 ms in the median, by 3 ms or more once in a hundred,
    by 5 ms or more once in four hundred: as measured with four such programs on two busy cores.

    Attributes
    ----------
    wake_median_ms, wake_sigma
        Distribution of the wake-up delay.
    """

    median_ms: float = 3.0
    sigma: float = 0.5  # of the natural logarithm
    work_ms: float = 1.0  # duration of the preparation
    wake_median_ms: float = 0.3
    wake_sigma: float = 1.0

    def draw_ns(self, rng: np.random.Generator) -> int:
        """Draw the delay of a transmission in ns."""
        return round(self.median_ms * 1e6 * math.exp(self.sigma * rng.standard_normal()))

    def draw_wake_ns(self, rng: np.random.Generator) -> int:
        """Draw a wake-up delay in ns."""
        return round(self.wake_median_ms * 1e6 * math.exp(self.wake_sigma * rng.standard_normal()))


class RadioHardware(NamedTuple):
    """The hardware of an open radio: chip, and the host's bus and pins."""

    chip: SX1276Chip
    hal: SimulatedHal


class TimestampJitter(NamedTuple):
    """Random error of a host's interrupt timestamps."""

    sigma_ns: int
    rng: np.random.Generator


CHIP_SIGMA_NS = 3_000
"""One sigma of the simulated chip's interrupts."""


def simulated_radio(
    air: Air,
    name: str,
    timeline: Timeline,
    clock: SimulatedClock,
    rng: np.random.Generator,
    jitter: TimestampJitter | None = None,
) -> SX127x:
    """Create a radio on the channel, not yet started; its timestamps have ``jitter`` in addition to the chip's."""
    return SX127x(_hardware(air, name, timeline, clock, rng, jitter).hal, clock)


def _hardware(
    air: Air,
    name: str,
    timeline: Timeline,
    clock: SimulatedClock,
    rng: np.random.Generator,
    jitter: TimestampJitter | None,
) -> RadioHardware:
    chip = SX1276Chip(timeline, lambda listener: air.join(listener, name), rng)
    if jitter is None:
        return RadioHardware(chip, SimulatedHal(chip, local_ns=clock.local_ns))

    def timestamp_ns(true_ns: int) -> int:
        return clock.local_ns(true_ns) + round(jitter.sigma_ns * jitter.rng.standard_normal())

    sigma_ns = round(math.hypot(CHIP_SIGMA_NS, jitter.sigma_ns))
    return RadioHardware(chip, SimulatedHal(chip, stamp_sigma_ns=sigma_ns, local_ns=timestamp_ns))


def radio_opener(
    air: Air,
    name: str,
    clock: SimulatedClock,
    rng: np.random.Generator,
    settings: LoRaSettings,
    host_delay: HostDelay | None = None,
    jitter: TimestampJitter | None = None,
    on_open: Callable[[RadioHardware], None] = lambda _: None,
) -> RadioOpener:
    """Return a callable that opens a radio on the channel, as a daemon does; it may be reopened after closing.

    Parameters as of :func:`simulated_radio`; ``on_open`` is called with the hardware on each opening.
    """

    @asynccontextmanager
    async def open_radio() -> AsyncGenerator[Radio]:
        hardware = _hardware(air, name, air.timeline, clock, rng, jitter)
        on_open(hardware)
        radio = SX127x(hardware.hal, clock)
        try:
            await radio.start(settings)
            yield radio if host_delay is None else _DelayedRadio(radio, clock, host_delay, rng)
        finally:
            try:
                await radio.close()
            finally:  # also when the daemon is cancelled while it closes the radio
                air.leave(name)

    return open_radio


class _DelayedRadio:
    """A radio whose host delays transmissions."""

    def __init__(
        self, radio: Radio, clock: SimulatedClock, delay: HostDelay, rng: np.random.Generator
    ) -> None:
        self._radio = radio
        self._clock = clock
        self._delay = delay
        self._rng = rng

    async def configure(self, settings: LoRaSettings) -> None:
        await self._radio.configure(settings)

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
        """Transmit after a delay, or at the given instant if the host wakes up in time."""
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
