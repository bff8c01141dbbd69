"""A total station that is connected again and again, read, and told what people want between two readings."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.radio import DirectOrder, MeasureOrder, Order, SearchOrder, TrackOrder

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.recording.journal import InstrumentRecord
    from tsgt.station.instrument import Atmosphere, Condition, Instrument, Reading
    from tsgt.station.session import Session

FIRST_PAUSE_NS = 100_000_000

LONGEST_PAUSE_NS = 1_000_000_000
"""An instrument that was unplugged is to measure again within three seconds of being back."""

STEADY_NS = 5_000_000_000
"""After a connection that has lasted longer, pauses are short again and an error is worth a line in the log again."""

CHECK_S = 2.0
"""While single measurements are made nothing else would tell that the instrument is gone."""

CLOSE_TIMEOUT_S = 0.5
"""How long an instrument has to be let go at the end; the program ends within a second."""

NOT_CONNECTED = "no instrument is connected; it gets this when it is"

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
        What a :class:`~tsgt.radio.commands.MeasureOrder` has given; None for others, and when it failed.
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
    on_record
        Gets what is known of the instrument and of its settings, after each connection and each change, before the
        first reading that it applies to.
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
        on_record: Callable[[InstrumentRecord], None],
        on_done: Callable[[Done], None],
    ) -> None:
        self._instrument = instrument
        self._session = session
        self._clock = clock
        self._on_reading = on_reading
        self._on_record = on_record
        self._on_done = on_done
        self._order: Order | None = None
        # What was asked for while running; it is set again after each connection.
        self._atmosphere: Atmosphere | None = None
        self._atmosphere_due = False
        self._atmosphere_answer: asyncio.Future[str] | None = None
        self._wanted = asyncio.Event()
        self._reading: asyncio.Timeout | None = None
        self._record: InstrumentRecord | None = None
        self._connected_ns = 0
        self._error = ""
        self.description: str | None = None

    @property
    def condition(self) -> Condition:
        """How the instrument does; without a connection the problem is why there is none."""
        condition = self._instrument.condition
        return condition if self.description is not None else replace(condition, problem=self._error)

    def give(self, order: Order) -> None:
        """Have an order carried out, as soon as the instrument is free; one at a time.

        It fails at once without an instrument, and so does a single measurement while a prism is tracked.
        """
        tracking = self._session.mode == "tracking"
        if self.description is None or (tracking and isinstance(order, MeasureOrder)):
            self._on_done(Done(order, ok=False))
            return
        self._order = order
        self._interrupt()

    async def set_atmosphere(self, atmosphere: Atmosphere) -> str:
        """Have the instrument correct for this air as soon as it is free, and again after each connection.

        Returns
        -------
        str
            Why it does not yet, or will not; empty when it does.
        """
        _answer(self._atmosphere_answer, "another request came after this one")
        self._atmosphere = atmosphere
        if self.description is None:
            return NOT_CONNECTED
        self._atmosphere_due = True
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._atmosphere_answer = answer
        self._interrupt()
        return await answer

    async def keep(self) -> NoReturn:
        """Connect, read, and after an error connect again, for ever; the pause grows from 0.1 s to 1 s."""
        pause_ns, logged = FIRST_PAUSE_NS, ""
        try:
            while True:
                try:
                    await self._use()
                except InstrumentError as error:
                    if (task := asyncio.current_task()) is not None and task.cancelling():
                        # Told to stop in the very moment in which the instrument failed: the error took the place of that.
                        raise asyncio.CancelledError from None
                    if self.description and self._clock.monotonic_ns() - self._connected_ns > STEADY_NS:
                        pause_ns, logged = FIRST_PAUSE_NS, ""
                    self._error = str(error)
                    if self._error != logged:
                        logged = self._error
                        log.error("instrument_lost", error=logged)  # noqa: TRY400 (the message says it all)
                self.description = None
                self._refuse()
                await self._close()
                await self._clock.sleep_until(self._clock.monotonic_ns() + pause_ns)
                pause_ns = min(2 * pause_ns, LONGEST_PAUSE_NS)
        finally:
            await self._close()

    async def _use(self) -> NoReturn:
        self._record, self._atmosphere_due = None, False
        description = await self._instrument.connect()
        if self._session.mode == "tracking":
            await self._instrument.track(self._session.prism)
        else:
            await self._instrument.direct()
        self.description = description
        self._connected_ns = self._clock.monotonic_ns()
        log.info("instrument_connected", instrument=description)
        self._atmosphere_due = self._atmosphere is not None
        while True:
            self._note_record()
            if self._atmosphere_due and self._atmosphere is not None:
                await self._set_atmosphere(self._atmosphere)
            elif self._order is not None:
                await self._execute(self._order)
            elif self._session.mode == "direct":
                await self._wait()
            elif (reading := await self._read()) is not None:
                self._note_record()
                self._on_reading(reading)

    async def _wait(self) -> None:
        """Wait until somebody wants something, and see now and then whether the instrument is still there."""
        try:
            async with asyncio.timeout(CHECK_S):
                await self._wanted.wait()
        except TimeoutError:
            await self._instrument.check()
        else:
            self._wanted.clear()

    def _note_record(self) -> None:
        record = self._instrument.record
        if record is not None and record != self._record:
            self._record = record
            self._on_record(record)

    def _interrupt(self) -> None:
        """Wake whoever waits for a reading, or for somebody to want something."""
        self._wanted.set()
        if self._reading is not None and not self._reading.expired():
            self._reading.reschedule(0)  # which cancels the reading

    async def _read(self) -> Reading | None:
        """Return the next reading, or None as soon as somebody wants something."""
        try:
            async with asyncio.timeout(None) as self._reading:
                return await self._instrument.read()
        except TimeoutError:
            if self._order is None and not self._atmosphere_due:
                raise
            return None
        finally:
            self._reading = None

    async def _execute(self, order: Order) -> None:
        reading, ok = None, True
        try:
            if not self._session.is_done_already(order):
                reading = await self._obey(order)
        except InstrumentRefusedError as error:
            log.warning("order_refused", order=type(order).__name__, error=str(error))
            ok = False
        self._order = None
        self._note_record()
        self._on_done(Done(order, ok=ok, reading=reading))

    async def _obey(self, order: Order) -> Reading | None:
        match order:
            case TrackOrder(prism):
                await self._instrument.track(prism or self._session.prism)
            case SearchOrder(towards):
                await self._instrument.track(self._session.prism, towards)
            case DirectOrder():
                await self._instrument.direct()
            case MeasureOrder():
                return await self._instrument.measure()
        return None

    async def _set_atmosphere(self, atmosphere: Atmosphere) -> None:
        answer, self._atmosphere_answer = self._atmosphere_answer, None
        self._atmosphere_due = False
        air = {"temperature_c": atmosphere.temperature_c, "pressure_hpa": atmosphere.pressure_hpa}
        problem = NOT_CONNECTED
        try:
            await self._instrument.set_atmosphere(atmosphere)
        except InstrumentRefusedError as error:
            problem = str(error)
            log.warning("atmosphere_refused", **air, error=problem)
            if self._atmosphere is atmosphere:
                self._atmosphere = None
        else:
            problem = ""
            log.info("atmosphere_set", **air)
            self._note_record()
        finally:
            _answer(answer, problem)

    def _refuse(self) -> None:
        """Answer those whom the instrument failed, or did not come to."""
        _answer(self._atmosphere_answer, NOT_CONNECTED)
        self._atmosphere_answer = None
        if (order := self._order) is not None:
            self._order = None
            self._on_done(Done(order, ok=False))

    async def _close(self) -> None:
        with suppress(InstrumentError, TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await self._instrument.close()


def _answer(answer: asyncio.Future[str] | None, problem: str) -> None:
    if answer is not None and not answer.done():  # done: whoever asked is gone
        answer.set_result(problem)
