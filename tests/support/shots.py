"""An instrument whose measurements a test makes up."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.station.instrument import Reading

if TYPE_CHECKING:
    from tsgt.clock import Clock

READING = Reading(
    at_ns=0,
    prism=1,
    horizontal_angle_rad=2.5,
    zenith_angle_rad=1.25,
    slope_distance_m=99.5,
    status=Status.OK,
)


class ScriptedInstrument:
    """A total station that measures when and what it is told to.

    Parameters
    ----------
    clock
        Of its host.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._readings: asyncio.Queue[Reading | InstrumentError] = asyncio.Queue()
        self.target: Reading | InstrumentError = READING
        """What a single measurement gives; it takes two seconds."""
        self.refusal: InstrumentError | None = None
        """What a change of mode ends with; else it takes a second."""
        self.prisms: list[int | None] = []
        """What it was told to track; None stands for single measurements."""

    def give(self, status: Status = Status.OK) -> Reading:
        """Make a measurement of the tracked prism now."""
        distance_m = READING.slope_distance_m if status.usable else None
        reading = replace(
            READING, at_ns=self._clock.monotonic_ns(), status=status, slope_distance_m=distance_m
        )
        self._readings.put_nowait(reading)
        return reading

    def fail(self) -> None:
        """Pull the plug."""
        self._readings.put_nowait(InstrumentError("the instrument is gone"))

    async def connect(self) -> str:
        """Be there."""
        return "scripted"

    async def track(self, prism: int) -> None:
        """Track a prism, after a second."""
        await self._change(prism)

    async def read(self) -> Reading:
        """Return what :meth:`give` made."""
        return self._checked(await self._readings.get())

    async def direct(self) -> None:
        """Get ready for single measurements, after a second."""
        await self._change(None)

    async def measure(self) -> Reading:
        """Return the target."""
        await self._sleep(2)
        return self._checked(self.target)

    async def close(self) -> None:
        """Do nothing."""

    async def _change(self, prism: int | None) -> None:
        await self._sleep(1)
        if self.refusal is not None:
            raise self.refusal
        self.prisms.append(prism)

    async def _sleep(self, duration_s: float) -> None:
        await self._clock.sleep_until(self._clock.monotonic_ns() + round(duration_s * 1e9))

    def _checked(self, reading: Reading | InstrumentError) -> Reading:
        if isinstance(reading, InstrumentError):
            raise reading
        return reading
