"""Relay and page of the endurance run: two processes, a reader of the relay, and a connection as a browser has it."""

from __future__ import annotations

import asyncio
import re
import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Self

from tsgt.client.links import RelayLink
from tsgt.client.records import Gap
from tsgt.client.relay_wire import NO_CHANNEL, NONCE_BYTES
from tsgt.errors import StreamError
from tsgt.radio.key_file import read_key, write_key

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Sequence
    from pathlib import Path

HOST = "127.0.0.1"
RETRY_S = 0.2
MIN_SHARE = 0.98
"""Of the poses that a reader of the master's socket gets, a reader of the relay gets at least this many."""
MAX_PAUSE_S = 20.0
"""The page sends something several times a second; a busy machine and an ended master take some seconds."""

UNRECORDED = 60
"""Poses of a second: what the killed master had streamed and not yet written."""

_POSE = b'{"type":"pose",'
_READ_BYTES = 1 << 16


class Subscribers:
    """Runs `tsgt relay` and `tsgt web`, an async context manager; ``pids``: of the processes, by name."""

    def __init__(self, folder: Path, socket: Path) -> None:
        self._folder = folder
        self._socket = socket
        self._key_path = folder / "relay.key"
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._ports: dict[str, int] = {}
        self._relayed: list[int] = []  # hashes of the lines with poses
        self._gaps: list[Gap] = []
        self._messages = self._connections = 0
        self._longest_pause_s = 0.0

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by name."""
        return {name: process.pid for name, process in self._processes.items()}

    async def __aenter__(self) -> Self:
        write_key(self._key_path)
        common = ("--socket", str(self._socket))
        await self._start("relay", *common, "--key", str(self._key_path), "--listen", f"{HOST}:0")
        await self._start("web", *common, "--listen", HOST, "--port", "0")
        return self

    async def __aexit__(self, *_: object) -> None:
        for process in self._processes.values():
            with suppress(ProcessLookupError):
                process.terminate()
            await process.wait()

    async def _start(self, name: str, *arguments: str) -> None:
        log = self._folder / f"{name}.log"
        with log.open("ab") as log_file:
            self._processes[name] = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "tsgt", name, *arguments, stdout=log_file, stderr=log_file
            )
        pattern = r"the page is at http://[^:]+:(\d+)" if name == "web" else r'"port": (\d+)'
        while True:
            text = log.read_text()
            if found := re.search(pattern, text):
                self._ports[name] = int(found[1])
                return
            if self._processes[name].returncode is not None:
                raise StreamError(f"tsgt {name} has ended: {text[-300:]}")
            await asyncio.sleep(RETRY_S)

    async def follow_relay(self) -> None:
        """Read the relay until cancelled, with the client's own link."""
        key = read_key(self._key_path)
        link = RelayLink(key, lambda: bytes(NONCE_BYTES))
        reader, writer = await asyncio.open_connection(HOST, self._ports["relay"])
        writer.write(link.connected(NO_CHANNEL))
        async for data in _chunks(reader):
            for found in link.receive(data, time.monotonic_ns()):
                if isinstance(found, bytes):
                    writer.write(found)
                elif isinstance(found, Gap):
                    self._gaps.append(found)
                elif found.line.startswith(_POSE):
                    self._relayed.append(hash(found.line))

    async def follow_page(self) -> None:
        """Read the page's messages until cancelled, and count them."""
        port = self._ports["web"]
        while True:
            reader, writer = await asyncio.open_connection(HOST, port)
            self._connections += 1
            writer.write(f"GET /stream HTTP/1.1\r\nHost: {HOST}:{port}\r\n\r\n".encode())
            last_s = time.monotonic()
            async for data in _chunks(reader):
                self._messages += data.count(b"\n\n")
                now_s = time.monotonic()
                self._longest_pause_s, last_s = max(self._longest_pause_s, now_s - last_s), now_s
            writer.close()
            await asyncio.sleep(RETRY_S)

    def counts(self) -> dict[str, float]:
        """Return what they got."""
        return {
            "poses over the relay": len(self._relayed),
            "gaps told by it": len(self._gaps),
            "messages of the page": self._messages,
            "connections to it": self._connections,
            "s without a message of it at most": round(self._longest_pause_s, 1),
        }

    def failures(self, recordings: Sequence[Path], poses_read: int) -> Iterator[str]:
        """Yield what was not passed on as it is; ``poses_read``: by the reader of the master's socket."""
        recorded = {hash(line) for path in recordings for line in path.read_bytes().splitlines()}
        changed = sum(line not in recorded for line in self._relayed)
        if changed > UNRECORDED:
            yield f"{changed} poses came over the relay that are in no recording"
        if len(set(self._relayed)) < len(self._relayed):
            yield f"{len(self._relayed) - len(set(self._relayed))} poses came over the relay twice"
        if len(self._relayed) < MIN_SHARE * poses_read:
            yield f"{len(self._relayed)} poses came over the relay, {poses_read} from the master's socket"
        lines = sum(gap.lines or 0 for gap in self._gaps)
        if lines:
            yield f"the relay left out {lines} lines"
        if self._connections != 1 or not self._messages:
            yield f"the page was connected {self._connections} times and sent {self._messages} messages"
        if self._longest_pause_s > MAX_PAUSE_S:
            yield f"the page sent nothing for {self._longest_pause_s:.1f} s, at most {MAX_PAUSE_S:g} s"


async def _chunks(reader: asyncio.StreamReader) -> AsyncIterator[bytes]:
    while data := await reader.read(_READ_BYTES):
        yield data
