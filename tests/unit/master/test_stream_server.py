# ruff: noqa: ASYNC240 (the temporary folder answers at once)
from __future__ import annotations

import asyncio
import json
import os
import socket
import stat
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from tsgt.errors import StreamError
from tsgt.master.stream_server import CLOSE_TIMEOUT_S, MAX_READERS, StreamServer

HELLO = b'{"type":"hello"}'
BIG = 50_000
"""Bytes of a line that fills the kernel's and the transport's buffers soon."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the socket is."""
    return tmp_path / "poses.sock"


def line(number: int, size: int = 0) -> bytes:
    """Make a line that says its number and has about the size."""
    return json.dumps({"type": "test", "number": number, "fill": "x" * size}).encode()


class Client:
    """A reader that reads when it is told to."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    @classmethod
    async def connect(cls, path: Path) -> Client:
        """Connect and take the greeting."""
        client = cls(*await asyncio.open_unix_connection(path, limit=2 * BIG))
        assert await client.reader.readline() == HELLO + b"\n"
        return client

    async def record(self) -> dict[str, Any]:
        """Read one line."""
        record: dict[str, Any] = json.loads(await self.reader.readline())
        return record

    async def rest(self) -> list[dict[str, Any]]:
        """Read to the end of the stream."""
        records = [json.loads(text) for text in (await self.reader.read()).splitlines()]
        await self.close()
        return records

    async def close(self) -> None:
        """Disconnect."""
        self.writer.close()
        await self.writer.wait_closed()


class SleepyClient:
    """A reader that does not read until it is asked for everything at once: no event loop empties its socket."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(str(path))
        self.socket.setblocking(False)
        self._data = b""

    def take(self) -> None:
        """Take what the kernel has."""
        while True:
            try:
                piece = self.socket.recv(1 << 20)
            except BlockingIOError:
                return
            if not piece:
                return
            self._data += piece

    def records(self) -> list[dict[str, Any]]:
        """Return the whole lines that have been taken, without the greeting."""
        whole_lines = self._data.split(b"\n")[1:-1]
        return [json.loads(text) for text in whole_lines]


async def settle() -> None:
    """Let the event loop do everything that it can do without waiting."""
    for _ in range(20):
        await asyncio.sleep(0)


async def test_greeting_comes_first(path: Path) -> None:
    """A reader gets the greeting, then what is published after it came, not what was before."""
    async with StreamServer(path, HELLO) as server:
        server.publish(line(0))
        client = await Client.connect(path)
        server.publish(line(1))
        assert (await client.record())["number"] == 1
        await client.close()


async def test_every_reader_gets_every_line(path: Path) -> None:
    """Lines go to all readers in the same order."""
    async with StreamServer(path, HELLO) as server:
        clients = [await Client.connect(path) for _ in range(3)]
        for number in range(10):
            server.publish(line(number))
        for client in clients:
            assert [(await client.record())["number"] for _ in range(10)] == list(range(10))
            await client.close()


async def test_slow_reader_is_told_what_it_lost(path: Path) -> None:
    """A reader that sleeps finds one event with the number of lost lines in their place, then the newest lines."""
    async with StreamServer(path, HELLO, queue_lines=10, unix_now_ns=lambda: 77) as server:
        sleepy = SleepyClient(path)
        await server.wait_for_reader()
        for number in range(200):
            server.publish(line(number, BIG))
        while not sleepy.records() or sleepy.records()[-1].get("number") != 199:
            sleepy.take()
            await settle()
        sleepy.socket.close()
    records = sleepy.records()
    (at,) = (i for i, record in enumerate(records) if record["type"] == "event")
    assert records[at]["event"] == "lines_lost"
    assert records[at]["stamp_ns"] == 77
    assert [record["number"] for record in records[:at]] == list(range(at))
    assert [record["number"] for record in records[at + 1 :]] == list(range(190, 200))
    assert records[at]["count"] == 190 - at > 100


async def test_slow_reader_does_not_cost_the_others(path: Path) -> None:
    """While one reader sleeps and loses lines, another one gets all of them."""
    async with StreamServer(path, HELLO, queue_lines=10) as server:
        sleepy = SleepyClient(path)
        client = await Client.connect(path)
        for number in range(200):
            server.publish(line(number, BIG))
            assert (await client.record())["number"] == number
        sleepy.socket.close()
        await client.close()


async def test_lost_lines_are_counted_anew(path: Path) -> None:
    """A reader that falls behind twice is told twice, each time with what it lost since."""
    async with StreamServer(path, HELLO, queue_lines=5) as server:
        sleepy = SleepyClient(path)
        await server.wait_for_reader()
        for last in (149, 299):
            for number in range(last - 149, last + 1):
                server.publish(line(number, BIG))
            while not sleepy.records() or sleepy.records()[-1].get("number") != last:
                sleepy.take()
                await settle()
        sleepy.socket.close()
    records = sleepy.records()
    counts = [record["count"] for record in records if record["type"] == "event"]
    assert len(counts) == 2
    assert sum(counts) + sum(record["type"] == "test" for record in records) == 300


async def test_patient_publishing_loses_nothing(path: Path) -> None:
    """Publishing patiently waits for a reader that sleeps now and then."""
    async with StreamServer(path, HELLO, queue_lines=3) as server:
        sleepy = SleepyClient(path)
        await server.wait_for_reader()

        async def publish() -> None:
            for number in range(100):
                await server.publish_when_ready(line(number, BIG))

        async with asyncio.TaskGroup() as group:
            publishing = group.create_task(publish())
            await settle()
            assert not publishing.done()
            while not sleepy.records() or sleepy.records()[-1]["number"] != 99:
                sleepy.take()
                await settle()
        sleepy.socket.close()
    assert [record["number"] for record in sleepy.records()] == list(range(100))


async def test_patient_publishing_goes_on_when_the_slow_reader_leaves(path: Path) -> None:
    """A reader that disconnects while it is waited for is waited for no longer."""
    async with StreamServer(path, HELLO, queue_lines=1) as server:
        sleepy = SleepyClient(path)
        await server.wait_for_reader()
        for number in range(200):
            server.publish(line(number, BIG))
        async with asyncio.TaskGroup() as group:
            publishing = group.create_task(server.publish_when_ready(line(200)))
            await settle()
            assert not publishing.done()
            sleepy.socket.close()


async def test_patient_publishing_without_readers_does_not_wait(path: Path) -> None:
    """With nobody there, lines go nowhere at once."""
    async with StreamServer(path, HELLO) as server:
        await server.publish_when_ready(line(0))


async def test_wait_for_reader_waits(path: Path) -> None:
    """The wait ends when the first reader comes."""
    async with StreamServer(path, HELLO) as server, asyncio.TaskGroup() as group:
        waiting = group.create_task(server.wait_for_reader())
        await settle()
        assert not waiting.done()
        client = await Client.connect(path)
        await waiting
        await client.close()


async def test_abrupt_disconnect_does_no_harm(path: Path) -> None:
    """A reader that goes in the middle of things leaves the others as they were."""
    async with StreamServer(path, HELLO) as server:
        sleepy = SleepyClient(path)
        client = await Client.connect(path)
        sleepy.socket.close()
        for number in range(50):
            server.publish(line(number))
            assert (await client.record())["number"] == number
        await client.close()


async def test_half_closed_reader_gets_lines(path: Path) -> None:
    """A reader that has closed its own sending direction still reads."""
    async with StreamServer(path, HELLO) as server:
        client = await Client.connect(path)
        client.writer.write_eof()
        await settle()
        server.publish(line(1))
        assert (await client.record())["number"] == 1
        await client.close()


async def test_one_reader_too_many_is_let_go(path: Path) -> None:
    """Also of those that come at once; when one of the others leaves, there is room again."""
    async with StreamServer(path, HELLO) as server:
        crowd = [socket.socket(socket.AF_UNIX) for _ in range(MAX_READERS + 20)]
        with capture_logs() as logs:
            for connection in crowd:
                connection.connect(str(path))
            await settle()
        assert server.readers == MAX_READERS
        assert [entry["event"] for entry in logs].count("reader_refused") == 20
        for connection in crowd:
            connection.close()
        await settle()
        client = await Client.connect(path)
        server.publish(line(1))
        assert (await client.record())["number"] == 1
        await client.close()


async def test_garbage_from_a_reader_is_thrown_away(path: Path) -> None:
    """A reader that talks, however much, gets the stream as any other."""
    async with StreamServer(path, HELLO) as server:
        client = await Client.connect(path)
        client.writer.write(b"\xff\0{garbage\n" * 100_000)
        await client.writer.drain()
        server.publish(line(1))
        assert (await client.record())["number"] == 1
        await client.close()


async def test_closing_hands_over_what_waits(path: Path) -> None:
    """At the end a reader gets all lines that still wait for it, then the end of the stream."""
    async with asyncio.TaskGroup() as group, StreamServer(path, HELLO) as server:
        client = await Client.connect(path)
        for number in range(500):
            server.publish(line(number, BIG))
        reading = group.create_task(client.rest())
    assert [record["number"] for record in await reading] == list(range(500))


async def test_closing_does_not_wait_for_ever(path: Path) -> None:
    """A reader that sleeps at the end holds the program up for the stated time and no longer."""
    server = await StreamServer(path, HELLO).__aenter__()
    sleepy = SleepyClient(path)
    await server.wait_for_reader()
    for number in range(100):
        server.publish(line(number, BIG))
    began_s = asyncio.get_running_loop().time()
    with capture_logs() as logs:
        await server.__aexit__()
    assert asyncio.get_running_loop().time() - began_s == pytest.approx(CLOSE_TIMEOUT_S)
    assert {"event": "stream_closed_on_slow_readers", "log_level": "warning", "readers": 1} in logs
    sleepy.socket.close()


@pytest.mark.parametrize("umask", [0o000, 0o077])
async def test_mode_is_as_asked_for(path: Path, umask: int) -> None:
    """The socket has mode 0660 whatever the umask."""
    before = os.umask(umask)
    try:
        async with StreamServer(path, HELLO):
            assert stat.S_IMODE(path.stat().st_mode) == 0o660
    finally:
        os.umask(before)


async def test_socket_is_never_open_to_all(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before its mode is set by name the socket has no more rights than that, even without a umask."""
    modes: list[int] = []
    really = Path.chmod

    def chmod(self: Path, mode: int) -> None:
        modes.append(stat.S_IMODE(self.stat().st_mode))
        really(self, mode)

    monkeypatch.setattr(Path, "chmod", chmod)
    before = os.umask(0)
    try:
        async with StreamServer(path, HELLO):
            pass
    finally:
        os.umask(before)
    assert modes == [0o660]


async def test_folder_is_created(tmp_path: Path) -> None:
    """A folder that does not exist yet is made."""
    path = tmp_path / "run" / "tsgt" / "poses.sock"
    async with StreamServer(path, HELLO):
        await (await Client.connect(path)).close()


async def test_stale_socket_is_replaced(path: Path) -> None:
    """A socket that a killed program left behind is no obstacle."""
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(path))
        stale.listen()
    assert path.is_socket()
    async with StreamServer(path, HELLO):
        await (await Client.connect(path)).close()


async def test_live_socket_is_refused(path: Path) -> None:
    """A socket that is served stays with the one who serves it, and the error says what to do."""
    refused = pytest.raises(StreamError, match=rf"^{path}: another program serves this socket; [^\n]+$")
    async with StreamServer(path, HELLO):
        with refused:
            await StreamServer(path, HELLO).__aenter__()
        await (await Client.connect(path)).close()


async def test_busy_live_socket_is_refused(path: Path) -> None:
    """A server whose queue of connections is full is alive all the same."""
    with socket.socket(socket.AF_UNIX) as busy, socket.socket(socket.AF_UNIX) as waiting:
        busy.bind(str(path))
        busy.listen(0)
        waiting.connect(str(path))
        with pytest.raises(StreamError, match="another program serves this socket"):
            await StreamServer(path, HELLO).__aenter__()


async def test_other_file_is_left_alone(path: Path) -> None:
    """What is not a socket is not touched."""
    path.write_bytes(b"notes")
    with pytest.raises(StreamError, match=rf"^{path}: is not a socket; [^\n]+$"):
        await StreamServer(path, HELLO).__aenter__()
    assert path.read_bytes() == b"notes"


async def test_impossible_folder_is_one_line(tmp_path: Path) -> None:
    """A folder that cannot be made is one line with the path."""
    (tmp_path / "file").touch()
    path = tmp_path / "file" / "poses.sock"
    with pytest.raises(StreamError, match=rf"^{path}: the socket cannot be created \([^\n]+$"):
        await StreamServer(path, HELLO).__aenter__()


async def test_long_path_is_one_line(tmp_path: Path) -> None:
    """A path that no socket address can hold is refused with its limit."""
    with pytest.raises(StreamError, match="at most 107 bytes"):
        await StreamServer(tmp_path / ("x" * 120), HELLO).__aenter__()


async def test_socket_is_removed_at_the_end(path: Path) -> None:
    """Nothing is left of the socket when the server has closed."""
    async with StreamServer(path, HELLO):
        pass
    assert not path.exists()


async def test_socket_of_a_successor_is_not_removed(path: Path) -> None:
    """Whoever has put another socket in place in the meantime keeps it."""
    with socket.socket(socket.AF_UNIX) as other:
        async with StreamServer(path, HELLO):
            path.rename(path.with_suffix(".old"))
            other.bind(str(path))
        assert path.is_socket()


async def test_a_reader_that_left_is_noticed_though_nothing_is_published(path: Path) -> None:
    """Its connection goes at once, so that a stream with nothing to say does not fill up with the dead."""
    async with StreamServer(path, HELLO) as server:
        for _ in range(20):
            client = await Client.connect(path)
            await client.close()
            await settle()
        assert server.readers == 0


@pytest.mark.parametrize("turns", range(5))
async def test_a_reader_that_comes_at_the_very_end_is_let_go(path: Path, turns: int) -> None:
    """Whenever it connects while the server closes, its connection ends instead of hanging."""
    with socket.socket(socket.AF_UNIX) as late:
        async with StreamServer(path, HELLO) as server:
            late.setblocking(False)
            late.connect(str(path))
            for _ in range(turns):
                await asyncio.sleep(0)
        await settle()
        assert server.readers == 0
        late.settimeout(1.0)
        with suppress(ConnectionResetError):  # it was never accepted
            assert late.recv(1000) in (b"", HELLO + b"\n")


async def test_finishing_waits_for_a_reader_however_slow(path: Path) -> None:
    """A reader that comes back after a minute still gets every line, and only then the stream ends."""
    async with StreamServer(path, HELLO) as server:
        sleepy = SleepyClient(path)
        await server.wait_for_reader()
        for number in range(100):
            server.publish(line(number, BIG))
        finishing = asyncio.create_task(server.finish())
        await asyncio.sleep(60.0)
        assert not finishing.done()
        while not finishing.done():
            sleepy.take()
            await asyncio.sleep(0.01)
    sleepy.take()
    assert [record["number"] for record in sleepy.records()] == list(range(100))
    sleepy.socket.close()
