"""The face for asyncio."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Self

from tsgt.client.records import Event, Pose, Record
from tsgt.client.stream import LIVE, StreamBase

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class AsyncStream(StreamBase):
    """The stream of poses, for programs with asyncio; an async context manager.

    From the first call of one of its methods it reads all the time, whether or not somebody iterates. Several iterators
    each get all records. Parameters as :class:`~tsgt.client.Stream` has them.
    """

    _error: Exception | None = None
    _descriptor: tuple[int, bool] | None = None
    _timer: asyncio.TimerHandle | None = None
    _started = False

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._arrived = asyncio.Event()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._unwatch()
        self._pump.close()
        self._arrived.set()

    async def __aiter__(self) -> AsyncIterator[Record]:
        """Iterate over all records, in the order in which the master made them.

        Raises StreamError for another protocol, or a wrong key at the first connection.
        """
        with self._queue() as queue:
            self._start()
            while True:
                while queue:
                    yield queue.take()
                if self._error is not None:
                    raise self._error
                if self._pump.ended:
                    return
                self._arrived.clear()
                await self._arrived.wait()

    async def poses(
        self, series: str = LIVE, *, max_age_s: float | None = None, include_invalid: bool = False
    ) -> AsyncIterator[Pose]:
        """Iterate over valid poses that are not stale, as :meth:`tsgt.client.Stream.poses`."""
        async for record in self:
            pose = self._hands_out(record, series, max_age_s, include_invalid=include_invalid)
            if pose is not None:
                yield pose

    async def events(self) -> AsyncIterator[Event]:
        """Iterate over events."""
        async for record in self:
            if isinstance(record, Event):
                yield record

    def latest(
        self, series: str = LIVE, *, max_age_s: float | None = None, include_invalid: bool = False
    ) -> Pose | None:
        """Return the newest pose; None if it is stale, invalid or missing. Raises StreamError as an iteration does."""
        self._start()
        if self._error is not None:
            raise self._error
        return self._newest_pose(series, max_age_s, include_invalid=include_invalid)

    def _start(self) -> None:
        """Begin in the next iteration of the event loop, so that iterators which begin now get everything."""
        if not self._started:
            self._started = True
            self._timer = self._loop.call_later(0, self._step)

    def _step(self) -> None:
        self._unwatch()
        try:
            self._take(self._pump.step())
        except Exception as error:  # noqa: BLE001 (raised where somebody iterates)
            self._error = error
        self._arrived.set()
        if not self._pump.ended:
            self._watch()

    def _watch(self) -> None:
        wait = self._pump.wait_for()
        if wait.descriptor is not None:
            add = self._loop.add_writer if wait.write else self._loop.add_reader
            add(wait.descriptor, self._step)
            self._descriptor = (wait.descriptor, wait.write)
        if wait.until_ns is not None:
            self._timer = self._loop.call_later(max(0, wait.until_ns - self._now_ns()) / 1e9, self._step)

    def _unwatch(self) -> None:
        if self._descriptor is not None:
            descriptor, write = self._descriptor
            (self._loop.remove_writer if write else self._loop.remove_reader)(descriptor)
            self._descriptor = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
