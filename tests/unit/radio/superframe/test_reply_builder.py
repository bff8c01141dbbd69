"""Selection of measurements for a reply, and their grouping into blocks."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.radio.scripted_master import queued
from hypothesis import given
from hypothesis import strategies as st

from tsgt.radio.superframe.reply_builder import MAX_BLOCK_MEASUREMENTS, pack
from tsgt.radio.superframe.send_queue import StampedMeasurement, quality_of
from tsgt.radio.superframe.wire import (
    MAX_NARROW_AGE_NS,
    CommandResponse,
    Reply,
    decode_reply,
    encode_reply,
    quality_bound_us,
    reply_bytes,
)

PERIOD = 25_000


def stamped(
    sequence: int,
    *,
    prism: int = 1,
    quality: int = 2,
    beacon_relative: bool = False,
    distance_m: float | None = None,
    age_ns: int | None = 0,
    time: int | None = None,
) -> StampedMeasurement:
    """Return a measurement; one every 0.4 s."""
    made = queued(sequence, 0, prism=prism)
    made = made if distance_m is None else replace(made, distance_m=distance_m)
    return StampedMeasurement(
        made, PERIOD * sequence if time is None else time, quality, beacon_relative, age_ns
    )


def packed(
    *by_urgency: StampedMeasurement, limit: int = 125, prism: int | None = 1, narrow: bool = True
) -> Reply:
    """Return a reply with measurements only."""
    reply, packed_ones = pack(
        Reply(), by_urgency, limit, prism=prism, is_narrow=lambda _sequence, _newest: narrow
    )
    assert len(packed_ones) == sum(len(block.measurements) for block in reply.blocks)
    assert reply_bytes(reply) <= limit
    decode_reply(encode_reply(reply))
    return reply


def lengths(reply: Reply) -> list[int]:
    """Return the number of measurements per block."""
    return [len(block.measurements) for block in reply.blocks]


@pytest.mark.parametrize(
    ("bound_us", "quality"), [(0.0, 0), (16.0, 0), (16.1, 1), (128.0, 3), (524_288.0, 15), (524_289.0, None)]
)
def test_quality_of_bound(bound_us: float, quality: int | None) -> None:
    """The best quality that does not claim less."""
    assert quality_of(bound_us) == quality
    if quality is not None:
        assert bound_us <= quality_bound_us(quality)


def test_reply_is_filled() -> None:
    """Newest first, in one block."""
    newest_first = [stamped(number) for number in range(40, 0, -1)]
    reply = packed(*newest_first, limit=71)
    assert len(reply.blocks) == 1
    assert reply.blocks[0].measurements[0].sequence == 40
    longer = lengths(packed(*newest_first, limit=80))
    assert lengths(reply)[0] < longer[0] <= MAX_BLOCK_MEASUREMENTS
    assert lengths(packed(*newest_first[:2], limit=125)) == [2]
    assert packed(limit=5) == Reply()
    assert packed(*newest_first, limit=16) == Reply()


@given(
    st.integers(5, 125), st.lists(st.tuples(st.integers(1, 3), st.integers(0, 9), st.booleans()), max_size=30)
)
def test_filled_reply_has_no_room(limit: int, kinds: list[tuple[int, int, bool]]) -> None:
    """For any mixture of measurements."""
    newest_first = [
        stamped(1000 - index, prism=prism, quality=quality, beacon_relative=beacon_relative)
        for index, (prism, quality, beacon_relative) in enumerate(kinds)
    ]
    reply = packed(*newest_first, limit=limit)
    count = sum(lengths(reply))
    if count < len(newest_first):
        more = packed(*newest_first[: count + 1], limit=255)
        assert reply_bytes(more) > limit or len(more.blocks) > 15


@pytest.mark.parametrize(
    "other",
    [
        stamped(1, prism=2),
        stamped(1, beacon_relative=True),
        stamped(1, distance_m=2000.0),
        stamped(1, quality=9),
        stamped(1, time=-(1 << 36)),
    ],
)
def test_incompatible_measurements_get_their_own_block(other: StampedMeasurement) -> None:
    """Another prism, time reference or unit, a much worse quality, another age."""
    assert lengths(packed(stamped(3), stamped(2), other)) == [2, 1]


def test_block_has_worst_quality() -> None:
    """Of measurements of similar quality."""
    reply = packed(stamped(2, quality=1), stamped(1, quality=6))
    assert lengths(reply) == [2]
    assert reply.blocks[0].quality == 6


def test_block_names_unexpected_prism() -> None:
    """And every prism while the master's is unknown."""
    assert [block.prism for block in packed(stamped(2), stamped(1, prism=4)).blocks] == [None, 4]
    assert [block.prism for block in packed(stamped(2), prism=None).blocks] == [1]


@pytest.mark.parametrize(
    ("age_ns", "narrow", "wide"),
    [
        (0, True, False),
        (MAX_NARROW_AGE_NS, True, False),
        (MAX_NARROW_AGE_NS + 1, True, True),
        (None, True, True),
        (0, False, True),
    ],
)
def test_ambiguous_block_is_wide(age_ns: int | None, narrow: bool, wide: bool) -> None:  # noqa: FBT001 (a case)
    """Old times, times of another boot, ambiguous numbers."""
    assert packed(stamped(5, age_ns=age_ns), narrow=narrow).blocks[0].wide is wide


def test_most_urgent_measurements_are_packed() -> None:
    """In the order of their numbers."""
    (block,) = packed(stamped(9), stamped(1), stamped(2), stamped(8), limit=32).blocks
    assert [measurement.sequence for measurement in block.measurements] == [9, 2, 1]
    (block,) = packed(stamped(1), stamped(9), limit=17).blocks
    assert block.measurements[0].sequence == 1


def test_other_parts_are_kept() -> None:
    """They reduce the room for measurements."""
    parts = Reply(response=CommandResponse(3, ok=True))
    reply, packed_ones = pack(parts, [stamped(1)], 125, prism=1, is_narrow=lambda _sequence, _newest: True)
    assert (reply.response, len(packed_ones)) == (parts.response, 1)
    assert pack(parts, [stamped(1)], 17, prism=1, is_narrow=lambda _sequence, _newest: True) == (parts, ())
