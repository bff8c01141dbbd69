"""Messages of a recording: each reader has its own replay, with its own place and speed, so that nothing is shared or set."""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import TYPE_CHECKING, Any

from tsgt.model import Parameters
from tsgt.recording import SetupRecord, decode, encode_line
from tsgt.recording.format import HEADER_START
from tsgt.web.live import INTERVAL_S
from tsgt.web.messages import encode, message
from tsgt.web.mission import MissionState
from tsgt.web.recorded import PARAMETERS_START

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterator, Mapping

    from tsgt.clock import Clock
    from tsgt.web.recorded import RecordingIndex

MAX_SPEED = 50.0

BEFORE_S = 300.0
"""What came before the place is read first, for trail and residuals."""

_LINES_AT_ONCE = 500
"""Then other readers have their turn."""


class ReplayMessages:
    """Plays a recording to each reader: from the second ``at`` of its query, ``speed`` times as fast; speed 0 stands."""

    replay = True

    def __init__(self, index: RecordingIndex, clock: Clock) -> None:
        self._index = index
        self._clock = clock

    async def messages(self, query: Mapping[str, Any], /) -> AsyncGenerator[bytes]:
        """Yield the state at the asked place, and then what follows."""
        length_s = self._index.length_s
        from_s = min(max(_number(query.get("at"), 0.0), 0.0), length_s)
        speed = min(max(_number(query.get("speed"), 1.0), 0.0), MAX_SPEED)
        player = _Player(self._index, from_s)
        await player.play_to(from_s)
        clock, cursors = self._clock, None
        start_ns = due_ns = clock.monotonic_ns()
        while True:
            now_s = clock.monotonic_ns() / 1e9
            at_s = min(from_s + speed * (now_s - start_ns / 1e9), length_s)
            await player.play_to(at_s)
            state = player.state
            bar: dict[str, Any] = {"at_s": round(at_s, 2), "speed": speed}
            if cursors is None:
                bar |= {
                    "length_s": round(length_s, 1),
                    "start_ms": (self._index.start_ns or 0) // 1_000_000,
                    "marks": self._index.marks[-500:],
                }
            yield encode(message(state, state.view(at_s), cursors, now_s, replay=bar))
            cursors = state.cursors()
            due_ns = max(due_ns + round(INTERVAL_S * 1e9), clock.monotonic_ns())
            await clock.sleep_until(due_ns)


class _Player:
    """Passes the lines of a recording to a state of its own."""

    def __init__(self, index: RecordingIndex, at_s: float) -> None:
        self.state = MissionState(index.path.name)
        from_s = max(0.0, at_s - BEFORE_S)
        self.state.connected(from_s)
        for line_s, line in index.lasting:
            if line_s < from_s:
                self._take(from_s, line)
        self._lines: Iterator[tuple[float, bytes]] = index.lines(from_s)
        self._next = next(self._lines, None)
        self._from_s = from_s

    async def play_to(self, at_s: float) -> None:
        """Pass on all lines up to a time."""
        lines = 0
        while self._next is not None and self._next[0] <= at_s:
            line_s, line = self._next
            # The place in the index may be a little earlier; what is there was passed on above.
            if line_s >= self._from_s:
                self._take(line_s, line)
            self._next = next(self._lines, None)
            lines += 1
            if lines % _LINES_AT_ONCE == 0:
                await asyncio.sleep(0)

    def _take(self, line_s: float, line: bytes) -> None:
        if line.startswith(HEADER_START):  # another run of the master, perhaps with another clock
            self.state.connected(line_s)
            return
        with contextlib.suppress(ValueError):  # of another version
            if line.startswith(PARAMETERS_START):
                # A session of an older version has no set-up; one that follows replaces this.
                line = encode_line(SetupRecord.of(decode(Parameters, line), 0))
            self.state.line(line, line_s)


def _number(text: str | None, default: float) -> float:
    try:
        number = float(text) if text is not None else default
    except ValueError:
        return default
    return number if math.isfinite(number) else default
