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
    """Return a line with its number and about a size."""
    return json.dumps({"type": "test", "number": number, "fill": "x" * size}).encode()


class Client:
    """A reader that reads on request."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    @classmethod
    async def connect(cls, path: Path) -> Client:
        """Connect and read the greeting."""
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
        """Read what the kernel has."""
        while True:
            try:
                piece = self.socket.recv(1 << 20)
            except BlockingIOError:
                return
            if not piece:
                return
            self._data += piece

    def records(self) -> list[dict[str, Any]]:
        """Return the complete lines that were read, without the greeting."""
        whole_lines = self._data.split(b"\n")[1:-1]
        return [json.loads(text) for text in whole_lines]


async def settle() -> None:
    """Run the event loop until it is idle."""
    for _ in range(20):
        await asyncio.sleep(0)


async def test_greeting_comes_first(path: Path) -> None:
    """Then what is published after the reader connected."""
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


async def test_new_readers_get_the_newest_setup(path: Path) -> None:
    """After the greeting, before all other lines; readers that are there get it as any line."""
    setups = [b'{"type":"setup","stamp_ns":1}', b'{"type":"setup","stamp_ns":2}']
    async with StreamServer(path, HELLO) as server:
        clients = [await Client.connect(path)]
        for line_ in (*setups, line(7)):
            server.publish(line_)
        clients.append(await Client.connect(path))
        server.publish(line(8))
        for client, stamps in zip(clients, ([1, 2], [2]), strict=True):
            assert [(await client.record())["stamp_ns"] for _ in stamps] == stamps
        assert (await clients[0].record())["number"] == 7
        for client in clients:
            assert (await client.record())["number"] == 8
            await client.close()


async def test_slow_reader_gets_the_number_of_lost_lines(path: Path) -> None:
    """One event in the place of the lost lines, then the newest lines."""
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


@pytest.mark.parametrize("turns", range(8))
async def test_reader_that_connects_while_a_set_up_is_read_gets_it(path: Path, turns: int) -> None:
    """Its greeting is not from before: at any turn of the event loop between connecting and being greeted."""
    setup = b'{"type":"setup","stamp_ns":2}'
    async with StreamServer(path, HELLO) as server:
        server.publish(b'{"type":"setup","stamp_ns":1}')
        with socket.socket(socket.AF_UNIX) as connected:
            connected.setblocking(False)
            connected.connect(str(path))
            for _ in range(turns):
                await asyncio.sleep(0)
            server.publish(setup)
            await settle()
            assert connected.recv(1000).splitlines()[-1] == setup


async def test_slow_reader_gets_a_lost_setup(path: Path) -> None:
    """The newest one, once, in its place behind the event; it does not count as lost, and those before it do."""

    def setup(number: int) -> bytes:
        return b'{"type":"setup","stamp_ns":%d}' % number

    async with StreamServer(path, HELLO, queue_lines=10, unix_now_ns=lambda: 77) as server:
        sleepy = SleepyClient(path)
        await server.wait_for_reader()
        for last in (199, 399, 599):
            for number in range(last - 199, last + 1):
                if number in (150, 160, 350, 396):
                    server.publish(setup(number))
                server.publish(line(number, BIG))
            while not sleepy.records() or sleepy.records()[-1].get("number") != last:
                sleepy.take()
                await settle()
        sleepy.socket.close()
    told = [
        record.get("event", record.get("stamp_ns")) for record in sleepy.records() if record["type"] != "test"
    ]
    assert told == ["lines_lost", 160, "lines_lost", 350, 396, "lines_lost"]
    counts = [record["count"] for record in sleepy.records() if record.get("event")]
    assert sum(counts) + len(sleepy.records()) - len(counts) == 604


async def test_slow_reader_does_not_affect_others(path: Path) -> None:
    """While one reader loses lines, another one gets all of them."""
    async with StreamServer(path, HELLO, queue_lines=10) as server:
        sleepy = SleepyClient(path)
        client = await Client.connect(path)
        for number in range(200):
            server.publish(line(number, BIG))
            assert (await client.record())["number"] == number
        sleepy.socket.close()
        await client.close()


async def test_lost_lines_are_counted_per_gap(path: Path) -> None:
    """Lost lines are counted per gap."""
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


async def test_publish_when_ready_loses_nothing(path: Path) -> None:
    """It waits for a slow reader."""
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


async def test_publish_when_ready_continues_after_a_disconnect(path: Path) -> None:
    """Publish when ready continues after a disconnect."""
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


async def test_publish_when_ready_without_readers_does_not_wait(path: Path) -> None:
    """Publish when ready without readers does not wait."""
    async with StreamServer(path, HELLO) as server:
        await server.publish_when_ready(line(0))


async def test_wait_for_reader_returns_with_the_first_reader(path: Path) -> None:
    """Wait for reader returns with the first reader."""
    async with StreamServer(path, HELLO) as server, asyncio.TaskGroup() as group:
        waiting = group.create_task(server.wait_for_reader())
        await settle()
        assert not waiting.done()
        client = await Client.connect(path)
        await waiting
        await client.close()


async def test_abrupt_disconnect_does_not_affect_others(path: Path) -> None:
    """Abrupt disconnect does not affect others."""
    async with StreamServer(path, HELLO) as server:
        sleepy = SleepyClient(path)
        client = await Client.connect(path)
        sleepy.socket.close()
        for number in range(50):
            server.publish(line(number))
            assert (await client.record())["number"] == number
        await client.close()


async def test_many_lines_to_a_reader_that_has_gone_log_nothing(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Poses are published in bursts, before the event loop knows of the disconnection."""
    async with StreamServer(path, HELLO) as server:
        gone = SleepyClient(path)
        await settle()
        gone.socket.close()
        for number in range(20):
            server.publish(line(number))
        await settle()
        assert server.readers == 0
    assert not caplog.records


async def test_half_closed_reader_gets_lines(path: Path) -> None:
    """A reader that has closed its sending side still reads."""
    async with StreamServer(path, HELLO) as server:
        client = await Client.connect(path)
        client.writer.write_eof()
        await settle()
        server.publish(line(1))
        assert (await client.record())["number"] == 1
        await client.close()


async def test_reader_beyond_the_limit_is_disconnected(path: Path) -> None:
    """Also when they connect at once; a place becomes free when a reader leaves."""
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


async def test_input_from_a_reader_is_ignored(path: Path) -> None:
    """Input from a reader is ignored."""
    async with StreamServer(path, HELLO) as server:
        client = await Client.connect(path)
        client.writer.write(b"\xff\0{garbage\n" * 100_000)
        await client.writer.drain()
        server.publish(line(1))
        assert (await client.record())["number"] == 1
        await client.close()


async def test_closing_delivers_the_queues(path: Path) -> None:
    """A reader gets all queued lines, then the end of the stream."""
    async with asyncio.TaskGroup() as group, StreamServer(path, HELLO) as server:
        client = await Client.connect(path)
        for number in range(500):
            server.publish(line(number, BIG))
        reading = group.create_task(client.rest())
    assert [record["number"] for record in await reading] == list(range(500))


async def test_closing_has_a_timeout(path: Path) -> None:
    """Closing has a timeout."""
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
async def test_mode_is_0660(path: Path, umask: int) -> None:
    """Whatever the umask."""
    before = os.umask(umask)
    try:
        async with StreamServer(path, HELLO):
            assert stat.S_IMODE(path.stat().st_mode) == 0o660
    finally:
        os.umask(before)


async def test_socket_is_never_world_accessible(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even before its mode is set, without a umask."""
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
    """A killed program may leave its socket."""
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(path))
        stale.listen()
    assert path.is_socket()
    async with StreamServer(path, HELLO):
        await (await Client.connect(path)).close()


async def test_socket_in_use_is_an_error(path: Path) -> None:
    """It stays with its server, and the error says what to do."""
    refused = pytest.raises(StreamError, match=rf"^{path}: another program serves this socket; [^\n]+$")
    async with StreamServer(path, HELLO):
        with refused:
            await StreamServer(path, HELLO).__aenter__()
        await (await Client.connect(path)).close()


async def test_socket_with_a_full_backlog_is_in_use(path: Path) -> None:
    """Socket with a full backlog is in use."""
    with socket.socket(socket.AF_UNIX) as busy, socket.socket(socket.AF_UNIX) as waiting:
        busy.bind(str(path))
        busy.listen(0)
        waiting.connect(str(path))
        with pytest.raises(StreamError, match="another program serves this socket"):
            await StreamServer(path, HELLO).__aenter__()


async def test_other_file_is_not_replaced(path: Path) -> None:
    """Other file is not replaced."""
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
    """Socket is removed at the end."""
    async with StreamServer(path, HELLO):
        pass
    assert not path.exists()


async def test_socket_of_a_successor_is_not_removed(path: Path) -> None:
    """Socket of a successor is not removed."""
    with socket.socket(socket.AF_UNIX) as other:
        async with StreamServer(path, HELLO):
            path.rename(path.with_suffix(".old"))
            other.bind(str(path))
        assert path.is_socket()


async def test_disconnect_is_detected_without_publishing(path: Path) -> None:
    """So that an idle stream does not accumulate dead readers."""
    async with StreamServer(path, HELLO) as server:
        for _ in range(20):
            client = await Client.connect(path)
            await client.close()
            await settle()
        assert server.readers == 0


@pytest.mark.parametrize("turns", range(5))
async def test_reader_that_connects_while_closing_is_disconnected(path: Path, turns: int) -> None:
    """Reader that connects while closing is disconnected."""
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


async def test_finish_waits_for_a_slow_reader(path: Path) -> None:
    """It gets every line before the stream ends."""
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
