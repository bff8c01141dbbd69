"""Alarms: events that leave the machine, through a command and a web server. They never delay the master.

:class:`AlarmLimiter` is sans-I/O. Each target has a bounded queue and a task that runs one program at a time: a server that
stalls delays neither the command nor anything else.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn
from urllib.parse import urlsplit

import structlog

from tsgt.recording import encode_line
from tsgt.service import LogLimiter, printable, run_command

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable

    from tsgt.clock import Clock
    from tsgt.config import AlarmsConfig
    from tsgt.recording import EventRecord

MAX_WAITING = 50
"""Alarms that wait for a target; beyond them the oldest is lost."""

RETRY_DELAYS_S = (5.0, 30.0)  # a web server is tried again after these; mobile networks have gaps

log = structlog.get_logger()


_STATES = (
    {"station_lost", "station_recovered"},
    {"station_idle", "station_measuring"},
    {"station_not_tracking", "station_tracking"},
    {"battery_low", "battery_recovered"},
    {"radio_failed", "radio_recovered"},
    {"disk_low", "disk_full", "disk_failed", "disk_recovered"},
    {"imu_setup_wrong", "imu_setup_confirmed"},
    {"imu_lost", "imu_recovered"},
    {"imu_implausible", "imu_plausible"},
    {"imu_used", "imu_not_used"},
    {"odometry_lost", "odometry_recovered"},
    {"odometry_disagrees", "odometry_agrees"},
    {"geofence_exited", "geofence_entered"},
    {"layout_residual_high", "layout_residual_normal"},
)
"""Events that replace each other: what begins a state, what changes and what ends it."""

_ENDED_BY_SETUP = {"layout_residual_high", "imu_setup_wrong", "station_contradicted"}
"""States of the set-up in force, which ``setup_applied`` ends."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """An event that leaves the machine; ``suppressed``: how many of its kind were held back before it."""

    event: EventRecord
    suppressed: int = 0

    def line(self, site: str) -> bytes:
        """Return the event's line with the name of the site and the number of suppressed alarms."""
        extras = json.dumps({"site": site, "suppressed": self.suppressed})
        return encode_line(self.event)[:-1] + b"," + extras[1:].encode()


@dataclass(slots=True)
class _Subject:
    """What alarms of one kind concern; instants on the master's Unix clock in ns."""

    next_ns: int
    held: EventRecord | None = None
    suppressed: int = 0


class AlarmLimiter:
    """Passes an alarm of each kind and subject at most once per interval.

    Those in between are held back, and the newest of them passes at the end of the interval, unless another event has replaced it:
    the last alarm that somebody got describes the state that lasts.
    """

    def __init__(self, events: Iterable[str], min_interval_ns: int) -> None:
        self._events = frozenset(events)
        self._min_interval_ns = min_interval_ns
        self._subjects: dict[tuple[str, int | None, str], _Subject] = {}

    def take(self, event: EventRecord, now_ns: int) -> list[Alarm]:
        """Take any event of the master; return it as an alarm if it is one and may pass now."""
        _, is_fence, change = event.event.partition(
            "geofence_"
        )  # its message begins with "geofence NAME CHANGE:"
        name = event.message.partition(f" {change}:")[0] if is_fence else ""
        self._drop_replaced(event, name)
        if event.event not in self._events:
            return []
        key = (event.event, event.station, name)
        subject = self._subjects.get(key)
        if subject is None or (subject.held is None and now_ns >= subject.next_ns):
            self._subjects[key] = _Subject(now_ns + self._min_interval_ns)
            return [Alarm(event, 0 if subject is None else subject.suppressed)]
        subject.suppressed += subject.held is not None
        subject.held = event
        return []

    def _drop_replaced(self, event: EventRecord, name: str) -> None:
        """Drop what is held back of a state that an event changes."""
        state: set[str] = next((each for each in _STATES if event.event in each), set())
        if event.event == "setup_applied":
            state = _ENDED_BY_SETUP
        for (other, station, other_name), subject in self._subjects.items():
            same = other_name == name and (station == event.station or None in (station, event.station))
            if other in state and other != event.event and same and subject.held is not None:
                subject.held = None
                subject.suppressed += 1

    def due(self, now_ns: int) -> list[Alarm]:
        """Return the alarms that were held back until now, in their order."""
        alarms = []
        for subject in self._subjects.values():
            if subject.held is not None and now_ns >= subject.next_ns:
                alarms.append(Alarm(subject.held, subject.suppressed))
                subject.next_ns = now_ns + self._min_interval_ns
                subject.held, subject.suppressed = None, 0
        return sorted(alarms, key=lambda alarm: alarm.event.stamp_ns)

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`due` has to be called; None while nothing is held back."""
        return min(
            (subject.next_ns for subject in self._subjects.values() if subject.held is not None), default=None
        )


class Alarms:
    """Takes events and sends those that are alarms; ``unix_now_ns``: the master's Unix clock."""

    def __init__(self, config: AlarmsConfig, clock: Clock, unix_now_ns: Callable[[], int]) -> None:
        self._unix_now_ns = unix_now_ns
        self._limiter = AlarmLimiter(config.events, round(config.min_interval_s * 1e9))
        self._changed = asyncio.Event()
        self._targets = []
        if config.command:
            self._targets.append(_Target("command", config.command[0], _command(config), clock))
        if config.webhook is not None:
            host = urlsplit(config.webhook).hostname or ""
            webhook = _webhook(config.webhook, config.site)
            self._targets.append(_Target("webhook", host, webhook, clock, RETRY_DELAYS_S))

    def take(self, event: EventRecord) -> None:
        """Take an event; never waits."""
        self._send(self._limiter.take(event, self._unix_now_ns()))
        self._changed.set()

    async def run(self) -> None:
        """Send alarms until cancelled."""
        async with asyncio.TaskGroup() as group:
            for target in self._targets:
                group.create_task(target.run())
            group.create_task(self._release())

    async def _release(self) -> NoReturn:
        """Send what was held back when its time has come."""
        while True:
            deadline_ns = self._limiter.next_deadline_ns()
            wait_s = None if deadline_ns is None else max(0, deadline_ns - self._unix_now_ns()) / 1e9
            try:
                async with asyncio.timeout(wait_s):
                    await self._changed.wait()
                    self._changed.clear()
            except TimeoutError:
                self._send(self._limiter.due(self._unix_now_ns()))

    def _send(self, alarms: Iterable[Alarm]) -> None:
        for alarm in alarms:
            for target in self._targets:
                target.put(alarm)


class _Target:
    """One way out of the machine; ``deliver`` returns what went wrong, or an empty string."""

    def __init__(
        self,
        name: str,
        address: str,
        deliver: Callable[[Alarm], Coroutine[None, None, str]],
        clock: Clock,
        retry_delays_s: tuple[float, ...] = (),
    ) -> None:
        self._name = name
        self._address = address
        self._deliver = deliver
        self._clock = clock
        self._retry_delays_s = retry_delays_s
        self._queue: deque[Alarm] = deque(maxlen=MAX_WAITING)
        self._waiting = asyncio.Event()
        self._logged = LogLimiter()

    def put(self, alarm: Alarm) -> None:
        if len(self._queue) == MAX_WAITING and self._allows_log("lost"):
            log.error("alarms_lost", target=self._name, address=self._address)
        self._queue.append(alarm)
        self._waiting.set()

    async def run(self) -> NoReturn:
        while True:
            await self._waiting.wait()
            self._waiting.clear()
            while self._queue:
                await self._try(self._queue.popleft())

    async def _try(self, alarm: Alarm) -> None:
        problem = await self._deliver(alarm)
        for delay_s in self._retry_delays_s:
            if not problem:
                break
            await self._clock.sleep_until(self._clock.monotonic_ns() + round(delay_s * 1e9))
            problem = await self._deliver(alarm)
        if not problem:
            log.info("alarm_sent", target=self._name, address=self._address, name=alarm.event.event)
        elif self._allows_log("failed"):
            log.error(
                "alarm_failed",
                target=self._name,
                address=self._address,
                name=alarm.event.event,
                error=problem,
            )

    def _allows_log(self, what: str) -> bool:
        return self._logged.allows(what, self._clock.monotonic_ns())


def _command(config: AlarmsConfig) -> Callable[[Alarm], Coroutine[None, None, str]]:
    async def deliver(alarm: Alarm) -> str:
        event = alarm.event
        environment = {
            "TSGT_EVENT": event.event,
            "TSGT_SITE": printable(config.site),
            "TSGT_MESSAGE": printable(event.message),
            "TSGT_STATION": "" if event.station is None else str(event.station),
        }
        return await run_command(config.command, environment, stdin=alarm.line(config.site) + b"\n")

    return deliver


def _webhook(url: str, site: str) -> Callable[[Alarm], Coroutine[None, None, str]]:
    async def deliver(alarm: Alarm) -> str:
        request = json.dumps({"url": url, "body": alarm.line(site).decode()}).encode()
        # -P: no module is imported from the working directory.
        program = (sys.executable, "-P", "-m", "tsgt.master.webhook")
        return await run_command(program, {}, stdin=request, explains_failure=True)

    return deliver
