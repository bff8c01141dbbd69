"""Tracking with a Leica instrument: polls distances, each once, monitors the lock, and reacquires a lost target."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Final

import structlog

from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.station.geocom import Outcome, Rpc, name_of, outcome_of
from tsgt.station.leica.measurement import (
    STATUS_INTERVAL_NS,
    FullMeasurement,
    ReadingFactory,
    decode_full_measurement,
)
from tsgt.station.leica.reacquisition import (
    Lock,
    ManualPointingDetector,
    Pointing,
    ReacquisitionSequence,
    SearchWindow,
    angular_distance_rad,
    centre_of,
    window_at_direction,
    window_at_pointing,
)
from tsgt.station.leica.search import RoboticLicenceMissing, TargetSearch, lock_state, pointing
from tsgt.station.leica.setup import clear_distance

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.radio import Direction
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.instrument import Reading
    from tsgt.station.leica.timing import DistanceTimestamper

log = structlog.get_logger()

WAIT_MS: Final = 100
"""How long an instrument without a distance waits for one before it replies; bounds the delay of noticing a lost target."""

_POLL_TIMEOUT_S: Final = 1.5  # instruments pause for 0.7 s now and then
_IDLE_NS: Final = 100_000_000  # between two polls without a distance
_LOCK_INTERVAL_NS: Final = 2_000_000_000  # between two lock queries while distances arrive
_NO_LOCK_INTERVAL_NS: Final = 250_000_000  # and while they do not
_STALE_NS: Final = 1_500_000_000  # an unchanged distance for longer than this is no tracking
_GAP_NS: Final = 600_000_000
_RESTART_NS: Final = 3_000_000_000
_STARTUP_NS: Final = 600_000_000
_MAX_UNAVAILABLE: Final = 3  # a single such reply is not conclusive
_MAX_LOCK_QUERIES: Final = (
    12  # an instrument that never reports its lock state is then taken as not locked on
)
_LOCK_QUERY_NS: Final = 120_000_000

_INTERVALS: Final = 16
_MIN_INTERVALS: Final = 4
_MAX_INTERVAL_MS: Final = 5_000
_EARLY_NS: Final = 10_000_000  # polling starts this long before the next distance is due, as intervals vary
_PROBE_EVERY: Final = (
    24  # after this many distances one interval is polled throughout, to detect a higher rate
)


class PollScheduler:
    """Schedules polls from the interval of distances: between two, the instrument repeats the last one."""

    def __init__(self) -> None:
        self._last_ms: int | None = None
        self._intervals_ms: deque[int] = deque(maxlen=_INTERVALS)
        self._count = 0

    @property
    def interval_ns(self) -> int | None:
        """The shortest recent interval between two distances; None where it is unknown."""
        return min(self._intervals_ms) * 1_000_000 if len(self._intervals_ms) >= _MIN_INTERVALS else None

    def add_distance(self, instrument_ms: int) -> None:
        """Add the instrument's time of a new distance."""
        if self._last_ms is not None and 0 < instrument_ms - self._last_ms < _MAX_INTERVAL_MS:
            self._intervals_ms.append(instrument_ms - self._last_ms)
        self._last_ms = instrument_ms
        self._count += 1

    def next_ns(self, distance_ns: int, round_trip_ns: int) -> int:
        """Return when to poll after a distance, whose fastest reply could arrive at ``distance_ns``; 0: at once."""
        interval_ns = self.interval_ns
        if interval_ns is None or self._count % _PROBE_EVERY == 0:
            return 0
        return distance_ns + interval_ns - round_trip_ns - _EARLY_NS


class Tracking:
    """Tracking over one connection. ``timestamper`` and ``sequence`` outlive the connection.

    Attributes
    ----------
    activity
        Current activity, for the operator.
    operator_request
        Action required of the operator; empty for none.
    tilted
        Whether the instrument reports that it is not level.
    awaits_operator
        Whether the prism was changed, and the new one has not been found.
    target_search
        None without the licence for it: the operator points the telescope then, and nothing is moved.
    """

    def __init__(
        self,
        line: GeoComConnection,
        clock: Clock,
        timestamper: DistanceTimestamper,
        sequence: ReacquisitionSequence,
        target_search: TargetSearch | None,
    ) -> None:
        self._line = line
        self._clock = clock
        self._timestamper = timestamper
        self._sequence = sequence
        self.target_search = target_search
        self.activity = ""
        self.operator_request = ""
        self.tilted = False
        self.awaits_operator = False
        self._poll_scheduler = PollScheduler()
        self._lock = Lock.OUT
        self._lock_queries_left = _MAX_LOCK_QUERIES  # 0 once the lock state is known
        self._lock_queried_ns = 0
        self._valid_from_ns = 0
        self._lost_ns: int | None = None
        self._manual_pointing: ManualPointingDetector | None = None  # None: the old prism may still be locked
        self._search: asyncio.Task[bool] | None = None
        self._rounds = 0
        self._round_trip_ns = _LOCK_QUERY_NS
        self._next_poll_ns = 0
        self._started_ns = 0
        self._last_distance_ns = 0
        self._unavailable = 0
        self._readings = ReadingFactory(0, timestamper.latency_ns)

    # --- Commands ---------------------------------------------------------------------------------------------

    async def start(self, prism: int) -> None:
        """Start with a prism; an instrument that is locked on keeps its lock."""
        self._readings.prism = prism
        self.activity = f"starting with prism {prism}"
        if self.target_search is not None:
            await self._query_lock()
        await self.start_measuring()

    async def start_measuring(self) -> None:
        """Start continuous measurements."""
        await self._line.call(Rpc.TMC_DO_MEASURE, 1, 1)
        self._started_ns = self._last_distance_ns = self._clock.monotonic_ns()
        self._next_poll_ns = 0

    @property
    def prism(self) -> int:
        """Number of the tracked prism."""
        return self._readings.prism

    @property
    def searching(self) -> bool:
        """Whether a search is in progress; the instrument replies to nothing else meanwhile."""
        return self._search is not None

    async def search_for(self, towards: Direction | None) -> None:
        """Search for the prism now, at its expected direction, unless the instrument is locked on it."""
        if self.target_search is None:
            return
        if self.awaits_operator:
            if towards is not None and not self._locking_on:
                await self._search_once(towards)
            return
        if towards is None:
            if self._lock is not Lock.IN and self._search is None:
                self._sequence.restart(None, self._clock.monotonic_ns())
            return
        if self._lock is Lock.IN and await self._points_at(towards):
            return
        correction = self._sequence.restart(towards, self._clock.monotonic_ns())
        # A search that only has to lock on is not interrupted: commands every few seconds might never let it finish.
        if not correction and not self._locking_on:
            await self.stop_search()
        if self._lock is Lock.IN:
            await self._release_lock()

    async def change_prism(self, prism: int, towards: Direction | None) -> None:
        """Release the prism and track another one; the operator points at it unless its direction is known."""
        await self.stop_search()
        await self._release_lock()
        self._sequence.reset()
        self._readings.prism = prism
        self.awaits_operator, self._manual_pointing = True, None
        await self._watch_pointing()
        if towards is None or not await self._search_once(towards):
            release = "" if self._lock is Lock.OUT else "release the lock, then "
            await self._call_operator(f"{release}point the telescope at prism {prism}")

    @property
    def _locking_on(self) -> bool:
        return self._search is not None and self.target_search is not None and self.target_search.target_found

    async def _search_once(self, towards: Direction) -> bool:
        """Search for a new prism at its expected direction only: elsewhere there may be other prisms."""
        if self.target_search is None:
            return False
        await self.stop_search()
        self._start_search(self.target_search, window_at_direction(towards))
        return True

    async def stop_search(self, *, resume: bool = True) -> None:
        """Abort a search in progress, and resume measuring."""
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
            if resume:
                await self.start_measuring()

    async def _release_lock(self) -> None:
        """Release the lock; without the licence it remains. Raises InstrumentRefusedError if it remains otherwise."""
        if self.target_search is not None:
            try:
                self._lock = await self.target_search.release_lock()
            except RoboticLicenceMissing:
                self._disable_search()
        if self.target_search is None:
            await self._query_lock()
        await clear_distance(self._line)
        await self.start_measuring()
        self._valid_from_ns = self._started_ns

    async def _points_at(self, towards: Direction) -> bool:
        here = await pointing(self._line)
        return here is not None and angular_distance_rad(here, centre_of(towards)) <= towards.spread_rad

    # --- Readings ---------------------------------------------------------------------------------------------

    async def read(self) -> Reading:
        """Return the next reading."""
        while True:
            reading = await (self._poll() if self._search is None else self._wait_for(self._search))
            if reading is not None:
                return reading

    async def _poll(self) -> Reading | None:
        now_ns = self._clock.monotonic_ns()
        # The lock is queried while no distance is due, otherwise at half the rate.
        idle = self._next_poll_ns - now_ns >= _LOCK_QUERY_NS
        lock_interval_ns = _LOCK_INTERVAL_NS if idle else 2 * _LOCK_INTERVAL_NS
        if self.target_search is not None and now_ns - self._lock_queried_ns >= lock_interval_ns:
            await self._query_lock()
        else:
            await self._timestamper.maintain(self._line, self._clock, self._next_poll_ns)
        now_ns = self._clock.monotonic_ns()
        if self._next_poll_ns - now_ns > 1_000_000:
            await self._clock.sleep_until(self._next_poll_ns)
        reply = await self._line.call(Rpc.TMC_GET_FULL_MEAS, WAIT_MS, 1, timeout_s=_POLL_TIMEOUT_S)
        self._round_trip_ns = min(self._round_trip_ns, reply.first_byte_ns - reply.sent_ns)
        outcome = outcome_of(reply.code, has_values=bool(reply.values))
        if outcome is Outcome.SHUT_DOWN:
            raise InstrumentError("the instrument is switching off")
        unavailable = outcome in (Outcome.UNAVAILABLE, Outcome.LICENCE)
        self._unavailable = self._unavailable + 1 if unavailable else 0
        if self._unavailable >= _MAX_UNAVAILABLE:
            raise InstrumentError(
                f"the instrument does not support TMC_GetFullMeas ({name_of(reply.code)}), so that distances have no times;"
                " a TPS1200+ or newer is required"
            )
        if outcome is Outcome.BUSY and reply.first_byte_ns - self._last_distance_ns < _STALE_NS:
            self._next_poll_ns = self._clock.monotonic_ns() + _IDLE_NS
            return None
        measured = decode_full_measurement(reply)
        self.tilted = measured.status is Status.TILT
        if measured.time_ms is None:
            return await self._without_distance(measured)
        return await self._with_distance(measured, measured.time_ms)

    async def _with_distance(self, measured: FullMeasurement, time_ms: int) -> Reading | None:
        since_last_ns = measured.first_byte_ns - self._last_distance_ns
        interval_ns = self._poll_scheduler.interval_ns or 0
        if not self._timestamper.is_new(time_ms):
            if since_last_ns < max(_STALE_NS, 3 * interval_ns):
                return None
            return await self._without_distance(measured._replace(status=Status.NO_TARGET))
        time = self._timestamper.timestamp(measured)
        # After a gap the target may be lost, and another one cross the line of sight.
        gap = since_last_ns > max(_GAP_NS, 3 * interval_ns)
        if self.target_search is not None and (gap or self._lock is not Lock.IN) and not self.awaits_operator:
            await self._query_lock()
        self._timestamper.mark_reported(time_ms)
        self._poll_scheduler.add_distance(time_ms)
        self._last_distance_ns = measured.first_byte_ns
        if time is None:
            if not self._timestamper.problem:
                return None
            return self._readings.without_distance(measured._replace(status=Status.ERROR))
        if self.awaits_operator or (self.target_search is not None and self._lock is not Lock.IN):
            return await self._without_distance(measured._replace(status=Status.NO_TARGET))
        if time.at_ns < self._valid_from_ns:
            return None
        self._next_poll_ns = self._poll_scheduler.next_ns(
            time.at_ns + self._timestamper.latency_ns, self._round_trip_ns
        )
        self._target_found(Pointing(measured.horizontal_angle_rad, measured.zenith_angle_rad))
        return self._readings.with_distance(measured, time)

    async def _without_distance(self, measured: FullMeasurement) -> Reading | None:
        """Reacquire the target, and report why there is no distance, unless it was reported just now."""
        now_ns = self._clock.monotonic_ns()
        self._next_poll_ns = now_ns + _IDLE_NS
        if self.awaits_operator:
            await self._await_manual_pointing()
        elif self.target_search is not None:
            if now_ns - self._lock_queried_ns >= _NO_LOCK_INTERVAL_NS:
                await self._query_lock()
            if measured.status is not Status.TILT and not self._lock_queries_left:
                await self._search_next(self.target_search)
        if self._search is None and now_ns - self._last_distance_ns > _RESTART_NS:
            await self.start_measuring()
        locked = self.target_search is None or self._lock is Lock.IN
        status = measured.status
        if status is Status.ANGLE_ONLY and not locked:
            status = Status.NO_TARGET
        starting = locked and now_ns - self._started_ns < _STARTUP_NS
        if starting and status in (Status.ANGLE_ONLY, Status.NO_TARGET):
            return None
        return self._readings.without_distance(measured._replace(status=status))

    # --- Lock and reacquisition -------------------------------------------------------------------------------

    async def _query_lock(self) -> None:
        lock = await lock_state(self._line)
        if lock is not None:  # otherwise keep the last known state: a search would release a lock
            self._lock = lock
        self._lock_queries_left = max(self._lock_queries_left - 1, 0) if lock is None else 0
        self._lock_queried_ns = self._clock.monotonic_ns()
        if self._lock is Lock.IN:
            if not self.awaits_operator:
                self.operator_request = ""
        elif self._lost_ns is None:
            self._lost_ns = self._lock_queried_ns
            log.info("prism_lost", prism=self.prism)

    def _target_found(self, where: Pointing) -> None:
        if self._lost_ns is not None:
            after_s = (self._clock.monotonic_ns() - self._lost_ns) / 1e9
            log.info("prism_found", prism=self.prism, after_s=round(after_s, 1))
            self._lost_ns = None
        self._rounds = 0
        self.operator_request = ""
        self.activity = f"tracking prism {self.prism}"
        self._sequence.lock_acquired(where)

    async def _search_next(self, target_search: TargetSearch) -> None:
        """Start the next search if one is due."""
        window = self._sequence.next(self._lock, self._clock.monotonic_ns())
        if window is not None:
            self._start_search(target_search, window)
        elif self._lock is Lock.PREDICTION:
            self.activity = "waiting for the prism to come back"
        elif self._lock is Lock.OUT:
            self.activity = "pausing between searches"
            if self._sequence.rounds > self._rounds:
                self._rounds = self._sequence.rounds
                await self._call_operator(f"point the telescope at prism {self.prism}, it is not found")

    async def _await_manual_pointing(self) -> None:
        """Check whether the operator has pointed the telescope at the new prism."""
        self.activity = f"waiting for the telescope to be pointed at prism {self.prism}"
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._lock_queried_ns >= _NO_LOCK_INTERVAL_NS:
            await self._query_lock()
        if self._manual_pointing is None:
            await self._watch_pointing()
            return
        if self._lock is Lock.IN:  # locked on by hand
            self._accept_prism()
            return
        here = await pointing(self._line)
        if here is None or not self._manual_pointing.update(here, now_ns):
            return
        if self.target_search is not None:
            self._start_search(self.target_search, window_at_pointing())
        else:
            self._accept_prism()

    async def _watch_pointing(self) -> None:
        """Watch where the operator points from now on, once the old prism is released: until then the robot turns the telescope."""
        if self._lock is Lock.OUT:
            self._manual_pointing = ManualPointingDetector(
                await pointing(self._line), self._clock.monotonic_ns()
            )

    def _accept_prism(self) -> None:
        self.awaits_operator = False
        self.operator_request = ""
        self._valid_from_ns = self._clock.monotonic_ns()

    def _start_search(self, target_search: TargetSearch, window: SearchWindow) -> None:
        self.activity = window.name
        self._search = asyncio.create_task(target_search.search(window))

    async def _wait_for(self, search: asyncio.Task[bool]) -> Reading | None:
        """Wait for a search to end, at most until the missing target has to be reported again."""
        await asyncio.wait({search}, timeout=STATUS_INTERVAL_NS / 1e9)
        if not search.done():
            now_ns = self._clock.monotonic_ns()
            return self._readings.without_distance(
                FullMeasurement(0.0, 0.0, None, None, Status.NO_TARGET, 0, now_ns)
            )
        self._search = None
        try:
            locked = search.result()
        except RoboticLicenceMissing:
            locked = False
            self._disable_search()
        now_ns = self._clock.monotonic_ns()
        self._lock = Lock.IN if locked else Lock.OUT
        # A failed search does not reveal whether the operator has locked on meanwhile, so query the lock at once: another
        # search would release it.
        self._lock_queried_ns = now_ns if locked else 0
        if locked:
            self._accept_prism()
        elif self.awaits_operator:
            # The search may have turned the telescope; only later movements are the operator's.
            await self._watch_pointing()
            await self._call_operator(f"point the telescope at prism {self.prism}")
        await self.start_measuring()
        return None

    async def _call_operator(self, request: str) -> None:
        """Ask the operator to act, and beep."""
        self.operator_request = request
        log.warning("operator_required", what=request)
        await self._line.call(Rpc.BMM_BEEP_ALARM)

    def _disable_search(self) -> None:
        """Continue without searches: the licence is missing."""
        if self.target_search is not None:
            log.warning("licence_missing")
        self.target_search = None
