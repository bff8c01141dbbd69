"""A computer of a simulated mission: radio, disk, clock, and the daemon that runs on it until somebody ends it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tsgt.simulation.lora import HostDelay, opener
from tsgt.simulation.mission.disk import Killed, ProgramWrites, SimulatedDisk

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    import numpy as np

    from tsgt.radio import LoRaSettings, OpenRadio
    from tsgt.simulation.kernel import DriftingClock, VirtualClock
    from tsgt.simulation.lora import Air, RadioHardware, StampJitter

MASTER = "master"
"""Name of the master's computer."""


class Computer:
    """One computer; what is on it outlives the daemons that it runs one after the other.

    Parameters
    ----------
    name
        Of its radio and of its daemon: ``master``, ``station1``, ...
    clock
        Its own.
    air, settings, jitter
        Of its radio, see :func:`~tsgt.simulation.lora.radios.opener`.
    rng
        Of its radio and of how long it takes for everything.

    Attributes
    ----------
    name, clock, rng
        Those.
    disk
        Its disk.
    task
        The daemon that runs; None: there is none.
    away
        Whether somebody has ended the daemon and will start it again.
    hardware
        What is behind its radio, since that was opened last; None before.
    writes
        How the daemon that runs, or ran last, writes to the disk; None before.
    """

    def __init__(
        self,
        name: str,
        clock: VirtualClock | DriftingClock,
        air: Air,
        settings: LoRaSettings,
        rng: np.random.Generator,
        jitter: StampJitter | None,
    ) -> None:
        self.name = name
        self.clock = clock
        self.rng = rng
        self.disk = SimulatedDisk()
        self.task: asyncio.Task[None] | None = None
        self.away = False
        self.hardware: RadioHardware | None = None
        self.writes: ProgramWrites | None = None
        self._air = air
        self._settings = settings
        self._jitter = jitter

    def radio(self, *, slow: bool = True) -> OpenRadio:
        """Return what opens the radio; that of a program which takes its time before it sends, or of one at once."""
        delay = HostDelay() if slow else None
        return opener(
            self._air,
            self.name,
            self.clock,
            self.rng,
            self._settings,
            delay,
            self._jitter,
            on_open=self._opened,
        )

    def _opened(self, hardware: RadioHardware) -> None:
        self.hardware = hardware

    def new_program(self) -> Callable[[int, memoryview], int]:
        """Return with what the next program writes to the disk."""
        self.writes = ProgramWrites(self.disk)
        return self.writes.write

    def start(self, daemon: Coroutine[None, None, None]) -> None:
        """Run a daemon."""
        self.task = asyncio.create_task(daemon, name=self.name)

    async def end(self) -> None:
        """Ask the daemon to end, as systemd does, and wait until it has; it may be none.

        Raises
        ------
        BaseException
            With what it has ended before, or now, unless it was killed in the middle of a line.
        """
        task, self.task = self.task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
            error = None if task.cancelled() else task.exception()
            if error is not None and not _is_killed(error):
                raise error

    async def crash(self) -> None:
        """Kill the daemon: what it has given to its disk is there, and nothing that it would have written.

        Raises
        ------
        Exception
            With what it has ended before.
        """
        task, self.task = self.task, None
        if task is None:
            return
        if self.writes is not None:
            self.writes.die()
        task.cancel()
        await asyncio.wait([task])
        # Programs that are no more fail to write in whatever they do last: that is no Exception.
        if not task.cancelled() and isinstance(error := task.exception(), Exception):
            raise error


def _is_killed(error: BaseException) -> bool:
    """Whether nothing else has happened to a program."""
    if isinstance(error, BaseExceptionGroup):
        return all(map(_is_killed, error.exceptions))
    return isinstance(error, Killed)
