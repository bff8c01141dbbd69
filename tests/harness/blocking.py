"""Programs that block and poll, as most drivers for the SX127x do, in virtual time beside an event loop."""

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
"""What an access to the bus takes on a Pi, system call and Python together."""

GLANCE_S = 20e-6
"""What a look at the clock takes, so that a program cannot wait for ever in no time."""


class BlockingProgram:
    """Runs a program in a thread of its own, in strict turns with the event loop, so that nothing depends on chance.

    While the program computes, the loop's thread stands still, and time with it. Time passes, and the loop's tasks
    run, only while the program is in one of the methods below, which stand in for those of the module ``time``.
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
            except BaseException as error:  # noqa: BLE001 (it is handed on)
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
        self.sleep(GLANCE_S)
        return self._loop.time()

    time = monotonic

    def interrupt(self, callback: Callable[[], None]) -> None:
        """Call back in the program's thread the next time that it looks up."""
        self._interrupts.append(callback)
