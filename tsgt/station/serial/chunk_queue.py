"""Data that a port has received and its owner has not read."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING

from tsgt.errors import InstrumentError

if TYPE_CHECKING:
    from tsgt.station.serial.base import Chunk


class ChunkQueue:
    """Received chunks for one reader. ``max_chunks``: capacity, beyond which the oldest are dropped; None: unlimited."""

    def __init__(self, max_chunks: int | None = None) -> None:
        self._chunks: deque[Chunk] = deque(maxlen=max_chunks)
        self._waiter: asyncio.Future[None] | None = None
        self._error = ""

    def put(self, chunk: Chunk) -> None:
        """Add received data."""
        self._chunks.append(chunk)
        self._wake()

    async def read(self) -> Chunk:
        """Return the oldest data, or wait for some; raises InstrumentError once the line is lost and all data is read."""
        while not self._chunks:
            self.check()
            self._waiter = asyncio.get_running_loop().create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self._chunks.popleft()

    def drain(self) -> bytes:
        """Return and remove all data; raises InstrumentError once the line is lost."""
        self.check()
        data = b"".join(chunk.data for chunk in self._chunks)
        self._chunks.clear()
        return data

    def clear(self) -> None:
        """Discard all data."""
        self._chunks.clear()

    def fail(self, error: str) -> None:
        """Take the reason why the line is lost, unless there is one already; what was received before can still be read."""
        self._error = self._error or error
        self._wake()

    def check(self) -> None:
        """Raise InstrumentError once the line is lost."""
        if self._error:
            raise InstrumentError(self._error)

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)
