"""A computer of a simulated mission: radio, disk, clock, and the daemon that runs on it."""

from __future__ import annotations

import asyncio
from contextvars import ContextVar, copy_context
from typing import TYPE_CHECKING

from tsgt.simulation.kernel import DriftingClock, VirtualEventLoop
from tsgt.simulation.lora import HostDelay, radio_opener
from tsgt.simulation.mission.disk import DiskWriter, ProcessKilled, SimulatedDisk

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    import numpy as np

    from tsgt.radio import LoRaSettings, RadioOpener
    from tsgt.simulation.kernel import VirtualClock
    from tsgt.simulation.lora import Air, RadioHardware, TimestampJitter

MASTER = "master"
"""Name of the master's computer."""

_RUNS_ON: ContextVar[str] = ContextVar("_RUNS_ON")
"""Name of the computer on which a task runs."""


class Computer:
    """A computer; its state outlives the daemons that run on it."""

    def __init__(
        self,
        name: str,
        clock: VirtualClock | DriftingClock,
        air: Air,
        settings: LoRaSettings,
        rng: np.random.Generator,
        jitter: TimestampJitter | None,
    ) -> None:
        self.name = name
        self.clock = clock
        self.rng = rng
        self.disk = SimulatedDisk()
        self.task: asyncio.Task[None] | None = None  # the running daemon; None: there is none
        self.suspended_ns = 0  # for how long it has been suspended since it was switched on
        self.is_suspended = False
        self.is_down = False  # whether the daemon was ended by the simulation and will be restarted
        self.hardware: RadioHardware | None = None  # radio hardware, since it was last opened
        self.disk_writer: DiskWriter | None = None  # disk access of the current or last daemon
        self._air = air
        self._settings = settings
        self._jitter = jitter

    def radio(self, settings: LoRaSettings | None = None, *, slow: bool = True) -> RadioOpener:
        """Return the opener of the radio; ``settings``: other than the mission's; ``slow``: with the delays of a real host."""
        delay = HostDelay() if slow else None
        return radio_opener(
            self._air,
            self.name,
            self.clock,
            self.rng,
            settings or self._settings,
            delay,
            self._jitter,
            on_open=self._opened,
        )

    def _opened(self, hardware: RadioHardware) -> None:
        self.hardware = hardware

    def new_writer(self) -> DiskWriter:
        """Return the disk access of the next daemon."""
        self.disk_writer = DiskWriter(self.disk)
        return self.disk_writer

    @property
    def failure(self) -> BaseException | None:
        """The error that the daemon has ended with; None: it runs or was stopped, or was killed during a write."""
        task = self.task
        if task is None or not task.done() or task.cancelled():
            return None
        error = task.exception()
        return None if error is None or _is_killed(error) else error

    def start(self, daemon: Coroutine[None, None, None]) -> None:
        """Start a daemon."""
        context = copy_context()
        context.run(_RUNS_ON.set, self.name)
        self.task = asyncio.create_task(daemon, name=self.name, context=context)

    def suspend(self) -> Callable[[], None]:
        """Suspend the computer: its programs and its clock stand still; return what resumes it."""
        loop = asyncio.get_running_loop()
        if not isinstance(loop, VirtualEventLoop) or not isinstance(self.clock, DriftingClock):
            raise TypeError(f"{self.name}: only a station on virtual time can be suspended")
        resume_programs = loop.suspend(lambda context: context.get(_RUNS_ON) == self.name)
        self.is_suspended = True
        resume_clock, since_ns = self.clock.suspend(), self._air.timeline.now_ns()

        def resume() -> None:
            self.is_suspended = False
            resume_clock()
            self.suspended_ns += self._air.timeline.now_ns() - since_ns
            resume_programs()

        return resume

    async def stop(self) -> None:
        """Cancel the daemon, as systemd's stop does, and wait for its end; no effect without one.

        Raises
        ------
        BaseException
            The daemon's error, unless the daemon was killed during a write.
        """
        task, self.task = self.task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
            error = None if task.cancelled() else task.exception()
            if error is not None and not _is_killed(error):
                raise error

    async def kill(self) -> None:
        """Kill the daemon: completed writes stay on the disk, later ones do not happen.

        Raises
        ------
        Exception
            The daemon had already ended with this error.
        """
        task, self.task = self.task, None
        if task is None:
            return
        if self.disk_writer is not None:
            self.disk_writer.kill()
        task.cancel()
        await asyncio.wait([task])
        # ProcessKilled of a final write is not an Exception.
        if not task.cancelled() and isinstance(error := task.exception(), Exception):
            raise error


def _is_killed(error: BaseException) -> bool:
    """Whether a daemon's errors are all :class:`ProcessKilled`."""
    if isinstance(error, BaseExceptionGroup):
        return all(map(_is_killed, error.exceptions))
    return isinstance(error, ProcessKilled)


class ClientClock:
    """The clock that a client is given; it remembers what the client knows, which reads the Unix time once per run.

    Attributes
    ----------
    unix_at_zero_ns
        Unix time at monotonic zero.
    suspended_ns
        For how long the computer had been suspended.
    """

    def __init__(self, computer: Computer) -> None:
        self._computer, self._clock = computer, (clock := computer.clock)
        self.monotonic_ns, self.sleep_until, self.true_ns = (
            clock.monotonic_ns,
            clock.sleep_until,
            clock.true_ns,
        )
        self.unix_at_zero_ns = self.suspended_ns = 0

    def realtime_ns(self) -> int:
        """Return the Unix time."""
        realtime_ns = self._clock.realtime_ns()
        self.unix_at_zero_ns = realtime_ns - self._clock.monotonic_ns()
        self.suspended_ns = self._computer.suspended_ns
        return realtime_ns
