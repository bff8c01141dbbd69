"""Runs blocking, polling programs, as most drivers for the SX127x are, in virtual time with an event loop."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import Future
from queue import SimpleQueue
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

ACCESS_S = 100e-6
"""Duration of a bus access on a Pi, with system call and Python."""

CLOCK_READ_S = 20e-6
"""Duration of reading the clock, so that polling the clock lets time pass."""


class BlockingProgram:
    """Runs a program in a thread, alternating with the event loop, so that it is deterministic.

    While the program computes, the loop's thread and time are stopped. Time passes, and the loop's tasks run, only while
    the program is in one of the methods below, which replace those of the module ``time``.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._sleeps: SimpleQueue[float | None] = SimpleQueue()
        self._turns: SimpleQueue[BaseException | None] = SimpleQueue()
        self._interrupts: list[Callable[[], None]] = []

    async def run(self, program: Callable[[], T]) -> T:
        """Run a program to its end and return its result."""
        outcome: Future[T] = Future()

        def work() -> None:
            try:
                outcome.set_result(program())
            except BaseException as error:  # noqa: BLE001 (passed to the caller)
                outcome.set_exception(error)
            finally:
                self._sleeps.put(None)

        thread = threading.Thread(target=work)
        thread.start()
        while (duration_s := self._sleeps.get()) is not None:
            try:
                await asyncio.sleep(duration_s)
            except asyncio.CancelledError as error:
                self._turns.put(error)
            else:
                self._turns.put(None)
        thread.join()
        return outcome.result()

    def sleep(self, duration_s: float) -> None:
        """Let time pass; called by the program."""
        self._sleeps.put(duration_s)
        error = self._turns.get()
        if error is not None:
            raise error
        while self._interrupts:
            self._interrupts.pop(0)()

    def monotonic(self) -> float:
        """Return the virtual time in s, a little later with each call."""
        self.sleep(CLOCK_READ_S)
        return self._loop.time()

    time = monotonic

    def interrupt(self, callback: Callable[[], None]) -> None:
        """Call back in the program's thread at its next sleep."""
        self._interrupts.append(callback)
