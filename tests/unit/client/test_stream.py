"""Both faces against servers on real sockets."""

from __future__ import annotations

import asyncio
import itertools
import socket
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.files.records import EVENT, HELLO, NO_POSE, POSE, STATUS, measurement
from harness.files.stream_lines import lines, serving
from hypothesis import given, settings
from hypothesis import strategies as st

from tsgt.client import (
    AsyncStream,
    Event,
    Gap,
    Hello,
    Measurement,
    Pose,
    ProtocolVersionError,
    Status,
    Stream,
)
from tsgt.client.links import Arrival, SocketLink
from tsgt.errors import StreamError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from tsgt.client import Record

MS = 1_000_000
PREDICTED = replace(POSE, kind="predicted")


def predicted(number: int) -> object:
    """Return one of the predicted poses, 50 ms apart."""
    return replace(PREDICTED, stamp_ns=PREDICTED.stamp_ns + number * 50 * MS)


async def _gather(path: Path, count: int, *, reconnect: bool) -> list[Record]:
    found: list[Record] = []
    async with AsyncStream(path, reconnect=reconnect) as stream:
        async for record in stream:
            found.append(record)
            if len(found) == count:
                break
    return found


def _plain(path: Path, count: int, *, reconnect: bool) -> list[Record]:
    with Stream(path, reconnect=reconnect) as stream:
        return list(itertools.islice(stream, count))


def _asyncio(path: Path, count: int, *, reconnect: bool) -> list[Record]:
    return asyncio.run(_gather(path, count, reconnect=reconnect))


both = pytest.mark.parametrize("read", [_plain, _asyncio])


@both
def test_records_arrive_in_order(tmp_path: Path, read: Callable[..., list[Record]]) -> None:
    """Of the types that the client knows; the end of the stream is the end."""
    sent = (HELLO, measurement(0), b'{"type":"weather"}', PREDICTED, STATUS, NO_POSE)
    with serving(tmp_path / "s", lines(*sent)):
        found = read(tmp_path / "s", 99, reconnect=False)
    assert [type(record) for record in found] == [Hello, Measurement, Pose, Status, Pose]


@both
def test_reconnection_is_told_as_a_gap(tmp_path: Path, read: Callable[..., list[Record]]) -> None:
    """After the master's end the next one's lines follow."""
    with serving(tmp_path / "s", lines(HELLO, predicted(0)), lines(HELLO, predicted(1))):
        found = read(tmp_path / "s", 5, reconnect=True)
    assert [type(record) for record in found] == [Hello, Pose, Gap, Hello, Pose]


@both
def test_another_protocol_is_an_error(tmp_path: Path, read: Callable[..., list[Record]]) -> None:
    """Also when it would reconnect."""
    with serving(tmp_path / "s", b'{"type":"hello","protocol":2}\n'), pytest.raises(ProtocolVersionError):
        read(tmp_path / "s", 1, reconnect=True)


@both
def test_missing_socket_is_an_error_without_reconnection(
    tmp_path: Path, read: Callable[..., list[Record]]
) -> None:
    """It says which socket."""
    with pytest.raises(StreamError, match=f"{tmp_path}/s: No such file"):
        read(tmp_path / "s", 1, reconnect=False)


@both
def test_lost_lines_are_told_as_a_gap(tmp_path: Path, read: Callable[..., list[Record]]) -> None:
    """With their number."""
    with serving(tmp_path / "s", lines(HELLO, EVENT)):
        found = read(tmp_path / "s", 99, reconnect=False)
    assert isinstance(found[1], Event)
    assert found[2] == Gap(lines=7, reason="this reader was too slow for the master")


@both
def test_unusable_line_is_told_as_a_gap(tmp_path: Path, read: Callable[..., list[Record]]) -> None:
    """The stream goes on behind it."""
    with serving(tmp_path / "s", lines(HELLO, b'{"type":"pose"}', b"?", PREDICTED)):
        found = read(tmp_path / "s", 99, reconnect=False)
    assert [type(record) for record in found] == [Hello, Gap, Gap, Pose]


@both
def test_what_is_no_stream_is_an_error(tmp_path: Path, read: Callable[..., list[Record]]) -> None:
    """Such as another service's socket."""
    with (
        serving(tmp_path / "s", b"220 mail ready\n"),
        pytest.raises(StreamError, match="not a line of a tsgt stream"),
    ):
        read(tmp_path / "s", 99, reconnect=False)


@settings(max_examples=30)
@given(st.lists(st.integers(1, 400), max_size=30))
def test_lines_may_arrive_in_any_pieces(sizes: list[int]) -> None:
    """A line may be cut anywhere."""
    link = SocketLink()
    link.connected("")
    data = lines(HELLO, predicted(0), STATUS)
    found: list[object] = []
    for size in [*sizes, len(data)]:
        found += link.receive(data[:size], 0)
        data = data[size:]
    assert [item.line for item in found if isinstance(item, Arrival)] == lines(
        HELLO, predicted(0), STATUS
    ).splitlines()


@contextmanager
def clocked(tmp_path: Path, *, tick_ns: int = 0) -> Iterator[tuple[Stream, socket.socket, list[int]]]:
    """Give a stream with a clock that the test sets, and the server's end of its connection.

    ``tick_ns``: by how much each look at the clock advances it.
    """
    now_ns = [10**12]

    def look() -> int:
        now_ns[0] += tick_ns
        return now_ns[0]

    with socket.socket(socket.AF_UNIX) as listener, Stream(tmp_path / "s", now_ns=look) as stream:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        assert stream.latest() is None
        connection, _ = listener.accept()
        with connection:
            yield stream, connection, now_ns


def test_latest_pose_becomes_stale(tmp_path: Path) -> None:
    """It is handed out until half a second after its epoch."""
    with clocked(tmp_path) as (stream, server, now_ns):
        server.sendall(lines(HELLO, predicted(0)))
        assert isinstance(stream.latest(), Pose)
        now_ns[0] += 500 * MS
        assert isinstance(stream.latest(), Pose)
        now_ns[0] += 1
        assert stream.latest() is None
        assert isinstance(stream.latest(max_age_s=1.0), Pose)


def test_delayed_pose_is_not_taken_for_a_new_one(tmp_path: Path) -> None:
    """Its age counts from its epoch, not from its arrival."""
    with clocked(tmp_path) as (stream, server, now_ns):
        server.sendall(lines(HELLO, predicted(0)))
        stream.latest()
        now_ns[0] += 650 * MS
        server.sendall(lines(predicted(1)))
        assert stream.latest() is None
        pose = stream.latest(max_age_s=1.0)
        assert pose is not None
        assert pose.age_s(now_ns[0]) == pytest.approx(0.6, abs=1e-3)


def test_stale_poses_are_skipped(tmp_path: Path) -> None:
    """An iterator that comes late gets what is fresh, and the rest is counted."""
    with clocked(tmp_path) as (stream, server, now_ns):
        server.sendall(lines(HELLO, predicted(0)))
        poses = stream.poses()
        next(poses)
        now_ns[0] += 2000 * MS
        server.sendall(lines(*map(predicted, range(1, 41))))
        assert next(poses).stamp_ns == PREDICTED.stamp_ns + 30 * 50 * MS
        assert stream.stale_poses == 29


def test_backlog_after_the_connection_is_not_taken_for_new(tmp_path: Path) -> None:
    """A program that connects and is busy for 3 s gets poses of the last half second only."""
    with clocked(tmp_path, tick_ns=MS) as (stream, server, now_ns):
        now_ns[0] += 3000 * MS
        server.sendall(lines(HELLO, *map(predicted, range(61))))
        pose = next(stream.poses())
        assert 50 <= (pose.stamp_ns - PREDICTED.stamp_ns) / (50 * MS) <= 60
        newest = stream.latest()
        assert newest is not None
        assert newest.stamp_ns == PREDICTED.stamp_ns + 3000 * MS
        assert newest.epoch_ns - pose.epoch_ns == newest.stamp_ns - pose.stamp_ns


def test_backlog_after_the_connection_arrives_in_pieces(tmp_path: Path) -> None:
    """The master sends the rest of its queue as the reader makes room: an empty socket alone is not the end."""
    with clocked(tmp_path) as (stream, server, now_ns):
        now_ns[0] += 3000 * MS
        server.sendall(lines(HELLO, *map(predicted, range(31))))
        assert stream.latest() is None
        now_ns[0] += 40 * MS
        server.sendall(lines(*map(predicted, range(31, 61))))
        assert stream.latest() is None
        now_ns[0] += 40 * MS
        assert stream.latest() is None
        now_ns[0] += 10 * MS
        pose = stream.latest()
        assert pose is not None
        assert pose.age_s(now_ns[0]) == pytest.approx(0.05)


def test_backlog_after_the_connection_is_dated_with_asyncio(tmp_path: Path) -> None:
    """Also there the event loop may have been busy."""
    now_ns = [10**12]

    def look() -> int:
        now_ns[0] += MS
        return now_ns[0]

    async def first() -> Pose:
        async with AsyncStream(tmp_path / "s", now_ns=look) as stream:
            assert stream.latest() is None
            connection, _ = await asyncio.get_running_loop().sock_accept(listener)
            with connection:
                now_ns[0] += 3000 * MS
                connection.sendall(lines(HELLO, *map(predicted, range(61))))
                async for pose in stream.poses():
                    return pose
        raise AssertionError

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        listener.setblocking(False)
        assert asyncio.run(first()).stamp_ns >= PREDICTED.stamp_ns + 2500 * MS


def test_backlog_after_a_long_pause_is_not_taken_for_new(tmp_path: Path) -> None:
    """In an hour the clocks may have drifted by 0.7 s, by which old lines could pass for newer ones."""
    with clocked(tmp_path, tick_ns=MS) as (stream, server, now_ns):
        server.sendall(lines(HELLO, predicted(0)))
        poses = stream.poses()
        next(poses)
        now_ns[0] += 3_600_000 * MS
        server.sendall(lines(*map(predicted, range(72_000 - 60, 72_001))))
        assert next(poses).stamp_ns >= PREDICTED.stamp_ns + 3_599_500 * MS


def test_smoothed_pose_before_all_else_has_its_age(tmp_path: Path) -> None:
    """Its arrival says nothing of its epoch, so it waits for a line that does."""
    smoothed = replace(POSE, kind="smoothed")
    with clocked(tmp_path) as (stream, server, now_ns):
        server.sendall(lines(HELLO, smoothed))
        assert stream.latest("smoothed") is None
        now_ns[0] += 20 * MS
        server.sendall(lines(predicted(60)))
        stream.latest()
        now_ns[0] += 50 * MS
        pose = stream.latest("smoothed")
        assert pose is not None
        assert pose.age_s(now_ns[0]) == pytest.approx(3.05)


def test_pose_without_another_line_is_handed_out(tmp_path: Path) -> None:
    """A stream may have nothing but smoothed poses."""
    with clocked(tmp_path) as (stream, server, now_ns):
        server.sendall(lines(HELLO, replace(POSE, kind="smoothed")))
        assert stream.latest("smoothed") is None
        now_ns[0] += 2000 * MS
        assert stream.latest("smoothed") is not None


def test_nothing_of_a_fast_replay_is_lost(tmp_path: Path) -> None:
    """Its stamps run ahead of the clock, so no age is ever known; the end hands out what was held."""
    now_ns = itertools.count(10**12, 1000 * MS)
    poses = [replace(PREDICTED, stamp_ns=PREDICTED.stamp_ns + number * 10**12) for number in range(4500)]
    with serving(tmp_path / "s", lines(HELLO, *poses)):
        stream = Stream(tmp_path / "s", reconnect=False, now_ns=lambda: next(now_ns))
        found = list(stream)
    assert [record.stamp_ns for record in found if isinstance(record, Pose)] == [
        pose.stamp_ns for pose in poses
    ]
    assert stream.gaps == 0


def test_latest_pose_is_behind_many_other_lines(tmp_path: Path) -> None:
    """All that has arrived is read."""
    with clocked(tmp_path) as (stream, server, _):
        server.sendall(lines(HELLO, *[b'{"type":"noise"}'] * 8_000, predicted(0)))
        assert stream.latest() is not None


def test_invalid_poses_are_left_out(tmp_path: Path) -> None:
    """Unless they are wanted."""
    with clocked(tmp_path) as (stream, server, _):
        server.sendall(lines(HELLO, measurement(0), NO_POSE))
        assert stream.latest() is None
        assert stream.latest(include_invalid=True) is not None


def test_series_are_told_apart(tmp_path: Path) -> None:
    """Smoothed poses are no live poses."""
    smoothed = replace(POSE, kind="smoothed", delay_s=1.0)
    with clocked(tmp_path) as (stream, server, _):
        server.sendall(lines(HELLO, replace(EVENT, stamp_ns=POSE.stamp_ns + 1000 * MS), smoothed))
        assert stream.latest() is None
        assert stream.latest("smoothed_1s") is not None
        assert stream.latest("smoothed") is None


def test_new_session_takes_its_own_clock(tmp_path: Path) -> None:
    """A master whose Unix clock was set back a day meanwhile gives fresh poses."""
    day = 86_400_000 * MS
    with clocked(tmp_path) as (stream, server, now_ns):
        server.sendall(lines(HELLO, predicted(0)))
        stream.latest()
        now_ns[0] += 1000 * MS
        server.sendall(lines(HELLO))
        assert stream.latest(max_age_s=99) is None
        server.sendall(lines(replace(PREDICTED, stamp_ns=PREDICTED.stamp_ns - day)))
        assert stream.latest() is not None


def test_end_for_good_is_told_by_latest(tmp_path: Path) -> None:
    """With asyncio the reading goes on elsewhere: None for ever would look like a silent master."""

    async def look() -> str:
        async with AsyncStream(tmp_path / "s") as stream:
            assert stream.latest() is None
            with pytest.raises(ProtocolVersionError):
                await anext(aiter(stream))
            with pytest.raises(ProtocolVersionError):
                stream.latest()
            return stream.problem

    with serving(tmp_path / "s", b'{"type":"hello","protocol":2}\n'):
        assert "protocol version 2" in asyncio.run(look())


def test_failure_without_reconnection_is_the_problem(tmp_path: Path) -> None:
    """As with reconnection."""
    stream = Stream(tmp_path / "s", reconnect=False)
    with pytest.raises(StreamError):
        stream.latest()
    assert stream.problem == f"{tmp_path}/s: No such file or directory"


def test_two_iterators_get_everything(tmp_path: Path) -> None:
    """With asyncio, poses and events can be followed side by side."""

    async def follow() -> tuple[int, int]:
        async with AsyncStream(tmp_path / "s", reconnect=False) as stream:

            async def poses() -> int:
                return len([pose async for pose in stream.poses()])

            async def events() -> int:
                return len([event async for event in stream.events()])

            both = await asyncio.gather(poses(), events())
            assert stream.latest() is not None
            return both[0], both[1]

    with serving(
        tmp_path / "s", lines(HELLO, predicted(0), replace(EVENT, stamp_ns=POSE.stamp_ns), predicted(1))
    ):
        assert asyncio.run(follow()) == (2, 1)


def test_each_reason_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Until there is a connection, however often reasons alternate."""
    now_ns = [0]
    with Stream(tmp_path / "s", now_ns=lambda: now_ns[0]) as stream:
        for attempt in range(6):
            if attempt % 2:
                (tmp_path / "s").write_bytes(b"")
            else:
                (tmp_path / "s").unlink(missing_ok=True)
            stream.latest()
            now_ns[0] += 10_000 * MS
        assert stream.problem.endswith("Connection refused")
    assert [record.getMessage().rpartition(": ")[2] for record in caplog.records] == [
        "No such file or directory; trying again",
        "Connection refused; trying again",
    ]
