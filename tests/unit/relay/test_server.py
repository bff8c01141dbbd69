"""The relay's server with readers on real connections."""

from __future__ import annotations

import asyncio
import socket
import subprocess
from contextlib import asynccontextmanager, closing, contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.files.records import HELLO, POSE, SETUP

from tsgt.client import AsyncStream, AuthenticationError, Event, Gap, Hello, Pose, Setup, pump, relay_wire
from tsgt.client.records import monotonic_ns
from tsgt.client.tls import relay_context
from tsgt.errors import StreamError
from tsgt.recording import encode_line
from tsgt.relay import server as relay_server
from tsgt.relay.admission import ATTEMPTS, MAX_PENDING_OF_ADDRESS
from tsgt.relay.buffer import LineBuffer
from tsgt.relay.server import RelayServer

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from tsgt.client import Record

KEY = bytes(range(32))
STREAM = "ab" * 16
LOOPBACK = "127.0.0.1"
GREETING = [encode_line(HELLO), encode_line(SETUP)]


def pose_line(number: int) -> bytes:
    """Return one of the poses."""
    return encode_line(replace(POSE, kind="predicted", stamp_ns=POSE.stamp_ns + number * 50_000_000))


@asynccontextmanager
async def relay(
    tls: tuple[ssl.SSLContext, str] | None = None, max_bytes: int = 1 << 20
) -> AsyncIterator[RelayServer]:
    """Run a relay that has got the greeting."""
    buffer = LineBuffer(STREAM, KEY, max_bytes=max_bytes, max_age_ns=10**12)
    async with RelayServer(LOOPBACK, 0, KEY, buffer, tls=tls, now_ns=monotonic_ns) as server:
        for line in GREETING:
            server.line(line)
        yield server


async def readers(server: RelayServer, count: int) -> None:
    """Return when the server has this number of readers."""
    async with asyncio.timeout(5):
        while len(server.readers) < count:  # noqa: ASYNC110 (the server has no event for it)
            await asyncio.sleep(0.001)


async def taken(stream: AsyncStream, count: int) -> list[Record]:
    """Return the next records."""
    found: list[Record] = []
    async for record in stream:
        found.append(record)
        if len(found) == count:
            break
    return found


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[ssl.SSLContext, str]:
    """Return the settings of a relay with a certificate as the guide has it made."""
    folder = tmp_path_factory.mktemp("certificate")
    command = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=tsgt-relay "
        f"-keyout {folder}/key.pem -out {folder}/certificate.pem"
    )
    subprocess.run(command.split(), check=True, capture_output=True)
    return relay_context(folder / "certificate.pem", folder / "key.pem")


async def _read_all(server: RelayServer, scheme: str) -> list[Record]:
    async with AsyncStream(f"{scheme}://{LOOPBACK}:{server.port}", key=KEY) as stream:
        reading = asyncio.create_task(taken(stream, 5))
        await readers(server, 1)
        for number in range(3):
            server.line(pose_line(number))
        return await asyncio.wait_for(reading, 5)


def test_reader_gets_greeting_and_poses() -> None:
    """Over TCP with the key."""

    async def main() -> None:
        async with relay() as server:
            found = await _read_all(server, "relay")
        assert [type(record) for record in found] == [Hello, Setup, Pose, Pose, Pose]

    asyncio.run(main())


def test_tls_carries_the_same(certificate: tuple[ssl.SSLContext, str]) -> None:
    """With a self-signed certificate that the reader has never seen."""

    async def main() -> None:
        async with relay(certificate) as server:
            found = await _read_all(server, "relays")
        assert [type(record) for record in found] == [Hello, Setup, Pose, Pose, Pose]

    asyncio.run(main())


def test_tls_in_many_pieces(certificate: tuple[ssl.SSLContext, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """What the reader has to say is sent also when it stops receiving for now."""
    monkeypatch.setattr(pump, "MAX_RECEIVES", 1)

    async def main() -> None:
        async with relay(certificate) as server:
            await _read_all(server, "relays")

    asyncio.run(main())


@pytest.mark.parametrize("scheme", ["relay", "relays"])
def test_wrong_key_gets_nothing(certificate: tuple[ssl.SSLContext, str], scheme: str) -> None:
    """Not even the greeting; the reader's program is told."""

    async def main() -> None:
        async with (
            relay(certificate if scheme == "relays" else None) as server,
            AsyncStream(f"{scheme}://{LOOPBACK}:{server.port}", key=bytes(32)) as stream,
        ):
            with pytest.raises(AuthenticationError, match="another key"):
                await taken(stream, 1)
            assert stream.hello is None

    asyncio.run(main())


def test_reader_cannot_write() -> None:
    """Whatever it sends after the handshake is discarded."""

    async def main() -> None:
        async with relay() as server, AsyncStream(f"relay://{LOOPBACK}:{server.port}", key=KEY) as stream:
            await asyncio.wait_for(taken(stream, 2), 5)
            own = stream._pump._socket
            assert own is not None
            own.send(b'{"type":"pose"}\n' * 1000)
            await asyncio.sleep(0.02)
            server.line(pose_line(0))
            assert [type(record) for record in await asyncio.wait_for(taken(stream, 1), 5)] == [Pose]

    asyncio.run(main())


def test_damaged_tls_record_ends_one_reader_alone(certificate: tuple[ssl.SSLContext, str]) -> None:
    """A line or a sign of life may follow before the event loop knows of the disconnection."""
    damaged = b"\x17\x03\x03\x00\x20" + bytes(32)

    async def main() -> None:
        async with relay(certificate) as server:
            source = f"relays://{LOOPBACK}:{server.port}"
            async with AsyncStream(source, key=KEY) as stream, AsyncStream(source, key=KEY) as other:
                await asyncio.wait_for(taken(stream, 2), 5)
                (damaging,) = server.readers
                await asyncio.wait_for(taken(other, 2), 5)
                damaging.data_received(damaged)
                server.line(pose_line(0))
                server.beat(connected=True)
                damaging.send_lines()
                assert len(server.readers) == 1
                assert [type(record) for record in await asyncio.wait_for(taken(other, 1), 5)] == [Pose]

    asyncio.run(main())


@contextmanager
def connections(port: int, count: int) -> Iterator[list[socket.socket]]:
    """Open connections that say nothing."""
    found = [socket.create_connection((LOOPBACK, port)) for _ in range(count)]
    try:
        yield found
    finally:
        for connection in found:
            connection.close()


def test_silent_connections_are_limited() -> None:
    """The oldest ones are closed, and soon all further ones of that address."""

    async def main() -> None:
        async with relay() as server:
            with connections(server.port, 60):
                await asyncio.sleep(0.05)
                assert len(server.pending) <= MAX_PENDING_OF_ADDRESS

    asyncio.run(main())


@pytest.mark.parametrize(
    "request_line", [b"\n", b"hello?\n", b"A" * 5000, b"\xff\n", b"GET / HTTP/1.1\r\n\r\n"]
)
def test_other_requests_are_closed(request_line: bytes) -> None:
    """After the challenge nothing follows."""

    async def main() -> None:
        async with relay() as server:
            reader, writer = await asyncio.open_connection(LOOPBACK, server.port)
            challenge = await reader.readline()
            assert challenge.startswith(b"tsgt-relay 1 ")
            writer.write(request_line)
            with suppress(ConnectionResetError):
                assert await asyncio.wait_for(reader.read(), 5) == b""
            writer.close()

    asyncio.run(main())


def test_stalled_reader_costs_the_others_nothing() -> None:
    """It is told what it has lost when it goes on; the other one gets each line."""
    noise, lines = b'{"type":"noise","text":"%s"}' % (b"x" * 100_000), 200

    async def main() -> None:
        async with relay(max_bytes=1_000_000) as server:
            source = f"relay://{LOOPBACK}:{server.port}"
            async with AsyncStream(source, key=KEY) as stalled, AsyncStream(source, key=KEY) as other:
                await asyncio.wait_for(taken(stalled, 2), 5)
                stalled._unwatch()  # stops reading
                reading = asyncio.create_task(taken(other, 3))
                await readers(server, 2)
                for _ in range(lines):
                    server.line(noise)
                    await asyncio.sleep(0.001)
                server.line(pose_line(0))
                assert [type(each) for each in await asyncio.wait_for(reading, 20)] == [Hello, Setup, Pose]
                counting = asyncio.create_task(taken(stalled, 4))
                await asyncio.sleep(0)
                stalled._step()
                lost, *rest = await asyncio.wait_for(counting, 20)
        assert isinstance(lost, Gap)
        assert lost.lines is not None
        assert 0 < lost.lines < lines
        assert [type(each) for each in rest] == [Hello, Setup, Pose]

    asyncio.run(main())


def test_cut_connection_is_resumed() -> None:
    """Each line arrives once."""

    async def main() -> None:
        async with relay() as server, AsyncStream(f"relay://{LOOPBACK}:{server.port}", key=KEY) as stream:
            await asyncio.wait_for(taken(stream, 2), 5)
            for reader in list(server.readers):
                reader.abort()
            for number in range(10):
                server.line(pose_line(number))
            found = await asyncio.wait_for(taken(stream, 10), 5)
            stamps = [record.stamp_ns for record in found if isinstance(record, Pose)]
            assert stamps == [POSE.stamp_ns + number * 50_000_000 for number in range(10)]

    asyncio.run(main())


def test_many_lines_to_a_cut_connection_log_nothing(caplog: pytest.LogCaptureFixture) -> None:
    """Poses are sent in bursts, before the event loop knows of the disconnection."""

    async def main() -> None:
        async with relay() as server, AsyncStream(f"relay://{LOOPBACK}:{server.port}", key=KEY) as stream:
            await asyncio.wait_for(taken(stream, 2), 5)
            for reader in list(server.readers):
                reader.abort()
            for number in range(20):
                server.line(pose_line(number))

    asyncio.run(main())
    assert not [record for record in caplog.records if record.name == "asyncio"]


def test_long_resumption_overflows_no_queue() -> None:
    """The lines of some minutes arrive within a moment."""
    count = 4000

    async def main() -> None:
        async with (
            relay(max_bytes=10_000_000) as server,
            AsyncStream(f"relay://{LOOPBACK}:{server.port}", key=KEY) as stream,
        ):
            await asyncio.wait_for(taken(stream, 2), 5)
            for reader in list(server.readers):
                reader.abort()
            for number in range(count):
                server.line(b'{"type":"event","stamp_ns":%d,"event":"e","message":""}' % number)
            found = await asyncio.wait_for(taken(stream, count), 10)
        assert [record.stamp_ns for record in found if isinstance(record, Event)] == list(range(count))

    asyncio.run(main())


@pytest.fixture
def one_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a relay have one reader."""
    monkeypatch.setattr(relay_server, "MAX_READERS", 1)


async def told(stream: AsyncStream, problem: str) -> None:
    """Return when a stream has a problem."""
    async with asyncio.timeout(5):
        while problem not in stream.problem:  # noqa: ASYNC110 (it has no event for it)
            await asyncio.sleep(0.001)


@pytest.mark.usefixtures("one_place")
@pytest.mark.parametrize("scheme", ["relay", "relays"])
def test_reader_waits_for_a_place(certificate: tuple[ssl.SSLContext, str], scheme: str) -> None:
    """A full relay tells it so, and not that its key is wrong; once there is a place it gets every line since."""

    async def main() -> None:
        async with relay(certificate if scheme == "relays" else None) as server:
            source = f"{scheme}://{LOOPBACK}:{server.port}"
            async with AsyncStream(source, key=KEY) as waiting:
                async with AsyncStream(source, key=KEY) as first:
                    await asyncio.wait_for(taken(first, 2), 5)
                    reading = asyncio.create_task(taken(waiting, 5))
                    await told(waiting, "too many readers")
                    for number in range(2):
                        server.line(pose_line(number))
                    await asyncio.sleep(0.5)  # some attempts
                    assert not reading.done()
                    assert "too many readers" in waiting.problem
                await readers(server, 1)
                server.line(pose_line(2))
                found = await asyncio.wait_for(reading, 5)
                assert waiting.problem == ""
        assert [type(record) for record in found] == [Hello, Setup, Pose, Pose, Pose]

    asyncio.run(main())


@pytest.mark.usefixtures("one_place")
def test_full_relay_costs_no_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader whose place was taken while it was away resumes once there is another."""

    async def main() -> None:
        async with relay() as server, AsyncStream(f"relay://{LOOPBACK}:{server.port}", key=KEY) as stream:
            await asyncio.wait_for(taken(stream, 2), 5)
            monkeypatch.setattr(relay_server, "MAX_READERS", 0)
            for reader in list(server.readers):
                reader.abort()
            server.line(pose_line(0))
            await told(stream, "too many readers")
            server.line(pose_line(1))
            monkeypatch.setattr(relay_server, "MAX_READERS", 1)
            found = await asyncio.wait_for(taken(stream, 2), 5)
        stamps = [record.stamp_ns for record in found if isinstance(record, Pose)]
        assert stamps == [POSE.stamp_ns, POSE.stamp_ns + 50_000_000]

    asyncio.run(main())


def test_long_wait_for_a_place_is_one_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    """And not one at each attempt."""
    count = 400

    async def main() -> None:
        async with (
            relay(max_bytes=20_000) as server,
            AsyncStream(f"relay://{LOOPBACK}:{server.port}", key=KEY) as stream,
        ):
            await asyncio.wait_for(taken(stream, 2), 5)
            monkeypatch.setattr(relay_server, "MAX_READERS", 0)
            for reader in list(server.readers):
                reader.abort()
            reading = asyncio.create_task(taken(stream, 4))
            for number in range(count):
                server.line(pose_line(number))
                await asyncio.sleep(0.001)
            monkeypatch.setattr(relay_server, "MAX_READERS", 1)
            found = await asyncio.wait_for(reading, 5)
        assert [type(record) for record in found] == [Gap, Hello, Setup, Pose]
        gap, pose = found[0], found[-1]
        assert isinstance(gap, Gap)
        assert isinstance(pose, Pose)
        assert gap.lines == (pose.stamp_ns - POSE.stamp_ns) // 50_000_000

    asyncio.run(main())


@pytest.mark.usefixtures("one_place")
def test_full_relay_is_a_failure_without_reconnection() -> None:
    """And not the end of the stream."""

    async def main() -> None:
        async with relay() as server:
            source = f"relay://{LOOPBACK}:{server.port}"
            async with (
                AsyncStream(source, key=KEY) as first,
                AsyncStream(source, key=KEY, reconnect=False) as second,
            ):
                await asyncio.wait_for(taken(first, 2), 5)
                with pytest.raises(StreamError, match="too many readers"):
                    await asyncio.wait_for(taken(second, 3), 5)

    asyncio.run(main())


@pytest.mark.usefixtures("one_place")
def test_attempts_at_a_full_relay_are_limited() -> None:
    """Readers of an earlier version do not know why the connection ends, and try again at once."""

    async def attempt(port: int) -> bytes:
        reader, writer = await asyncio.open_connection(LOOPBACK, port)
        with suppress(ConnectionResetError), closing(writer):
            if challenge := (await reader.readline()).decode().rstrip("\n"):
                request = relay_wire.request(KEY, relay_wire.NO_CHANNEL, challenge, bytes(32), None)
                writer.write(request.encode() + b"\n")
                return await asyncio.wait_for(reader.read(), 5)
        return b""

    async def main() -> None:
        async with relay() as server, AsyncStream(f"relay://{LOOPBACK}:{server.port}", key=KEY) as first:
            await asyncio.wait_for(taken(first, 2), 5)
            answers = [await attempt(server.port) for _ in range(3 * ATTEMPTS)]
        assert answers[0].count(b"\n") == 2 + len(GREETING)
        assert sum(map(bool, answers)) < 2 * ATTEMPTS

    asyncio.run(main())


def test_busy_relay_that_is_then_off_has_no_other_key() -> None:
    """One connection that ends at the proof, and others that are refused, prove nothing."""

    async def main() -> None:
        with socket.create_server((LOOPBACK, 0)) as listener:
            port = listener.getsockname()[1]
            stream = AsyncStream(f"relay://{LOOPBACK}:{port}", key=KEY)
            async with stream:
                reading = asyncio.create_task(taken(stream, 1))
                await asyncio.sleep(0.05)
                connection, _ = listener.accept()
                listener.close()
                connection.sendall(relay_wire.challenge(bytes(32)).encode() + b"\n")
                await asyncio.sleep(0.05)
                assert connection.recv(512)
                connection.close()
                await told(stream, "refused")
                await asyncio.sleep(0.5)
                assert not reading.done()
                reading.cancel()

    asyncio.run(main())


def test_key_with_password_is_an_error(tmp_path: Path) -> None:
    """Nobody could enter it for a service."""
    command = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -passout pass:word -days 2 -subj /CN=x "
        f"-keyout {tmp_path}/key.pem -out {tmp_path}/certificate.pem"
    )
    subprocess.run(command.split(), check=True, capture_output=True)
    with pytest.raises(ValueError, match="password"):
        relay_context(tmp_path / "certificate.pem", tmp_path / "key.pem")
