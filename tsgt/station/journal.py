"""The station's journal: a line is on its way to the disk before anything else is done with it."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from tsgt.recording import encode_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.recording.recorder import Recorder

PATIENCE_S = 0.05
"""A card takes a millisecond for a line, but now and then a second, while it tidies up. A measurement that waits for
that is worth nothing to a robot that drives, and the master would take the station's clock for another one."""


RETRY_S = 1.0
"""A disk that refuses lines is tried again so often."""


class JournalQueue:
    """Writes in a thread, because a slow card must hold up neither the instrument nor the radio.

    Parameters
    ----------
    recorder
        Takes the lines; also what is still here when it is closed.
    patience_s
        How long a measurement waits for the disk before it is worth more to the robot than to the journal; None: until
        the disk has taken or refused it.
    """

    def __init__(self, recorder: Recorder, *, patience_s: float | None) -> None:
        self._recorder = recorder
        self._patience_s = patience_s
        self._followed: list[Callable[[], None]] = []
        self._pending = asyncio.Event()

    def write(self, record: object, then: Callable[[], None]) -> None:
        """Take a record; call back when the disk has taken or refused it, or patience ends; never wait."""
        self._recorder.put(encode_line(record))
        self._followed.append(then)
        self._pending.set()

    async def keep_writing(self) -> NoReturn:
        """Write whatever there is, for ever."""
        while True:
            with suppress(TimeoutError):
                # A disk that takes lines again need not wait for the next measurement.
                async with asyncio.timeout(RETRY_S if self._recorder.failing else None):
                    await self._pending.wait()
            self._pending.clear()
            followed, self._followed = self._followed, []
            writing = asyncio.ensure_future(asyncio.to_thread(self._recorder.flush))
            try:
                while not (await asyncio.wait([writing], timeout=self._patience_s))[0]:
                    followed += self._followed
                    self._followed = []
                    _call(followed)
            finally:
                writing.cancel()  # at the end of the program; the thread ends when the disk lets it
                await asyncio.wait([writing])
            writing.result()  # a defect of ours must not pass unseen
            _call(followed)


def _call(callbacks: list[Callable[[], None]]) -> None:
    while callbacks:
        callbacks.pop(0)()
