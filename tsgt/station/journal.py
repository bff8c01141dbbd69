"""The queue of a station's journal: each line is handed to the disk before anything else is done with its content."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from tsgt.recording import encode_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.recording.recorder import Recorder

WRITE_TIMEOUT_S = 0.05
"""An SD card takes a millisecond for a line, but now and then a second for housekeeping. A measurement delayed that long
is worthless to a moving robot, and the master would detect a reset of the station's clock."""

RETRY_INTERVAL_S = 1.0  # interval of the attempts on a disk that refuses lines


class JournalQueue:
    """Writes in a thread, so that a slow disk delays neither the instrument nor the radio.

    ``write_timeout_s``: how long a measurement waits for the disk before its callback is called anyway; None: until the
    disk has accepted or refused it.
    """

    def __init__(self, recorder: Recorder, *, write_timeout_s: float | None) -> None:
        self._recorder = recorder
        self._write_timeout_s = write_timeout_s
        self._callbacks: list[Callable[[], None]] = []
        self._pending = asyncio.Event()

    def write(self, record: object, then: Callable[[], None] | None = None) -> None:
        """Queue a record; call back when the disk has accepted or refused it, or the timeout expires."""
        self._recorder.put(encode_line(record))
        if then is not None:
            self._callbacks.append(then)
        self._pending.set()

    async def run(self) -> NoReturn:
        """Write queued lines, for ever."""
        while True:
            with suppress(TimeoutError):
                # A disk that accepts lines again must not wait for the next measurement.
                async with asyncio.timeout(RETRY_INTERVAL_S if self._recorder.failing else None):
                    await self._pending.wait()
            self._pending.clear()
            callbacks, self._callbacks = self._callbacks, []
            writing = asyncio.ensure_future(asyncio.to_thread(self._recorder.flush))
            try:
                while not (await asyncio.wait([writing], timeout=self._write_timeout_s))[0]:
                    callbacks += self._callbacks
                    self._callbacks = []
                    _call(callbacks)
            finally:
                writing.cancel()  # at the end of the program; the thread ends when the disk lets it
                await asyncio.wait([writing])
            writing.result()  # raises what a bug of ours raised in the thread
            _call(callbacks)


def _call(callbacks: list[Callable[[], None]]) -> None:
    while callbacks:
        callbacks.pop(0)()
