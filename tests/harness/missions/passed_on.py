"""The real relay with a reader, and the real page's state, open throughout a simulated mission: what they got of the stream."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from tsgt.client.links import Arrival, RelayLink
from tsgt.client.relay_wire import KEY_BYTES, NO_CHANNEL, NONCE_BYTES, STREAM_BYTES
from tsgt.relay.buffer import LineBuffer
from tsgt.relay.program import SourceReader
from tsgt.relay.server import RelayServer
from tsgt.simulation.checks.heard_lines import heard_failures
from tsgt.web.mission.state import MissionState
from tsgt.web.source import follow

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from tsgt.simulation.mission import Mission, MissionResult

KEY = bytes(range(KEY_BYTES))
HELD_BYTES, HELD_NS = 1 << 22, 60_000_000_000
RELINK_S = 0.5
MIN_SHARE = 0.5
"""Of the published lines, each gets at least this many: it connects within three seconds after a start of the master."""

RECENT_POSES = 25
"""The page takes some of the poses of a second."""

_HELLO, _STATUS, _POSE = (f'{{"type":"{kind}",'.encode() for kind in ("hello", "status", "pose"))
_READ_BYTES = 1 << 20


class _Lines:
    """Hashes of lines, by connection to the master."""

    def __init__(self) -> None:
        self.connections: list[list[int]] = []

    def take(self, line: bytes) -> None:
        if line.startswith(_HELLO):
            self.connections.append([])
        self.connections[-1].append(hash(line))


class _Page:
    """The state of the page: takes lines, and is looked at with each status."""

    def __init__(self) -> None:
        self.lines = _Lines()
        self.problems: list[str] = []
        self.looks = 0
        self._state = MissionState("mission")
        self._live: deque[bytes] = deque(maxlen=RECENT_POSES)
        self.connected, self.disconnected = self._state.connected, self._state.disconnected

    def line(self, data: bytes, now_s: float) -> None:
        """Take a line."""
        self.lines.take(data.rstrip(b"\n"))
        self._state.line(data, now_s)
        if data.startswith(_POSE) and b'"kind":"smoothed"' not in data and b'"position_m":null' not in data:
            self._live.append(data)
        if data.startswith(_STATUS) and self._live:
            self.looks += 1
            shown = json.loads(json.dumps(self._state.view(now_s)))["pose"]
            positions = [[round(x, 3) for x in json.loads(each)["position_m"]] for each in self._live]
            if shown is not None and shown["at"] not in positions:
                self.problems.append(
                    f"the page shows the robot at {shown['at']}, where no pose of the last second was"
                )


class PassedOn:
    """What a reader of the relay, and the page, got in a mission."""

    def __init__(self) -> None:
        self.relayed = _Lines()
        self.page = _Page()

    async def follow(self, mission: Mission, folder: Path, until_s: float) -> None:
        """Follow the stream of all masters, until a time in s from the start of the mission."""
        stream = folder / "followed.sock"  # leads to the socket of the present master

        def now_ns() -> int:
            return round(1e9 * mission.now_s)

        buffer = LineBuffer("5" * 2 * STREAM_BYTES, KEY, max_bytes=HELD_BYTES, max_age_ns=HELD_NS)
        async with RelayServer("127.0.0.1", 0, KEY, buffer, tls=None, now_ns=now_ns) as server:
            source = SourceReader(stream, server)
            tasks = [
                asyncio.create_task(each)
                for each in (
                    _link_to_master(mission, stream),
                    self._read_relay(server.port, now_ns),
                    source.run(),
                    follow(stream, self.page, mission.clock),
                )
            ]
            await mission.sleep_until(until_s)
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            for task in tasks:
                with suppress(asyncio.CancelledError):
                    task.result()

    async def _read_relay(self, port: int, now_ns: Callable[[], int]) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        link = RelayLink(KEY, lambda: bytes(NONCE_BYTES))
        writer.write(link.connected(NO_CHANNEL))
        try:
            while data := await reader.read(_READ_BYTES):
                for found in link.receive(data, now_ns()):
                    if isinstance(found, bytes):
                        writer.write(found)
                    elif isinstance(found, Arrival):
                        self.relayed.take(found.line)
        finally:
            writer.close()

    def failures(self, result: MissionResult) -> Iterator[str]:
        """Yield in what the reader and the page differ from the stream."""
        published = sum(len(log.line_hashes) for log in result.master_logs)
        for name, lines in (("relay", self.relayed), ("page", self.page.lines)):
            for connection in lines.connections:
                if all(list(heard_failures(log, [connection])) for log in result.master_logs):
                    yield f"{name}: {len(connection)} lines are not greeting, set-up and successive lines of the stream"
            got = sum(map(len, lines.connections))
            if got < MIN_SHARE * published:
                yield f"{name}: {got} lines of {published}, at least {MIN_SHARE:g} of them were to arrive"
        yield from self.page.problems[:3]


async def _link_to_master(mission: Mission, path: Path) -> NoReturn:
    """Let a path lead to the socket of the present master."""
    while True:
        _link(path, mission.stream_socket())
        await asyncio.sleep(RELINK_S)


def _link(path: Path, target: Path) -> None:
    if not path.is_symlink() or path.readlink() != target:
        path.unlink(missing_ok=True)
        path.symlink_to(target)
