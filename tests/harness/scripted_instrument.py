"""An instrument whose measurements a test makes up."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.recording.journal import InstrumentRecord
from tsgt.station import Condition, Reading

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.radio import Direction
    from tsgt.station import Atmosphere

READING = Reading(
    at_ns=0,
    prism=1,
    horizontal_angle_rad=2.5,
    zenith_angle_rad=1.25,
    slope_distance_m=99.5,
    status=Status.OK,
)

RECORD = InstrumentRecord(make="Script", prism_type="round", prism_constant_m=0.0, atmospheric_ppm=0.0)


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
        self.towards: list[Direction | None] = []
        """Where it was told to look for each prism."""
        self.plugged = True
        """Without its cable it cannot be connected; :meth:`fail` pulls it out while somebody reads."""
        self.condition = Condition(activity="tracking", battery_percent=80)
        self.record: InstrumentRecord | None = None
        """What it says of its settings; set by a connection and by :meth:`set_atmosphere`."""
        self.air_refusal: InstrumentError | None = None
        """What setting the air ends with."""

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
        """Be there, with the settings that a person has made."""
        if not self.plugged:
            raise InstrumentError("nobody answers; is the cable in?")
        self.record = RECORD
        return "scripted"

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track a prism, after a second."""
        await self._change(prism)
        self.towards.append(towards)

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

    async def check(self) -> None:
        """Be there with its cable only."""
        if not self.plugged:
            raise InstrumentError("nobody answers; is the cable in?")

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Apply 10 ppm in any air, after a tenth of a second."""
        await self._sleep(0.1)
        if self.air_refusal is not None:
            raise self.air_refusal
        self.record = replace(
            RECORD,
            atmospheric_ppm=10.0,
            temperature_c=atmosphere.temperature_c,
            pressure_hpa=atmosphere.pressure_hpa,
        )

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
