"""Lines of a stream, and a socket that serves them: for readers, not for what a whole master does."""

from __future__ import annotations

import socket
import threading
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from harness.missions.processes import TIMEOUT_S

from tsgt.recording import encode_line

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def lines(*records: object) -> bytes:
    """Return records, or lines as they are, as on the wire."""
    return b"".join((line if isinstance(line, bytes) else encode_line(line)) + b"\n" for line in records)


@contextmanager
def serving(path: Path, *connections: bytes) -> Iterator[None]:
    """Serve each connection its bytes and close it; connections that nobody asks for are left out at the end."""

    def serve() -> None:
        for data in connections:
            connection, _ = listener.accept()
            with connection, suppress(OSError):
                connection.sendall(data)

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield
        finally:
            for _ in connections:
                with suppress(OSError), socket.socket(socket.AF_UNIX) as last:
                    last.settimeout(0.1)
                    last.connect(str(path))
            thread.join(TIMEOUT_S)
