"""Tracking with a Leica instrument: its distances, each once, its lock watched, its prism looked for when it is lost."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

import structlog

from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.station.geocom import Rpc, Verdict, name_of, verdict
from tsgt.station.leica.measurement import REPEAT_NS, FullMeasurement, Readings, full_measurement
from tsgt.station.leica.reacquisition import (
    LOOKING,
    NARROWEST_RAD,
    WIDEST_ADJUST_RAD,
    Handover,
    Lock,
    Look,
    LossSequence,
    Pointing,
    apart_rad,
    pointing_at,
)
from tsgt.station.leica.search import Finder, LicenceMissing, pointing
from tsgt.station.leica.setup import clear
from tsgt.station.leica.timing import IDLE_NS, Pace

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.radio import Direction
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.instrument import Reading
    from tsgt.station.leica.timing import InstrumentTimes

log = structlog.get_logger()

WAIT_MS: Final = 100
"""How long an instrument without a distance waits for one before it answers: lost prisms are noticed this fast."""

_POLL_S: Final = 1.5  # instruments pause for 0.7 s now and then
_LOCK_NS: Final = 2_000_000_000  # between two looks at the lock, while distances come
_LOST_LOCK_NS: Final = 250_000_000  # and while they do not
_STALE_NS: Final = 1_500_000_000  # the same distance for longer than this is no tracking
_GAP_NS: Final = 600_000_000
_RESTART_NS: Final = 3_000_000_000
_STARTING_NS: Final = 600_000_000
_SURE: Final = 3  # an answer that nothing can be done about is asked for again
_UNSAID: Final = 12  # asked so often, an instrument that never says whether it is locked in is taken at not
_ROOM_NS: Final = 120_000_000
_ADJUST = 2 * NARROWEST_RAD


class Tracking:
    """What tracks, over one connection.

    Parameters
    ----------
    line
        To the instrument.
    clock
        Of the host.
    times
        Puts distances in time; outlives the connection.
    sequence
        Says what to do about a lost prism; outlives the connection.
    finder
        Searches; None without the licence for it: a person points then, and nothing is moved.

    Attributes
    ----------
    activity
        What is being done, for people.
    call_for
        What a person is asked to do; empty when nothing.
    tilted
        Whether the instrument says that it is not level.
    finder
        The same; gone when the instrument says that the licence is missing.
    """

    def __init__(
        self,
        line: GeoComConnection,
        clock: Clock,
        times: InstrumentTimes,
        sequence: LossSequence,
        finder: Finder | None,
    ) -> None:
        self._line = line
        self._clock = clock
        self._times = times
        self._sequence = sequence
        self.finder = finder
        self.activity = ""
        self.call_for = ""
        self.tilted = False
        self._pace = Pace()
        self._lock = Lock.OUT
        self._lock_unsaid = _UNSAID
        self._lock_asked_ns = 0
        self._good_from_ns = 0
        self._lost_ns: int | None = None
        self._handover: Handover | None = None
        self._search: asyncio.Task[bool] | None = None
        self._rounds = 0
        self._round_trip_ns = _ROOM_NS
        self._next_ns = 0
        self._started_ns = 0
        self._last_new_ns = 0
        self._unavailable = 0
        self._readings = Readings(0, times.latency_ns)

    # --- What is tracked --------------------------------------------------------------------------------------

    async def start(self, prism: int) -> None:
        """Begin with a prism. An instrument that is locked in on one already keeps that."""
        self._readings.prism = prism
        self.activity = f"beginning with prism {prism}"
        if self.finder is not None:
            await self._ask_lock(self.finder)
        await self.measure()

    async def measure(self) -> None:
        """Have distances taken, from now on, whatever has stopped that."""
        await self._line.call(Rpc.TMC_DO_MEASURE, 1, 1)
        self._started_ns = self._last_new_ns = self._clock.monotonic_ns()
        self._next_ns = 0

    @property
    def prism(self) -> int:
        """Number of the prism."""
        return self._readings.prism

    @property
    def waits_for_person(self) -> bool:
        """Whether the prism was changed, and the new one has not been found."""
        return self._handover is not None

    async def look_for(self, towards: Direction | None) -> None:
        """Look for the prism now, unless it is locked in on, and where it is believed to be."""
        if self._handover is not None:
            if towards is not None:
                await self._look_once(towards)
            return
        if towards is None:
            if self._lock is not Lock.IN and self._search is None:
                self._sequence.restart(None, self._clock.monotonic_ns())
            return
        if self._lock is Lock.IN and await self._points_at(towards):
            return
        again = self._sequence.restart(towards, self._clock.monotonic_ns())
        # While it locks in, it is not sent elsewhere: with an order every few seconds it might never come to an end.
        if not again and not (self.finder is not None and self.finder.has_found):
            await self.stop_search()
        if self._lock is Lock.IN:
            await self._let_go()

    async def change(self, prism: int, towards: Direction | None) -> None:
        """Let the prism go and take another; a person points at it unless its direction is known."""
        await self.stop_search()
        await self._let_go()
        self._sequence.forget()
        self._readings.prism = prism
        self._handover = Handover(await pointing(self._line), self._clock.monotonic_ns())
        if towards is None or not await self._look_once(towards):
            await self._call(f"point the telescope at prism {prism}")

    async def _look_once(self, towards: Direction) -> bool:
        """Look for a prism that was not tracked before in one place alone: elsewhere there may be others."""
        if self.finder is None:
            return False
        await self.stop_search()
        size_rad = min(max(2 * towards.spread_rad, NARROWEST_RAD), WIDEST_ADJUST_RAD)
        self._begin(
            self.finder,
            Look("looking where the master says", False, pointing_at(towards), size_rad, size_rad),
        )
        return True

    async def stop_search(self, *, go_on: bool = True) -> None:
        """End a search that is under way, and go on measuring."""
        search, self._search = self._search, None
        if search is None:
            return
        running = not search.done()
        search.cancel()
        await asyncio.wait({search})
        if not search.cancelled():
            search.exception()
        if running:
            await self._line.abort()
            if go_on:
                await self.measure()

    async def _let_go(self) -> None:
        if self.finder is not None:
            try:
                await self.finder.release()
            except LicenceMissing:
                self._give_up_searching()
        await clear(self._line)
        self._lock = Lock.OUT
        await self.measure()
        self._good_from_ns = self._started_ns

    async def _points_at(self, towards: Direction) -> bool:
        here = await pointing(self._line)
        return here is not None and apart_rad(here, pointing_at(towards)) <= towards.spread_rad

    # --- Readings ---------------------------------------------------------------------------------------------

    async def read(self) -> Reading:
        """Return the next reading."""
        while True:
            reading = await (self._poll() if self._search is None else self._wait_for(self._search))
            if reading is not None:
                return reading

    async def _poll(self) -> Reading | None:
        now_ns = self._clock.monotonic_ns()
        # Now and then, while no distance can be there; or else less often.
        lock_ns = _LOCK_NS if self._next_ns - now_ns >= _ROOM_NS else 2 * _LOCK_NS
        if self.finder is not None and now_ns - self._lock_asked_ns >= lock_ns:
            await self._ask_lock(self.finder)
        else:
            await self._times.keep_known(self._line, self._clock, self._next_ns)
        now_ns = self._clock.monotonic_ns()
        if self._next_ns - now_ns > 1_000_000:
            await self._clock.sleep_until(self._next_ns)
        reply = await self._line.call(Rpc.TMC_GET_FULL_MEAS, WAIT_MS, 1, timeout_s=_POLL_S)
        self._round_trip_ns = min(self._round_trip_ns, reply.first_byte_ns - reply.sent_ns)
        judged = verdict(reply.code, has_values=bool(reply.values))
        if judged is Verdict.SHUT_DOWN:
            raise InstrumentError("the instrument is switching off")
        self._unavailable = self._unavailable + 1 if judged is Verdict.UNAVAILABLE else 0
        if self._unavailable >= _SURE:
            raise InstrumentError(
                f"the instrument does not know TMC_GetFullMeas ({name_of(reply.code)}), so that distances have no times;"
                " it takes a TPS1200+ or newer"
            )
        if judged is Verdict.BUSY and reply.first_byte_ns - self._last_new_ns < _STALE_NS:
            self._next_ns = self._clock.monotonic_ns() + IDLE_NS
            return None
        measured = full_measurement(reply)
        self.tilted = measured.status is Status.TILT
        if measured.time_ms is None:
            return await self._without(measured)
        return await self._with_distance(measured, measured.time_ms)

    async def _with_distance(self, measured: FullMeasurement, time_ms: int) -> Reading | None:
        if not self._times.is_new(time_ms):
            if measured.first_byte_ns - self._last_new_ns < max(_STALE_NS, 3 * (self._pace.interval_ns or 0)):
                return None
            return await self._without(measured._replace(status=Status.NO_TARGET))
        stamp = self._times.stamp(measured)
        # After a gap the prism may be gone, and another one cross the line of sight.
        gap = measured.first_byte_ns - self._last_new_ns > max(_GAP_NS, 3 * (self._pace.interval_ns or 0))
        if self.finder is not None and (gap or self._lock is not Lock.IN) and self._handover is None:
            await self._ask_lock(self.finder)
        self._times.given(time_ms)
        self._pace.distance(time_ms)
        self._last_new_ns = measured.first_byte_ns
        if stamp is None:
            return None
        if self._handover is not None or (self.finder is not None and self._lock is not Lock.IN):
            return await self._without(measured._replace(status=Status.NO_TARGET))
        if stamp.at_ns < self._good_from_ns:
            return None
        self._next_ns = self._pace.next_ns(stamp.at_ns + self._times.latency_ns, self._round_trip_ns)
        self._found(Pointing(measured.horizontal_angle_rad, measured.zenith_angle_rad))
        return self._readings.with_distance(measured, stamp)

    async def _without(self, measured: FullMeasurement) -> Reading | None:
        """Do what is to be done without a distance, and tell why there is none, unless that was told just now."""
        now_ns = self._clock.monotonic_ns()
        self._next_ns = now_ns + IDLE_NS
        if self._handover is not None:
            await self._hand_over(self._handover)
        elif self.finder is not None:
            if now_ns - self._lock_asked_ns >= _LOST_LOCK_NS:
                await self._ask_lock(self.finder)
            if measured.status is not Status.TILT and not self._lock_unsaid:
                await self._look(self.finder)
        if self._search is None and now_ns - self._last_new_ns > _RESTART_NS:
            await self.measure()
        starting = (self.finder is None or self._lock is Lock.IN) and now_ns - self._started_ns < _STARTING_NS
        status = measured.status
        if status is Status.ANGLE_ONLY and self.finder is not None and self._lock is not Lock.IN:
            status = Status.NO_TARGET
        if starting and status in (Status.ANGLE_ONLY, Status.NO_TARGET):
            return None
        return self._readings.without(measured._replace(status=status))

    # --- The lock ---------------------------------------------------------------------------------------------

    async def _ask_lock(self, finder: Finder) -> None:
        lock = await finder.lock()
        if lock is not None:  # what was so is still so: a search would end a lock
            self._lock = lock
        self._lock_unsaid = max(self._lock_unsaid - 1, 0) if lock is None else 0
        self._lock_asked_ns = self._clock.monotonic_ns()
        if self._lock is Lock.IN:
            self.call_for = ""
        elif self._lost_ns is None:
            self._lost_ns = self._lock_asked_ns
            log.info("prism_lost", prism=self.prism)

    def _found(self, where: Pointing) -> None:
        if self._lost_ns is not None:
            after_s = (self._clock.monotonic_ns() - self._lost_ns) / 1e9
            log.info("prism_found", prism=self.prism, after_s=round(after_s, 1))
            self._lost_ns = None
        self._rounds = 0
        self.call_for = ""
        self.activity = f"tracking prism {self.prism}"
        self._sequence.seen(where)

    async def _look(self, finder: Finder) -> None:
        """Start the next search, if it is time for one."""
        look = self._sequence.next(self._lock, self._clock.monotonic_ns())
        if look is not None:
            self._begin(finder, look)
            return
        if self._lock is Lock.PREDICTION:
            self.activity = "waiting for the prism to come back"
        elif self._lock is Lock.OUT:
            self.activity = "pausing between searches"
            if self._sequence.rounds > self._rounds:
                self._rounds = self._sequence.rounds
                await self._call(f"point the telescope at prism {self.prism}, it is not found")

    async def _hand_over(self, handover: Handover) -> None:
        """See whether a person has pointed the telescope at the other prism."""
        self.activity = f"waiting for the telescope to be pointed at prism {self.prism}"
        finder, now_ns = self.finder, self._clock.monotonic_ns()
        if finder is not None and now_ns - self._lock_asked_ns > 1_000_000_000:
            await self._ask_lock(finder)
            if self._lock is Lock.IN:  # by hand
                self._take_over()
                return
        here = await pointing(self._line)
        if here is None or not handover.points(here, now_ns):
            return
        if finder is not None:
            self._begin(
                finder, Look(LOOKING, sweep=False, centre=None, width_rad=_ADJUST, height_rad=_ADJUST)
            )
        else:
            self._take_over()

    def _take_over(self) -> None:
        self._handover = None
        self.call_for = ""
        self._good_from_ns = self._clock.monotonic_ns()

    def _begin(self, finder: Finder, look: Look) -> None:
        self.activity = look.name
        self._search = asyncio.create_task(finder.look(look))

    async def _wait_for(self, search: asyncio.Task[bool]) -> Reading | None:
        """Wait for a search to end, but not longer than until it is time to say that there is no prism."""
        await asyncio.wait({search}, timeout=REPEAT_NS / 1e9)
        if not search.done():
            now_ns = self._clock.monotonic_ns()
            return self._readings.without(FullMeasurement(0.0, 0.0, None, None, Status.NO_TARGET, 0, now_ns))
        self._search = None
        try:
            locked = search.result()
        except LicenceMissing:
            locked = False
            self._give_up_searching()
        now_ns = self._clock.monotonic_ns()
        self._lock = Lock.IN if locked else Lock.OUT
        # One that has found nothing does not tell whether a person has locked in meanwhile: the next would undo that.
        self._lock_asked_ns = now_ns if locked else 0
        if locked:
            self._take_over()
        elif self._handover is not None:
            # It may have been turned by itself: only from here on it is a person who turns it.
            self._handover = Handover(await pointing(self._line), now_ns)
            await self._call(f"point the telescope at prism {self.prism}")
        await self.measure()
        return None

    async def _call(self, for_what: str) -> None:
        """Ask a person to do something, and beep."""
        self.call_for = for_what
        log.warning("operator_required", what=for_what)
        await self._line.call(Rpc.BMM_BEEP_ALARM)

    def _give_up_searching(self) -> None:
        """Go on without: the licence is missing."""
        if self.finder is not None:
            log.warning("licence_missing")
        self.finder = None
