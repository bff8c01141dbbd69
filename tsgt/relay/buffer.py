"""Sans-I/O: the last lines of the stream, numbered and tagged, for readers that are late or come back."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from tsgt.client.relay_wire import FULL, Frame, Position, encode_frame, line_key

_HEADS = (b'{"type":"hello",', b'{"type":"setup",')
"""Starts of the lines without which a reader cannot understand the following ones, in the order of the stream."""


class _Held(NamedTuple):
    time_ns: int
    frame: bytes
    head: bytes
    """The line, if it is one of those in :data:`_HEADS`; else empty."""


class LineBuffer:
    """The lines of one run of the relay, as far as they fit.

    Parameters
    ----------
    stream
        Random name of this run, as in :class:`~tsgt.client.relay_wire.Position`.
    key
        The relay's key.
    max_bytes, max_age_ns
        Limits of the frames that are held; the newest line is always held.
    """

    def __init__(self, stream: str, key: bytes, *, max_bytes: int, max_age_ns: int) -> None:
        self.stream = stream
        self._key = line_key(key, stream)
        self._max_bytes = max_bytes
        self._max_age_ns = max_age_ns
        self._held: deque[_Held] = deque()
        self._bytes = 0
        self._last_time_ns = 0
        self._oldest_heads: dict[bytes, tuple[int, bytes]] = {}
        self._newest_heads: dict[bytes, tuple[int, bytes]] = {}
        self.next = 0
        """Number of the next line."""

    @property
    def oldest(self) -> int:
        """Number of the oldest line that is held; :attr:`next` if none is."""
        return self.next - len(self._held)

    def append(self, line: bytes, now_ns: int) -> None:
        """Add a line, without line end."""
        now_ns = self._at(now_ns)
        frame = encode_frame(self._key, Frame("line", self.next, now_ns, line))
        self.next += 1
        _note(self._newest_heads, now_ns, line)
        self._held.append(_Held(now_ns, frame, line if line.startswith(_HEADS) else b""))
        self._bytes += len(frame)
        while len(self._held) > 1 and (
            self._bytes > self._max_bytes or now_ns - self._held[0].time_ns > self._max_age_ns
        ):
            dropped = self._held.popleft()
            self._bytes -= len(dropped.frame)
            _note(self._oldest_heads, dropped.time_ns, dropped.head)

    def source_lost(self) -> None:
        """Forget what a new reader would need to know of the master, which is gone."""
        self._newest_heads.clear()

    def start(self, wanted: Position | None) -> tuple[Position, list[bytes]]:
        """Return where a reader starts, and the frames that it needs before.

        It goes on where it wants to; at the oldest line if that is no longer held; else with new lines, as all others.
        """
        if wanted is None or wanted.stream != self.stream or wanted.number > self.next:
            return Position(self.stream, self.next), self._heads(self._newest_heads, self.next)
        if wanted.number < self.oldest:
            return self.skip()
        return wanted, []

    def waiting_start(self, wanted: Position | None) -> tuple[Position, list[bytes]]:
        """Return the same for a reader without a place: once it has one, it goes on there, and is told what is lost."""
        if wanted is not None and wanted.stream == self.stream and wanted.number < self.oldest:
            return wanted, []
        return self.start(wanted)

    def skip(self) -> tuple[Position, list[bytes]]:
        """Return the oldest place, and the frames that a reader needs before."""
        return Position(self.stream, self.oldest), self._heads(self._oldest_heads, self.oldest)

    def frame(self, number: int) -> bytes:
        """Return the frame of a line that is held."""
        return self._held[number - self.oldest].frame

    def beat(self, now_ns: int, *, connected: bool) -> bytes:
        """Return a sign of life for readers that have everything."""
        state = b"connected" if connected else b"waiting"
        return encode_frame(self._key, Frame("beat", self.next, self._at(now_ns), state))

    def full(self, number: int, now_ns: int) -> bytes:
        """Return the sign of life for a reader that expects this line, and for which there is no place."""
        return encode_frame(self._key, Frame("beat", number, self._at(now_ns), FULL))

    def _heads(self, heads: dict[bytes, tuple[int, bytes]], number: int) -> list[bytes]:
        return [
            encode_frame(self._key, Frame("head", number, *heads[start]))
            for start in _HEADS
            if start in heads
        ]

    def _at(self, now_ns: int) -> int:
        """Return a time that no earlier frame has, so that a repeated frame is recognised by it."""
        self._last_time_ns = max(now_ns, self._last_time_ns + 1)
        return self._last_time_ns


def _note(heads: dict[bytes, tuple[int, bytes]], now_ns: int, line: bytes) -> None:
    for start in _HEADS:
        if line.startswith(start):
            if start == _HEADS[0]:
                heads.clear()  # the set-up of another session
            heads[start] = (now_ns, line)
