"""A station with the software of the paper's authors, reimplemented from its description.

It serves to test our master against an independent implementation. It keeps the behaviour that differs from ours:

- the radio is polled once per millisecond and read byte by byte; timestamps are taken afterwards, from the Unix clock,
  which may step;
- the station resends its newest measurement, zeros before the first, and for an error -1 in all fields and an arbitrary
  time; it never applies the prism constant;
- it does nothing else while it executes a command, and has a separate mode for synchronisation;
- ``n`` with a prism has no effect while it tracks.

Where the description is ambiguous, the stricter reading applies: outside the synchronisation mode it ignores ``e`` and
``s``, inside it ``t``, ``d`` and ``n``. After an instrument failure the station reports errors until it is restarted.
"""

from __future__ import annotations

import asyncio
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

from tsgt.errors import InstrumentError
from tsgt.model import Status

if TYPE_CHECKING:
    import numpy as np

    from tsgt.clock import Clock
    from tsgt.radio import Radio
    from tsgt.station import Instrument, Reading

TIME_FORMAT = struct.Struct("<II")
MEASUREMENT_FORMAT = struct.Struct("<BBdddII")
_STATUS = {
    Status.OK: 0,
    Status.LOW_ACCURACY: 0,
    Status.TILT: 1,
    Status.WRONG_DISTANCE: 2,
    Status.NO_TARGET: 3,
    Status.ERROR: 3,
    Status.ANGLE_ONLY: 4,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class AuthorsTiming:
    """Delays of the authors' program.

    Attributes
    ----------
    transfer_ns
        One transfer from the radio chip (two bytes at 500 kHz); a packet takes five, plus one per byte.
    """

    poll_interval_ns: int = 1_000_000  # polling interval of the radio
    transfer_ns: int = 33_000
    pause_ns: int = 10_000_000  # before a station sends a measurement, and between two polls of the master
    timeout_ns: int = 250_000_000  # of the master, for a reply


AUTHORS_TIMESTAMP_DELAY_MS = 0.7
"""Mean timestamp delay of their ping: half a polling interval, 0.5 ms, and seven transfers for a packet of two bytes,
0.23 ms. The master's ``timestamp_delay_ms`` for these stations.
"""


class PolledRadio:
    """A radio as their program sees it: packets arrive late, and those from before the last transmission are lost."""

    def __init__(self, radio: Radio, clock: Clock, rng: np.random.Generator, timing: AuthorsTiming) -> None:
        self._radio = radio
        self._clock = clock
        self._rng = rng
        self._timing = timing
        self._listening_since_ns = -1

    async def send(self, payload: bytes) -> None:
        """Transmit a packet."""
        sent = await self._radio.transmit(payload)
        self._listening_since_ns = sent.done_at_ns

    async def receive(self) -> bytes:
        """Return the next packet."""
        packet = await self._radio.receive()
        while packet.received_at_ns <= self._listening_since_ns:
            packet = await self._radio.receive()
        late_ns = int(self._rng.integers(self._timing.poll_interval_ns))
        late_ns += (5 + len(packet.payload)) * self._timing.transfer_ns
        await self._clock.sleep_until(packet.received_at_ns + late_ns)
        return packet.payload

    async def pause(self) -> None:
        """Wait for the pause of the timing."""
        await self._clock.sleep_until(self._clock.monotonic_ns() + self._timing.pause_ns)


class AuthorsNode:
    """A station with the authors' software.

    Parameters
    ----------
    radio
        Already started.
    clock
        Measurements and pings are timestamped with its Unix time.
    prism
        The prism to track from the start.
    rng
        Draws polling delays, and the time it sends with an error.
    """

    def __init__(
        self,
        station: int,
        radio: Radio,
        clock: Clock,
        instrument: Instrument,
        prism: int,
        rng: np.random.Generator,
        timing: AuthorsTiming = AuthorsTiming(),
    ) -> None:
        self._station = station
        self._radio = PolledRadio(radio, clock, rng, timing)
        self._clock = clock
        self._instrument = instrument
        self._prism = prism
        # -1.0 converted to uint32: 0 on ARM, all ones on x86.
        self._no_time = int(rng.choice([0, 0xFFFF_FFFF]))
        self._newest = MEASUREMENT_FORMAT.pack(station, 0, 0.0, 0.0, 0.0, 0, 0)
        self._stamp_ns = 0
        self._synchronising = False
        self._direct = False
        self._reader: asyncio.Task[None] | None = None

    async def run(self) -> NoReturn:
        """Track and respond until cancelled.

        Raises
        ------
        InstrumentError
            No instrument or no prism at the start.
        RadioError
            The radio failed.
        """
        await self._instrument.connect()
        await self._instrument.track(self._prism)
        self._reader = asyncio.create_task(self._read(), name=f"authors-node-{self._station}")
        try:
            while True:
                reply = await self._reply_to(await self._radio.receive())
                if reply is not None:
                    await self._radio.send(reply)
        finally:
            await self._stop_reading()
            await self._instrument.close()

    async def _read(self) -> None:
        try:
            while True:
                reading = await self._instrument.read()
                self._newest = self._packed(reading, *divmod(self._clock.realtime_ns(), 1_000_000_000))
        except InstrumentError:
            self._newest = self._failure(3)

    async def _reply_to(self, payload: bytes) -> bytes | None:
        if len(payload) not in (2, 3) or payload[1:2] != str(self._station).encode():
            return None
        letter = payload[:1]
        if self._synchronising:
            match letter:
                case b"e":
                    self._stamp_ns = self._clock.realtime_ns()
                    return payload
                case b"s":
                    return b"s" + TIME_FORMAT.pack(*divmod(self._stamp_ns, 1_000_000_000))
                case b"c":
                    self._synchronising = False
            return None
        match letter:
            case b"p":
                self._synchronising = True
            case b"t":
                if self._direct:
                    self._newest = await self._measure_once()
                await self._radio.pause()
                return self._newest
            case b"d":
                return b"dOk" if self._direct or await self._enter_direct_mode() else b"dNo"
            case b"n":
                return b"nOk" if not self._direct or await self._track(payload[2:]) else b"nNo"
        return None

    async def _enter_direct_mode(self) -> bool:
        await self._stop_reading()
        try:
            await self._instrument.direct()
        except InstrumentError:
            self._reader = asyncio.create_task(self._read())
            return False
        self._direct = True
        return True

    async def _track(self, prism: bytes) -> bool:
        try:
            await self._instrument.track(int(prism) if prism.isdigit() else self._prism)
        except InstrumentError:
            return False
        self._direct = False
        self._reader = asyncio.create_task(self._read())
        return True

    async def _measure_once(self) -> bytes:
        try:
            reading = await self._instrument.measure()
        except InstrumentError:
            return self._failure(3)
        time_ns = reading.instrument_time_ns  # the instrument's UTC in whole seconds
        return self._packed(
            reading, (self._clock.realtime_ns() if time_ns is None else time_ns) // 1_000_000_000, 0
        )

    async def _stop_reading(self) -> None:
        if self._reader is not None:
            self._reader.cancel()
            await asyncio.wait([self._reader])
            if not self._reader.cancelled():
                self._reader.result()  # raises errors other than the instrument's
            self._reader = None

    def _packed(self, reading: Reading, seconds: int, nanoseconds: int) -> bytes:
        status = _STATUS[reading.status]
        if status in (1, 2, 3):
            return self._failure(status)
        return MEASUREMENT_FORMAT.pack(
            self._station,
            status,
            reading.zenith_angle_rad,
            reading.horizontal_angle_rad,
            0.0 if status == 4 else reading.slope_distance_m or 0.0,
            seconds,
            nanoseconds,
        )

    def _failure(self, status: int) -> bytes:
        return MEASUREMENT_FORMAT.pack(self._station, status, -1.0, -1.0, -1.0, self._no_time, self._no_time)
