"""Sans-I/O: what arrives from the master's socket or from a relay, taken apart into lines of the stream.

A link outlives its connections: it knows what it has already handed out. Time and nonces are handed in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from tsgt.client import relay_wire as wire
from tsgt.client.delay import LeastDelay
from tsgt.client.records import Gap
from tsgt.errors import StreamError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

MAX_LINE_BYTES = 1 << 20

SILENCE_TIMEOUT_NS = 5_000_000_000
"""A relay sends something each second; a connection without anything for this long is dead."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A line of the stream without its end."""

    line: bytes
    arrived_ns: int
    """When it arrived at the robot's side, on the link's clock: see :meth:`Link.here_ns`."""


class Link(Protocol):
    """Turns the bytes of one connection after the other into lines."""

    silence_timeout_ns: int | None
    ready: bool
    """Whether the present connection has come as far as to give lines."""
    failed_at_key: bool
    """Whether the present connection ended, or would end now, at a peer that was shown the proof of a key."""
    full: bool
    """Whether the peer of the present connection has said that it has too many readers, and ends it."""

    def connected(self, channel: str) -> bytes:
        """Begin a new connection, and return what to send. ``channel``: what TLS binds proofs to."""

    def receive(self, data: bytes, now_ns: int) -> Iterator[Arrival | Gap | bytes]:
        """Take received data; yields lines, gaps, and bytes to send. Raises StreamError if the peer cannot be used."""

    def here_ns(self, arrived_ns: int) -> int:
        """Return the time of an arrival on CLOCK_MONOTONIC of this computer, in ns."""


class LineSplitter:
    """Splits a byte stream into lines of limited length."""

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self._received = bytearray()

    def split(self, data: bytes) -> Iterator[bytes]:
        """Take data; yields the complete lines without their ends; raises StreamError for one that is too long."""
        self._received += data
        start = 0
        try:
            while (end := self._received.find(b"\n", start)) >= 0:
                if end - start > self.max_bytes:
                    break
                line = bytes(self._received[start:end])
                start = end + 1
                yield line
        finally:
            del self._received[:start]
        if len(self._received) > self.max_bytes:
            raise StreamError(f"a line is longer than {self.max_bytes} bytes: not a stream of tsgt")


class SocketLink:
    """The master's UNIX socket: nothing but lines, and nothing from before the connection."""

    silence_timeout_ns: int | None = None
    failed_at_key = False
    full = False

    def __init__(self) -> None:
        self._connections = 0
        self.ready = False

    def connected(self, channel: str) -> bytes:  # noqa: ARG002 (no proofs)
        """Begin a new connection."""
        self._splitter = LineSplitter(MAX_LINE_BYTES)
        self._connections += 1
        self.ready = False
        return b""

    def receive(self, data: bytes, now_ns: int) -> Iterator[Arrival | Gap | bytes]:
        """Take received data."""
        for line in self._splitter.split(data):
            if not self.ready:
                self.ready = True
                if self._connections > 1:
                    yield Gap(lines=None, reason="the connection to the master was lost")
            yield Arrival(line, now_ns)

    def here_ns(self, arrived_ns: int) -> int:
        """Return the time of an arrival: the link's clock is ours."""
        return arrived_ns


class RelayLink:
    """A relay: handshake, authenticated lines, and resumption after the last line that arrived.

    Parameters
    ----------
    key
        The relay's key.
    new_nonce
        Returns :data:`~tsgt.client.relay_wire.NONCE_BYTES` random bytes.
    resume
        Whether to ask for the lines that were missed while there was no connection.
    """

    silence_timeout_ns: int | None = SILENCE_TIMEOUT_NS

    def __init__(self, key: bytes, new_nonce: Callable[[], bytes], *, resume: bool = True) -> None:
        self._key = key
        self._new_nonce = new_nonce
        self._resume = resume
        self._next: wire.Position | None = None
        self._last_beat_ns = 0
        self._delay = LeastDelay()
        self._has_hello = False
        self.ready = False
        self.failed_at_key = False
        self.full = False

    @property
    def position(self) -> wire.Position | None:
        """The line that is expected next; None before the first connection."""
        return self._next

    def connected(self, channel: str) -> bytes:
        """Begin a new connection."""
        self._channel = channel
        self._splitter = LineSplitter(wire.MAX_HANDSHAKE_BYTES)
        self._challenge = self._request = ""
        self.ready = self.failed_at_key = self.full = False
        return b""

    def receive(self, data: bytes, now_ns: int) -> Iterator[Arrival | Gap | bytes]:
        """Take received data."""
        for line in self._splitter.split(data):
            if self.ready:
                yield from self._frame(line, now_ns)
            elif not self._challenge:
                yield self._answer(_text(line))
            else:
                yield from self._welcome(_text(line), now_ns)

    def here_ns(self, arrived_ns: int) -> int:
        """Return the time of an arrival at the relay, by the least delay of any line since the first connection."""
        return self._delay.here_ns(arrived_ns)

    def _answer(self, challenge: str) -> bytes:
        wire.check_challenge(challenge)
        self._challenge = challenge
        resume = self._next if self._resume else None
        self._request = wire.request(self._key, self._channel, challenge, self._new_nonce(), resume)
        self.failed_at_key = True
        return self._request.encode() + b"\n"

    def _welcome(self, line: str, now_ns: int) -> Iterator[Gap]:
        first, relay_ns = wire.check_welcome(self._key, self._channel, self._challenge, self._request, line)
        self.failed_at_key = False
        self.ready = True
        self._splitter.max_bytes = wire.MAX_FRAME_BYTES
        self._line_key = wire.line_key(self._key, first.stream)
        expected = self._next
        if expected is None or expected.stream != first.stream:
            self._delay = LeastDelay()
            self._last_beat_ns = 0
            if expected is not None:
                yield Gap(lines=None, reason="the relay was restarted")
        elif first.number < expected.number:
            raise StreamError(f"the relay goes back from line {expected.number} to {first.number}")
        elif first.number > expected.number:
            yield Gap(lines=first.number - expected.number, reason="the relay no longer holds these lines")
        self._delay.sample(relay_ns, now_ns)
        self._next = first

    def _frame(self, line: bytes, now_ns: int) -> Iterator[Arrival | Gap]:
        frame = wire.decode_frame(self._line_key, line)
        assert self._next is not None  # noqa: S101 (set by the welcome)
        expected = self._next.number
        if frame.number < expected:
            raise StreamError(f"the relay repeats line {frame.number} instead of {expected}")
        if frame.kind != "head":  # which is older than what follows
            if frame.kind == "beat":
                if frame.time_ns <= self._last_beat_ns:
                    raise StreamError("the relay repeats a sign of life")
                self._last_beat_ns = frame.time_ns
                self.full = self.full or frame.text == wire.FULL
            self._delay.sample(frame.time_ns, now_ns)
        if frame.number > expected:
            yield Gap(lines=frame.number - expected, reason="this reader was too slow for the relay")
        if frame.kind == "line":
            if frame.text.startswith(b'{"type":"hello"'):
                if self._has_hello:
                    yield Gap(lines=None, reason="the relay had lost its connection to the master")
                self._has_hello = True
            yield Arrival(frame.text, frame.time_ns)
        elif frame.kind == "head":
            self._has_hello = True
            yield Arrival(frame.text, frame.time_ns)
        self._next = wire.Position(self._next.stream, frame.number + (frame.kind == "line"))


def _text(line: bytes) -> str:
    try:
        return line.decode("ascii")
    except UnicodeDecodeError:
        return ""
