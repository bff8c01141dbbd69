"""The paper's polling master as the authors run it, for tests against our station client."""

from __future__ import annotations

import asyncio
from statistics import fmean
from typing import TYPE_CHECKING, NamedTuple, NoReturn

from tsgt.simulation.mission.authors_node import MEASUREMENT_FORMAT, TIME_FORMAT, AuthorsTiming, PolledRadio

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from tsgt.clock import Clock
    from tsgt.radio import Radio


class AuthorsMeasurement(NamedTuple):
    """A measurement of a reply, unchecked."""

    station: int
    status: int
    zenith_angle_rad: float
    horizontal_angle_rad: float
    slope_distance_m: float
    seconds: int
    nanoseconds: int


class AuthorsMaster:
    """The authors' master.

    Parameters
    ----------
    stations
        Polling order.
    initial_cycles, cycles
        Of the first synchronisation of each station, and of later ones.

    Attributes
    ----------
    offset_ns
        Clock offset by station; positive: ahead of the master.
    measurements
        All received measurements, repeats included.
    """

    INTERVAL_NS = 300_000_000_000
    """Between two rounds of synchronisation."""
    STAGGER_NS = 10_000_000_000
    """Between the stations of a round."""
    WEIGHT = 0.1
    """Weight of a later synchronisation against the previous offset."""

    def __init__(
        self,
        stations: Sequence[int],
        radio: Radio,
        clock: Clock,
        rng: np.random.Generator,
        timing: AuthorsTiming = AuthorsTiming(),  # noqa: B008 (frozen)
        *,
        initial_cycles: int = 50,
        cycles: int = 5,
    ) -> None:
        self._stations = stations
        self._radio = PolledRadio(radio, clock, rng, timing)
        self._clock = clock
        self._timing = timing
        self._initial_cycles = initial_cycles
        self._cycles = cycles
        self.offset_ns: dict[int, float] = {}
        self.measurements: list[AuthorsMeasurement] = []

    async def run(self) -> NoReturn:
        """Synchronise, then poll until cancelled."""
        for station in self._stations:
            await self.synchronise(station)
        start_ns = self._clock.monotonic_ns() + self.INTERVAL_NS
        due_ns = {station: start_ns + place * self.STAGGER_NS for place, station in enumerate(self._stations)}
        while True:
            for station in self._stations:
                if self._clock.monotonic_ns() >= due_ns[station]:
                    due_ns[station] += self.INTERVAL_NS
                    await self.synchronise(station)
                await self.poll(station)
                await self._radio.pause()

    async def synchronise(self, station: int) -> None:
        """Measure a station's clock offset; without a reply the previous one stays."""
        first = station not in self.offset_ns
        await self._radio.send(b"p%d" % station)
        offsets_ns = []
        for _ in range(self._initial_cycles if first else self._cycles):
            begin_ns = self._clock.realtime_ns()
            if await self.request(b"e%d" % station) != b"e%d" % station:
                continue
            end_ns = self._clock.realtime_ns()
            reply = await self.request(b"s%d" % station)
            if reply is not None and len(reply) == 9:
                seconds, nanoseconds = TIME_FORMAT.unpack(reply[1:])
                offsets_ns.append(seconds * 1_000_000_000 + nanoseconds - (begin_ns + end_ns) / 2)
        await self._radio.send(b"c%d" % station)
        if offsets_ns:
            new_ns = fmean(offsets_ns)
            old_ns = self.offset_ns.get(station, new_ns)
            self.offset_ns[station] = self.WEIGHT * new_ns + (1 - self.WEIGHT) * old_ns

    async def poll(self, station: int, timeout_ns: int | None = None) -> AuthorsMeasurement | None:
        """Request a measurement, in direct mode a single one; None: no reply in time."""
        reply = await self.request(b"t%d" % station, timeout_ns)
        if reply is None or len(reply) != MEASUREMENT_FORMAT.size:
            return None
        self.measurements.append(AuthorsMeasurement(*MEASUREMENT_FORMAT.unpack(reply)))
        return self.measurements[-1]

    async def request(self, payload: bytes, timeout_ns: int | None = None) -> bytes | None:
        """Send a command and return the next packet; None: timeout."""
        await self._radio.send(payload)
        try:
            async with asyncio.timeout((self._timing.timeout_ns if timeout_ns is None else timeout_ns) / 1e9):
                return await self._radio.receive()
        except TimeoutError:
            return None
