"""Lines that are held, and where readers start: against a list of all lines."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tsgt.client.relay_wire import Position, decode_frame, line_key
from tsgt.relay.buffer import LineBuffer

KEY = bytes(32)
STREAM = "ab" * 16
SECOND = 1_000_000_000

lines_strategy = st.lists(
    st.sampled_from([b'{"type":"hello","n":%d}', b'{"type":"setup","n":%d}', b'{"type":"pose","n":%d}']),
    max_size=40,
)


@given(lines_strategy, st.integers(0, 45), st.integers(100, 1500), st.integers(1, 20))
def test_reader_gets_each_line_once(kinds: list[bytes], wanted: int, max_bytes: int, max_age_s: int) -> None:
    """From where it wants, or else from the oldest line, with the greeting and set-up that were in force there."""
    buffer = LineBuffer(STREAM, KEY, max_bytes=max_bytes, max_age_ns=max_age_s * SECOND)
    lines = [kind % number for number, kind in enumerate(kinds)]
    for number, line in enumerate(lines):
        buffer.append(line, number * SECOND)
    start, heads = buffer.start(Position(STREAM, wanted))
    key = line_key(KEY, STREAM)
    if wanted > len(lines):  # never given to it
        assert start.number == len(lines)
    else:
        assert start.number == max(wanted, buffer.oldest)
    got = [
        decode_frame(key, buffer.frame(number).rstrip(b"\n")) for number in range(start.number, buffer.next)
    ]
    assert [(frame.number, frame.text) for frame in got] == list(enumerate(lines))[start.number :]
    if start.number == wanted:
        assert heads == []
    else:
        before = lines[: start.number]
        hello = max((at for at, line in enumerate(before) if b"hello" in line), default=-1)
        setup = max((at for at, line in enumerate(before) if b"setup" in line and at > hello), default=-1)
        expected = [before[at] for at in (hello, setup) if at >= 0]
        assert [decode_frame(key, head.rstrip(b"\n")).text for head in heads] == expected


@given(st.lists(st.tuples(st.integers(1, 300), st.integers(0, 3)), max_size=40))
def test_limits_are_kept(steps: list[tuple[int, int]]) -> None:
    """Of bytes and of age, but for the newest line."""
    buffer = LineBuffer(STREAM, KEY, max_bytes=1000, max_age_ns=5 * SECOND)
    now_s = 0
    times = []
    for size, wait_s in steps:
        now_s += wait_s
        times.append(now_s)
        buffer.append(b"x" * size, now_s * SECOND)
        held = range(buffer.oldest, buffer.next)
        held_bytes = sum(len(buffer.frame(number)) for number in held)
        assert len(held) == 1 or (held_bytes <= 1000 and now_s - times[buffer.oldest] <= 5)


def test_other_stream_starts_with_new_lines() -> None:
    """The numbers of an earlier run mean nothing."""
    buffer = LineBuffer(STREAM, KEY, max_bytes=1000, max_age_ns=SECOND)
    buffer.append(b'{"type":"hello","protocol":1}', 0)
    start, heads = buffer.start(Position("cd" * 16, 0))
    assert (start.number, len(heads)) == (1, 1)


def test_lost_master_is_not_introduced() -> None:
    """Its greeting would say that poses follow."""
    buffer = LineBuffer(STREAM, KEY, max_bytes=1000, max_age_ns=SECOND)
    buffer.append(b'{"type":"hello","protocol":1}', 0)
    assert len(buffer.start(None)[1]) == 1
    buffer.source_lost()
    assert buffer.start(None)[1] == []
