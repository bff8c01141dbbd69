"""Messages of a live mission: one view of the state for all readers, five times a second."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, NoReturn

from tsgt.web.messages import encode, message

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Mapping

    from tsgt.clock import Clock
    from tsgt.web.mission import MissionState

INTERVAL_S = 0.2

QUEUE_MESSAGES = 25
"""Of one reader; what waits longer would be shown late."""


class LiveMessages:
    """Sends the same bytes to every reader, each through a queue of its own.

    ``viewed``: gets each view as well, with its time.
    """

    replay = False

    def __init__(
        self,
        state: MissionState,
        clock: Clock,
        viewed: Callable[[dict[str, Any], float], None] | None = None,
    ) -> None:
        self._state = state
        self._clock = clock
        self._viewed = viewed
        self._queues: set[asyncio.Queue[bytes | None]] = set()

    async def run(self) -> NoReturn:
        """Make the messages while there are readers."""
        state, clock = self._state, self._clock
        cursors = state.cursors()
        due_ns = clock.monotonic_ns()
        while True:
            # Without a burst after the process was suspended.
            due_ns = max(due_ns + round(INTERVAL_S * 1e9), clock.monotonic_ns())
            await clock.sleep_until(due_ns)
            now_s = clock.monotonic_ns() / 1e9
            view = state.view(now_s)  # also without readers: the verdict is held over some views
            if self._viewed is not None:
                self._viewed(view, now_s)
            if self._queues:
                self._put(encode(message(state, view, cursors, now_s)))
            cursors = state.cursors()

    async def messages(self, _query: Mapping[str, Any], /) -> AsyncGenerator[bytes]:
        """Yield everything up to now, and then what is new; ends for a reader that takes nothing."""
        queue: asyncio.Queue[bytes | None] = asyncio.Queue(QUEUE_MESSAGES)
        self._queues.add(queue)
        try:
            now_s = self._clock.monotonic_ns() / 1e9
            yield encode(message(self._state, self._state.view(now_s), None, now_s))
            while (data := await queue.get()) is not None:
                yield data
        finally:
            self._queues.discard(queue)

    def _put(self, data: bytes) -> None:
        for queue in list(self._queues):
            if queue.full():
                self._queues.discard(queue)
                while not queue.empty():
                    queue.get_nowait()
                queue.put_nowait(None)
            else:
                queue.put_nowait(data)
