"""A total station that is connected again and again, read, and given the master's orders between two readings."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.errors import InstrumentError
from tsgt.radio.orders import DirectOrder, MeasureOrder, Order, SearchOrder, TrackOrder

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.station.instrument import Instrument, Reading
    from tsgt.station.session import Session

FIRST_PAUSE_NS = 100_000_000
LONGEST_PAUSE_NS = 5_000_000_000

CLOSE_TIMEOUT_S = 0.5
"""How long an instrument has to be let go at the end; the program ends within a second."""

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Done:
    """What became of an order.

    Attributes
    ----------
    order
        The order.
    ok
        Whether the instrument has done it.
    reading
        What a :class:`~tsgt.radio.orders.MeasureOrder` has given; None for others, and when it failed.
    """

    order: Order
    ok: bool
    reading: Reading | None = None


class InstrumentKeeper:
    """The one owner of an instrument.

    Parameters
    ----------
    instrument
        It is connected here, and closed at the end.
    session
        Knows what the instrument is to do.
    clock
        Sets the pace of new attempts.
    on_reading
        Gets every reading of the tracked prism, within the same step of the event loop that read it.
    on_done
        Gets what became of each order, exactly once.

    Attributes
    ----------
    description
        Name and number of the instrument; None while there is no connection.
    """

    def __init__(
        self,
        instrument: Instrument,
        session: Session,
        clock: Clock,
        *,
        on_reading: Callable[[Reading], None],
        on_done: Callable[[Done], None],
    ) -> None:
        self._instrument = instrument
        self._session = session
        self._clock = clock
        self._on_reading = on_reading
        self._on_done = on_done
        self._order: Order | None = None
        self._ordered = asyncio.Event()
        self._reading: asyncio.Timeout | None = None
        self.description: str | None = None

    def give(self, order: Order) -> None:
        """Have an order carried out, as soon as the instrument is free; one at a time.

        It fails at once without an instrument, and so does a single measurement while a prism is tracked.
        """
        tracking = self._session.mode == "tracking"
        if self.description is None or (tracking and isinstance(order, MeasureOrder)):
            self._on_done(Done(order, ok=False))
            return
        self._order = order
        self._ordered.set()
        if self._reading is not None and not self._reading.expired():
            self._reading.reschedule(0)  # which cancels the reading

    async def keep(self) -> NoReturn:
        """Connect, read, and after an error connect again, for ever; the pause grows from 0.1 s to 5 s."""
        pause_ns, logged = FIRST_PAUSE_NS, ""
        try:
            while True:
                began_ns = self._clock.monotonic_ns()
                try:
                    await self._use()
                except InstrumentError as error:
                    if self._clock.monotonic_ns() - began_ns > LONGEST_PAUSE_NS:
                        pause_ns, logged = FIRST_PAUSE_NS, ""
                    if str(error) != logged:
                        logged = str(error)
                        log.error("instrument_lost", error=logged)  # noqa: TRY400 (the message says it all)
                self.description = None
                self._refuse()
                await self._close()
                await self._clock.sleep_until(self._clock.monotonic_ns() + pause_ns)
                pause_ns = min(2 * pause_ns, LONGEST_PAUSE_NS)
        finally:
            await self._close()

    async def _use(self) -> NoReturn:
        description = await self._instrument.connect()
        if self._session.mode == "tracking":
            await self._instrument.track(self._session.prism)
        else:
            await self._instrument.direct()
        self.description = description
        log.info("instrument_connected", instrument=description)
        while True:
            if self._order is not None:
                await self._execute(self._order)
            elif self._session.mode == "direct":
                await self._ordered.wait()
            elif (reading := await self._read()) is not None:
                self._on_reading(reading)

    async def _read(self) -> Reading | None:
        """Return the next reading, or None as soon as there is an order."""
        try:
            async with asyncio.timeout(None) as self._reading:
                return await self._instrument.read()
        except TimeoutError:
            if self._order is None:
                raise
            return None
        finally:
            self._reading = None

    async def _execute(self, order: Order) -> None:
        reading = None
        if not self._session.is_done_already(order):
            match order:
                case TrackOrder(prism):
                    await self._instrument.track(prism or self._session.prism)
                case SearchOrder():
                    await self._instrument.track(self._session.prism)
                case DirectOrder():
                    await self._instrument.direct()
                case MeasureOrder():
                    reading = await self._instrument.measure()
        self._clear()
        self._on_done(Done(order, ok=True, reading=reading))

    def _refuse(self) -> None:
        """Answer the order that the instrument failed at, or did not come to."""
        if (order := self._order) is not None:
            self._clear()
            self._on_done(Done(order, ok=False))

    def _clear(self) -> None:
        self._order = None
        self._ordered.clear()

    async def _close(self) -> None:
        with suppress(InstrumentError, TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await self._instrument.close()
