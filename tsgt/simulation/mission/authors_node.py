"""A station and a master as the paper's authors have them in the field, written anew from descriptions of theirs.

They are here so that ours are tried against something that was not built from the same code: the bytes are packed on
the spot, and everything that makes theirs different from ours is kept:

- a packet is noticed by looking once in a millisecond, and read byte by byte; stamps are taken after that, on the
  machine's Unix clock, which may step;
- a station sends its newest measurement again and again, zeros before the first, and with an error -1 for everything
  and a time that means nothing; the prism constant is never applied;
- it does nothing else while it works on an order, and is in a mode of its own while it is synchronised;
- ``n`` with a prism changes nothing while it tracks.

Where the descriptions leave something open, the stricter reading is taken: outside that mode ``e`` and ``s`` are not
answered, inside it ``t``, ``d`` and ``n`` are not. A station whose instrument is gone says so for good.
"""

from __future__ import annotations

import asyncio
import struct
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, NamedTuple, NoReturn

from tsgt.errors import InstrumentError
from tsgt.model import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from tsgt.clock import Clock
    from tsgt.radio import Radio
    from tsgt.station import Instrument, Reading

_TIME = struct.Struct("<II")
_MEASUREMENT = struct.Struct("<BBdddII")
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
    """How long their program takes.

    Attributes
    ----------
    look_ns
        A packet is looked for this often.
    transfer_ns
        One transfer from the radio chip, two bytes at 500 kHz; a packet takes five, and one for each of its bytes.
    pause_ns
        Before a station sends a measurement, and between two polls of the master.
    timeout_ns
        How long the master waits for a reply.
    """

    look_ns: int = 1_000_000
    transfer_ns: int = 33_000
    pause_ns: int = 10_000_000
    timeout_ns: int = 250_000_000


AUTHORS_STAMP_DELAY_MS = 0.7
"""How late their node stamps a ping, on average: half a look, 0.5 ms, and the seven transfers of a packet of two
bytes, 0.23 ms. What a master is to be told as ``timestamp_delay_ms``."""


class _PolledRadio:
    """A radio as their program sees it: late, and deaf to what came before it last began to listen."""

    def __init__(self, radio: Radio, clock: Clock, rng: np.random.Generator, timing: AuthorsTiming) -> None:
        self._radio = radio
        self._clock = clock
        self._rng = rng
        self._timing = timing
        self._listening_since_ns = -1

    async def send(self, payload: bytes) -> None:
        sent = await self._radio.transmit(payload)
        self._listening_since_ns = sent.done_at_ns

    async def receive(self) -> bytes:
        packet = await self._radio.receive()
        while packet.received_at_ns <= self._listening_since_ns:
            packet = await self._radio.receive()
        late_ns = int(self._rng.integers(self._timing.look_ns))
        late_ns += (5 + len(packet.payload)) * self._timing.transfer_ns
        await self._clock.sleep_until(packet.received_at_ns + late_ns)
        return packet.payload

    async def pause(self) -> None:
        await self._clock.sleep_until(self._clock.monotonic_ns() + self._timing.pause_ns)


class AuthorsNode:
    """A station as the authors have it.

    Parameters
    ----------
    station
        Its number.
    radio
        Started.
    clock
        Of its computer; measurements and pings are stamped with its Unix time.
    instrument
        What it reads.
    prism
        What it tracks from the start.
    rng
        When it looks for packets, and what it sends for a time that it does not have.
    timing
        How long it takes.
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
        self._radio = _PolledRadio(radio, clock, rng, timing)
        self._clock = clock
        self._instrument = instrument
        self._prism = prism
        # -1.0 made a uint32: 0 on an ARM processor, all ones on an x86.
        self._no_time = int(rng.choice([0, 0xFFFF_FFFF]))
        self._newest = _MEASUREMENT.pack(station, 0, 0.0, 0.0, 0.0, 0, 0)
        self._stamp_ns = 0
        self._synchronising = False
        self._direct = False
        self._reader: asyncio.Task[None] | None = None

    async def run(self) -> NoReturn:
        """Track and answer until cancelled.

        Raises
        ------
        InstrumentError
            There is no instrument, or no prism, at the start.
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
                    return b"s" + _TIME.pack(*divmod(self._stamp_ns, 1_000_000_000))
                case b"c":
                    self._synchronising = False
            return None
        match letter:
            case b"p":
                self._synchronising = True
            case b"t":
                if self._direct:
                    self._newest = await self._shot()
                await self._radio.pause()
                return self._newest
            case b"d":
                return b"dOk" if self._direct or await self._leave_tracking() else b"dNo"
            case b"n":
                return b"nOk" if not self._direct or await self._track(payload[2:]) else b"nNo"
        return None

    async def _leave_tracking(self) -> bool:
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

    async def _shot(self) -> bytes:
        try:
            reading = await self._instrument.measure()
        except InstrumentError:
            return self._failure(3)
        time_ns = reading.instrument_time_ns  # here it is the instrument's own UTC, without a fraction
        return self._packed(
            reading, (self._clock.realtime_ns() if time_ns is None else time_ns) // 1_000_000_000, 0
        )

    async def _stop_reading(self) -> None:
        if self._reader is not None:
            self._reader.cancel()
            await asyncio.wait([self._reader])
            if not self._reader.cancelled():
                self._reader.result()  # an error that is none of the instrument's
            self._reader = None

    def _packed(self, reading: Reading, seconds: int, nanoseconds: int) -> bytes:
        status = _STATUS[reading.status]
        if status in (1, 2, 3):
            return self._failure(status)
        return _MEASUREMENT.pack(
            self._station,
            status,
            reading.zenith_angle_rad,
            reading.horizontal_angle_rad,
            0.0 if status == 4 else reading.slope_distance_m or 0.0,
            seconds,
            nanoseconds,
        )

    def _failure(self, status: int) -> bytes:
        return _MEASUREMENT.pack(self._station, status, -1.0, -1.0, -1.0, self._no_time, self._no_time)


class AuthorsMeasurement(NamedTuple):
    """What their master takes out of a reply, unchecked."""

    station: int
    status: int
    zenith_angle_rad: float
    horizontal_angle_rad: float
    slope_distance_m: float
    seconds: int
    nanoseconds: int


class AuthorsMaster:
    """A master as the authors have it.

    Parameters
    ----------
    stations
        Whom it polls, in this order.
    radio, clock, rng, timing
        As for :class:`AuthorsNode`.
    initial_cycles, cycles
        Of the first synchronisation of each station, and of later ones.

    Attributes
    ----------
    offset_ns
        By station; positive: its clock is ahead of the master's. Clocks of different machines: no more exact.
    measurements
        Everything that came, repeats included.
    """

    INTERVAL_NS = 300_000_000_000
    """From one round of synchronisations to the next."""
    STAGGER_NS = 10_000_000_000
    """Between the stations of such a round."""
    WEIGHT = 0.1
    """Of a later synchronisation against what was there before."""

    def __init__(
        self,
        stations: Sequence[int],
        radio: Radio,
        clock: Clock,
        rng: np.random.Generator,
        timing: AuthorsTiming = AuthorsTiming(),
        *,
        initial_cycles: int = 50,
        cycles: int = 5,
    ) -> None:
        self._stations = stations
        self._radio = _PolledRadio(radio, clock, rng, timing)
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
        """Compare a station's clock with ours; without a single answer nothing changes."""
        first = station not in self.offset_ns
        await self._radio.send(b"p%d" % station)
        offsets_ns = []
        for _ in range(self._initial_cycles if first else self._cycles):
            begin_ns = self._clock.realtime_ns()
            if await self.ask(b"e%d" % station) != b"e%d" % station:
                continue
            end_ns = self._clock.realtime_ns()
            reply = await self.ask(b"s%d" % station)
            if reply is not None and len(reply) == 9:
                seconds, nanoseconds = _TIME.unpack(reply[1:])
                offsets_ns.append(seconds * 1_000_000_000 + nanoseconds - (begin_ns + end_ns) / 2)
        await self._radio.send(b"c%d" % station)
        if offsets_ns:
            new_ns = fmean(offsets_ns)
            old_ns = self.offset_ns.get(station, new_ns)
            self.offset_ns[station] = self.WEIGHT * new_ns + (1 - self.WEIGHT) * old_ns

    async def poll(self, station: int, timeout_ns: int | None = None) -> AuthorsMeasurement | None:
        """Ask for a measurement, or in direct mode for a single one; None without an answer in time."""
        reply = await self.ask(b"t%d" % station, timeout_ns)
        if reply is None or len(reply) != _MEASUREMENT.size:
            return None
        self.measurements.append(AuthorsMeasurement(*_MEASUREMENT.unpack(reply)))
        return self.measurements[-1]

    async def ask(self, payload: bytes, timeout_ns: int | None = None) -> bytes | None:
        """Send a command and return whatever comes next; None if nothing comes in time."""
        await self._radio.send(payload)
        try:
            async with asyncio.timeout((self._timing.timeout_ns if timeout_ns is None else timeout_ns) / 1e9):
                return await self._radio.receive()
        except TimeoutError:
            return None
