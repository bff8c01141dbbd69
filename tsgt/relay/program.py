"""The relay: reads the master's socket and serves its lines, until it is cancelled."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.client.records import monotonic_ns
from tsgt.client.relay_wire import STREAM_BYTES
from tsgt.recording import MAX_LINE_BYTES
from tsgt.relay.buffer import LineBuffer
from tsgt.relay.server import RelayServer
from tsgt.service import notify_systemd

if TYPE_CHECKING:
    import ssl
    from pathlib import Path

    from tsgt.clock import Clock

HELD_BYTES = 32 << 20

BEAT_INTERVAL_S = 1.0

BACK_OFF_S = (0.1, 2.0)
"""Wait before the first further attempt to connect to the master, and the longest; it doubles in between."""

REFUSED = "the connection was closed without a line; are there too many readers?"

log = structlog.get_logger()


async def run_relay(
    source: Path,
    host: str,
    port: int,
    key: bytes,
    clock: Clock,
    *,
    held_s: float,
    tls: tuple[ssl.SSLContext, str] | None = None,
) -> NoReturn:
    """Serve the stream of a UNIX socket at a TCP address; raises StreamError if it cannot listen there.

    ``held_s``: for how long lines are held for readers that come back, up to :data:`HELD_BYTES`.
    """
    buffer = LineBuffer(
        secrets.token_hex(STREAM_BYTES), key, max_bytes=HELD_BYTES, max_age_ns=round(held_s * 1e9)
    )
    async with RelayServer(host, port, key, buffer, tls=tls, now_ns=monotonic_ns) as server:
        reader = SourceReader(source, server)

        def status() -> str:
            state = "connected to the master" if reader.connected else "waiting for the master"
            return f"{state}, {len(server.readers)} readers, {buffer.next} lines"

        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(reader.run())
            tasks.create_task(_beats(server, reader))
            tasks.create_task(notify_systemd(status, clock))
    raise AssertionError("the tasks run for ever")


class SourceReader:
    """Reads the master's socket, and connects again for ever."""

    def __init__(self, source: Path, server: RelayServer) -> None:
        self._source = source
        self._server = server
        self.connected = False

    async def run(self) -> NoReturn:
        """Pass all lines on."""
        back_off_s = BACK_OFF_S[0]
        problem = ""
        while True:
            try:
                reader, writer = await asyncio.open_unix_connection(str(self._source), limit=MAX_LINE_BYTES)
            except OSError as error:
                found = error.strerror or str(error)
            else:
                try:
                    found = "" if await self._pass_on(reader) else REFUSED
                finally:
                    self.connected = False
                    self._server.buffer.source_lost()
                    writer.close()
                    with suppress(OSError):
                        await writer.wait_closed()
            if not found:
                back_off_s = BACK_OFF_S[0]
                log.warning("relay_source_lost", path=str(self._source))
            elif found != problem:
                log.warning("relay_source_missing", path=str(self._source), error=found)
            problem = found
            await asyncio.sleep(back_off_s)
            back_off_s = min(2 * back_off_s, BACK_OFF_S[1])

    async def _pass_on(self, reader: asyncio.StreamReader) -> bool:
        """Pass the lines of a connection on; return whether there were any: a master with too many readers sends none."""
        with suppress(ConnectionError, ValueError):  # ValueError: a line that is too long
            while (line := await reader.readline()).endswith(b"\n"):
                if not self.connected:
                    self.connected = True
                    log.info("relay_source_connected", path=str(self._source))
                self._server.line(line[:-1])
        return self.connected


async def _beats(server: RelayServer, source: SourceReader) -> NoReturn:
    while True:
        await asyncio.sleep(BEAT_INTERVAL_S)
        server.beat(connected=source.connected)
