"""Lines from a daemon's UNIX socket."""

from __future__ import annotations

import socket
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tsgt.client.build import load
from tsgt.errors import StreamError
from tsgt.recording import MAX_LINE_BYTES, PROTOCOL_VERSION

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


class LineReader:
    """Reads a stream socket line by line."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._received = bytearray()

    def line(self, until_s: float | None = None) -> bytes:
        """Return the next line with its newline; at the end of the stream nothing: a line that the end has cut is dropped.

        Parameters
        ----------
        until_s
            Deadline on the monotonic clock in s; None: wait for ever.

        Raises
        ------
        TimeoutError
            The line is incomplete at the deadline; the part received is kept for the next call.
        ValueError
            The line is longer than any line of tsgt.
        """
        while b"\n" not in self._received:
            if len(self._received) > MAX_LINE_BYTES:
                raise ValueError(f"a line is longer than {MAX_LINE_BYTES} bytes")
            if until_s is not None:
                if (left_s := until_s - time.monotonic()) <= 0:
                    raise TimeoutError
                self._connection.settimeout(left_s)
            data = self._connection.recv(65536)
            if not data:
                return b""
            self._received += data
        line, end, rest = bytes(self._received).partition(b"\n")
        self._received[:] = rest
        return line + end

    def send(self, line: bytes) -> None:
        """Send a line."""
        self._connection.sendall(line + b"\n")


@contextmanager
def connect(path: Path, timeout_s: float | None = None) -> Iterator[LineReader]:
    """Connect to a UNIX socket; raises OSError."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        connection.connect(str(path))
        yield LineReader(connection)


def check_version(line: bytes) -> None:
    """Raise StreamError for the greeting of another protocol version: fields may have another meaning."""
    if b'"hello"' not in line:
        return
    try:
        data = load(line)
    except StreamError:  # a line that cannot be read is no greeting
        return
    if data["type"] == "hello" and data.get("protocol") != PROTOCOL_VERSION:
        raise StreamError(
            f"the stream has protocol version {data.get('protocol')}, this program supports version {PROTOCOL_VERSION}; "
            "use the tsgt of the stream's version"
        )
