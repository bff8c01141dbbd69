"""Programs that read a device of the robot, supervised; and the one that reads its IMU."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import structlog

from tsgt.errors import InstrumentError
from tsgt.imu.lines import decode_program_line
from tsgt.imu.monitor import ImuMonitor
from tsgt.imu.sampler import Sampler
from tsgt.imu.session import ImuSession
from tsgt.service import RejectedLines, printable, start_process

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.config import ImuConfig
    from tsgt.imu.lines import HelloLine
    from tsgt.imu.sampler import DeviceSampler
    from tsgt.model import ImuSamples
    from tsgt.recording import ImuStatus
    from tsgt.service import StartProgram

INITIAL_RETRY_DELAY_NS = 100_000_000

MAX_RETRY_DELAY_NS = 1_000_000_000

STABLE_NS = 5_000_000_000
"""A program that ran longer resets the retry delay, and its error is logged again."""

CHECK_PERIOD_NS = 250_000_000  # of what time alone brings: loss, and the end of a problem

log = structlog.get_logger()


class DeviceProgram(ABC):
    """A program that reads a device: run, restarted when it fails.

    Parameters
    ----------
    setting
        Key of the configuration that has the command.
    decode
        Decodes its lines.
    start
        Starts the program; by default as a child process.
    """

    def __init__(
        self,
        command: Sequence[str],
        stall_timeout_s: float,
        clock: Clock,
        timeline: UnixTimeline,
        sampler: DeviceSampler[Any, Any],
        *,
        setting: str,
        decode: Callable[[bytes], Any],
        start: StartProgram | None,
    ) -> None:
        self._command, self._stall_timeout_s = command, stall_timeout_s
        self._clock = clock
        self._timeline = timeline
        self._sampler = sampler
        self._decode = decode
        self._start: StartProgram = start or partial(
            start_process, clock=clock, setting=setting, log_stderr=self._log_stderr
        )
        self._rejected = RejectedLines(clock, self._log_rejected)
        self._session: ImuSession | None = None
        self._error = ""
        self._started_ns = clock.monotonic_ns()

    async def run(self) -> NoReturn:
        """Run the program and restart it, for ever."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._supervise())
            group.create_task(self._check())
        raise AssertionError  # both run for ever

    @abstractmethod
    def _hello(self, hello: Any) -> None:
        """Take the first line of a run."""

    @abstractmethod
    def _take(self, samples: Any) -> None:
        """Take a record."""

    @abstractmethod
    async def _check(self) -> NoReturn:
        """Find what time alone brings."""

    @abstractmethod
    def _log_stderr(self, text: str, dropped: int) -> None:
        """Log what the program wrote to stderr."""

    @abstractmethod
    def _log_rejected(self, error: str, line: str, rejected: int) -> None:
        """Log an invalid line."""

    @abstractmethod
    def _log_failed(self, error: str) -> None:
        """Log why the program is restarted."""

    def _problem_of_program(self) -> str:
        """Return why there are no samples, as far as the program says; empty where it does not."""
        problem = "" if self._session is None else self._session.status.problem
        return problem or self._error or self._rejected.last

    def _now_ns(self) -> int:
        return self._timeline.unix_ns(self._clock.monotonic_ns())

    def _overdue(self) -> bool:
        """Whether the first sample has taken too long."""
        return self._clock.monotonic_ns() - self._started_ns > round(self._stall_timeout_s * 1e9)

    async def _supervise(self) -> NoReturn:
        delay_ns, logged = INITIAL_RETRY_DELAY_NS, ""
        while True:
            began_ns = self._clock.monotonic_ns()
            try:
                await self._run_once()
            except InstrumentError as error:
                if (task := asyncio.current_task()) is not None and task.cancelling():
                    raise asyncio.CancelledError from None
                if self._clock.monotonic_ns() - began_ns > STABLE_NS:
                    delay_ns, logged = INITIAL_RETRY_DELAY_NS, ""
                self._error = str(error)
                if self._error != logged:
                    logged = self._error
                    self._log_failed(logged)
            await self._clock.sleep_until(self._clock.monotonic_ns() + delay_ns)
            delay_ns = min(2 * delay_ns, MAX_RETRY_DELAY_NS)

    async def _run_once(self) -> None:
        session = self._session = ImuSession(
            self._command[0],
            self._clock,
            self._sampler,
            self._rejected,
            stall_timeout_s=self._stall_timeout_s,
            on_hello=self._hello,
            on_samples=self._take,
            decode=self._decode,
        )
        program = await self._start(self._command, session)
        session.kill = program.kill
        try:
            await session.run()
        finally:
            await program.terminate()


class Imu(DeviceProgram):
    """The robot's IMU.

    Parameters
    ----------
    on_samples
        Called with each record, in the same step of the event loop in which its line arrived.
    on_event
        Called with name and message of an event for the stream.
    start
        Starts the program; by default as a child process.
    """

    def __init__(
        self,
        config: ImuConfig,
        clock: Clock,
        timeline: UnixTimeline,
        *,
        on_samples: Callable[[ImuSamples], None],
        on_event: Callable[[str, str], None],
        start: StartProgram | None = None,
    ) -> None:
        super().__init__(
            config.command,
            config.stall_timeout_s,
            clock,
            timeline,
            Sampler(timeline.unix_at_zero_ns),
            setting="imu.command",
            decode=decode_program_line,
            start=start,
        )
        self._on_samples = on_samples
        self._on_event = on_event
        self._monitor = ImuMonitor()
        self._lost = False
        self._problem = ""
        self._clock_steps = 0

    def status(self) -> ImuStatus:
        """Return the status at present."""
        session = self._session
        problem = "" if session is None else session.status.problem
        if self._monitor.lost(self._now_ns()):
            problem = problem or self._error or self._rejected.last or "there are no samples yet"
        status = self._monitor.status(self._now_ns(), problem, self._sampler.clock_skew_ppm)
        return replace(status, device=printable(status.device))

    def _hello(self, hello: HelloLine) -> None:
        name = printable(" ".join(filter(None, (hello.make, hello.model, hello.serial_number))))
        log.info("imu_connected", device=name, rate_hz=hello.rate_hz, clock=printable(hello.clock))
        self._monitor.program_started(hello)

    def _take(self, samples: ImuSamples) -> None:
        self._error = ""
        self._monitor.samples(samples)
        self._on_samples(samples)
        if self._sampler.clock_steps > self._clock_steps:
            self._clock_steps = self._sampler.clock_steps
            self._on_event(
                "imu_clock_stepped",
                "the clock of the IMU has been set or has begun again; its times are fitted again",
            )

    async def _check(self) -> NoReturn:
        while True:
            await self._clock.sleep_until(self._clock.monotonic_ns() + CHECK_PERIOD_NS)
            now_ns = self._now_ns()
            lost = self._monitor.lost(now_ns)
            if lost and not self._lost and self._overdue():
                self._lost = True
                self._on_event("imu_lost", f"the IMU gives no samples: {self.status().problem}")
            elif self._lost and not lost:
                self._lost = False
                self._on_event("imu_recovered", "the IMU gives samples again")
            problem = "" if lost else self._monitor.problem(now_ns)
            if problem and not self._problem:
                self._on_event("imu_implausible", f"the IMU: {problem}")
            elif self._problem and not problem and not lost:
                self._on_event("imu_plausible", "the values of the IMU are plausible again")
            if not lost:
                self._problem = problem

    def _log_stderr(self, text: str, dropped: int) -> None:
        log.info("imu_stderr", text=text, dropped=dropped)

    def _log_rejected(self, error: str, line: str, rejected: int) -> None:
        log.warning("imu_line_rejected", error=error, line=line, rejected=rejected)

    def _log_failed(self, error: str) -> None:
        log.error("imu_program_failed", error=error)
