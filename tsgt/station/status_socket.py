"""The socket on which a station's client says how it does: whoever connects gets one JSON line, and the end."""

from __future__ import annotations

import asyncio
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from tsgt.recording import encode_line
from tsgt.service import UnixListener

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from tsgt.station.status import ClientStatus


@contextmanager
def serving_status(path: Path, status: Callable[[], ClientStatus], *, mode: int = 0o660) -> Iterator[None]:
    """Serve the status from the running event loop, until the block ends.

    Nothing is read and nobody is waited for: a line fits into the kernel's buffer of a new connection.

    Parameters
    ----------
    path
        The socket. A stale one of an earlier run is replaced; its folder is created if need be.
    status
        Makes the record.
    mode
        Permissions of the socket.

    Raises
    ------
    StreamError
        Another program serves the socket, or it cannot be made.
    """
    listener = UnixListener(path, mode)
    listener.socket.setblocking(False)

    def answer() -> None:
        with suppress(OSError):  # who asked is gone already
            connection, _ = listener.socket.accept()
            with connection:
                connection.setblocking(False)
                connection.send(encode_line(status()) + b"\n")

    loop = asyncio.get_running_loop()
    loop.add_reader(listener.socket, answer)
    try:
        yield
    finally:
        loop.remove_reader(listener.socket)
        listener.remove()
        listener.socket.close()
