"""An instrument with scripted measurements."""

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
    """A total station whose results the test sets."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._readings: asyncio.Queue[Reading | InstrumentError] = asyncio.Queue()
        self.target: Reading | InstrumentError = READING
        """Result of a single measurement, after two seconds."""
        self.mode_error: InstrumentError | None = None
        """Error of a change of mode; None: it succeeds after a second."""
        self.prisms: list[int | None] = []
        """Tracked prisms, in order; None: direct mode."""
        self.towards: list[Direction | None] = []
        """Search directions, in order."""
        self.plugged = True
        """The cable is connected; :meth:`fail` disconnects it during a read."""
        self.condition = Condition(activity="tracking", battery_percent=80)
        self.record: InstrumentRecord | None = None
        """Its settings; set by a connection and by :meth:`set_atmosphere`."""
        self.atmosphere_error: InstrumentError | None = None
        """Error of :meth:`set_atmosphere`."""

    def give(self, status: Status = Status.OK) -> Reading:
        """Make a measurement of the tracked prism."""
        distance_m = READING.slope_distance_m if status.usable else None
        reading = replace(
            READING, at_ns=self._clock.monotonic_ns(), status=status, slope_distance_m=distance_m
        )
        self._readings.put_nowait(reading)
        return reading

    def fail(self) -> None:
        """Disconnect the cable."""
        self._readings.put_nowait(InstrumentError("the instrument is gone"))

    async def connect(self) -> str:
        """Connect, with the operator.s settings."""
        if not self.plugged:
            raise InstrumentError("nobody answers; is the cable in?")
        self.record = RECORD
        return "scripted"

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track a prism, after a second."""
        await self._change(prism)
        self.towards.append(towards)

    async def read(self) -> Reading:
        """Return the next measurement of :meth:`give`."""
        return self._checked(await self._readings.get())

    async def direct(self) -> None:
        """Enter direct mode after a second."""
        await self._change(None)

    async def measure(self) -> Reading:
        """Return :attr:`target`."""
        await self._sleep(2)
        return self._checked(self.target)

    async def check(self) -> None:
        """Check the connection."""
        if not self.plugged:
            raise InstrumentError("nobody answers; is the cable in?")

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Apply 10 ppm for any atmosphere, after 0.1 s."""
        await self._sleep(0.1)
        if self.atmosphere_error is not None:
            raise self.atmosphere_error
        self.record = replace(
            RECORD,
            atmospheric_ppm=10.0,
            temperature_c=atmosphere.temperature_c,
            pressure_hpa=atmosphere.pressure_hpa,
        )

    async def close(self) -> None:
        """Do nothing."""

    def host_clock_restarted(self) -> None:
        """Do nothing: it keeps no times."""

    async def _change(self, prism: int | None) -> None:
        await self._sleep(1)
        if self.mode_error is not None:
            raise self.mode_error
        self.prisms.append(prism)

    async def _sleep(self, duration_s: float) -> None:
        await self._clock.sleep_until(self._clock.monotonic_ns() + round(duration_s * 1e9))

    def _checked(self, reading: Reading | InstrumentError) -> Reading:
        if isinstance(reading, InstrumentError):
            raise reading
        return reading
