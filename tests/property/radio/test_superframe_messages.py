"""Beacons and replies round-trip, and no packet breaks the codec or has two meanings."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.files.damage import examples
from hypothesis import given
from hypothesis import strategies as st

from tsgt.errors import MessageError
from tsgt.model import Status
from tsgt.radio.superframe.wire import (
    SINGLE_QUALITY,
    Beacon,
    CommandResponse,
    ConditionItem,
    EncodedCommand,
    EncodedDirection,
    EncodedMeasurement,
    JoinConfirmation,
    JoinRequest,
    MeasurementBlock,
    Reply,
    SessionInfo,
    SingleMeasurement,
    SlotOrder,
    StationEntry,
    StatusReport,
    decode_beacon,
    decode_reply,
    encode_beacon,
    encode_reply,
    reply_bytes,
)

MAX_PACKET_BYTES = 255


def _bits(width: int) -> st.SearchStrategy[int]:
    return st.integers(0, 2**width - 1)


entries = st.builds(StationEntry, _bits(4), _bits(4))
sessions = st.builds(
    SessionInfo,
    nonce=_bits(48),
    counter_high=_bits(16),
    sent_high=_bits(24),
    guard=_bits(8),
    turnaround=_bits(8),
)


@st.composite
def beacons(draw: st.DrawFn) -> Beacon:
    """Any beacon; it addresses existing stations only."""
    stations = draw(st.lists(entries, min_size=1, max_size=16).map(tuple))
    numbers = st.integers(1, len(stations))
    tracks = st.builds(EncodedCommand, numbers, _bits(4), st.just(0), _bits(4))
    others = st.builds(EncodedCommand, numbers, _bits(4), st.integers(1, 3))
    directions = st.builds(EncodedDirection, _bits(16), _bits(16))
    searches = st.builds(EncodedCommand, numbers, _bits(4), st.just(4), _bits(4), directions)
    return Beacon(
        frame=draw(_bits(8)),
        sent=draw(st.integers(1, 2**16 - 1)),
        cumulative=draw(_bits(8)),
        slot_order=SlotOrder(draw(_bits(4)), draw(st.booleans())),
        stations=stations,
        session=draw(st.none() | sessions),
        confirmations=draw(st.lists(st.builds(JoinConfirmation, numbers, _bits(32)), max_size=3).map(tuple)),
        commands=draw(st.lists(tracks | others | searches, max_size=3).map(tuple)),
    )


angles = _bits(24)
distances = st.none() | st.integers(1, 2**24 - 1)
statuses = st.sampled_from(Status)
# Mostly the small steps of a robot, and sometimes any step.
number_steps = st.just(1) | st.integers(1, 300) | st.integers(1, 2**32 - 1)
time_steps = st.integers(24_000, 26_000) | st.integers(-(2**18), 2**18) | st.integers(1 - 2**35, 2**35)
angle_steps = st.integers(-100, 100) | st.integers(-(2**17), 2**17) | angles
distance_steps = st.integers(-100, 100) | st.integers(-(2**15), 2**15)


@st.composite
def blocks(draw: st.DrawFn, *, plain: bool = False) -> MeasurementBlock:
    """Any block, of close or distant measurements; or a plain one."""
    flags = st.just(False) if plain else st.booleans()
    wide = draw(flags)
    newer = EncodedMeasurement(
        draw(_bits(32 if wide else 8)),
        draw(_bits(36 if wide else 17)),
        draw(statuses),
        draw(angles),
        draw(angles),
        draw(distances),
    )
    measurements = [newer]
    for _ in range(draw(st.integers(0, 15))):
        distance = draw(distances) if newer.distance is None else newer.distance + draw(distance_steps)
        newer = EncodedMeasurement(
            newer.sequence - draw(number_steps),
            newer.time - draw(time_steps),
            draw(st.just(newer.status) | statuses),
            (newer.horizontal + draw(angle_steps)) % 2**24,
            (newer.zenith + draw(angle_steps)) % 2**24,
            distance if distance is not None and 0 < distance < 2**24 else None,
        )
        measurements.append(newer)
    return MeasurementBlock(
        measurements=tuple(measurements),
        beacon_relative=draw(flags),
        quality=draw(_bits(4)),
        wide=wide,
        prism=None if plain else draw(st.none() | st.integers(1, 16)),
        far=draw(flags),
    )


replies = st.builds(
    Reply,
    blocks=st.lists(blocks(), max_size=3).map(tuple),
    join_request=st.none()
    | st.builds(
        JoinRequest, nonce=_bits(32), stream_id=_bits(16), first_sequence=_bits(32), oldest=_bits(32)
    ),
    status_report=st.none()
    | st.builds(
        StatusReport,
        prism=st.integers(1, 16),
        direct=st.booleans(),
        connected=st.booleans(),
        missed_slots=_bits(8),
        rejected_beacons=_bits(4),
        rssi_dbm=st.integers(-127, 0),
        condition=st.builds(ConditionItem, _bits(2), _bits(9)),
    ),
    turnaround_us=st.none() | _bits(22),
    response=st.none() | st.builds(CommandResponse, _bits(4), st.booleans()),
    single_measurement=st.none()
    | st.builds(SingleMeasurement, _bits(4), statuses, angles, angles, distances),
)
plain_replies = blocks(plain=True).map(lambda run: Reply(blocks=(run,)))


def _as_decoded(reply: Reply) -> Reply:
    """Return what a reply comes back as: a single plain measurement claims no better quality than any other one."""
    if (
        reply == Reply(blocks=reply.blocks)
        and len(reply.blocks) == 1
        and len(reply.blocks[0].measurements) == 1
    ):
        run = reply.blocks[0]
        if (
            run == MeasurementBlock(measurements=run.measurements, quality=run.quality)
            and run.quality < SINGLE_QUALITY
        ):
            return Reply(blocks=(replace(run, quality=SINGLE_QUALITY),))
    return reply


def _check_reply(content: bytes) -> None:
    try:
        reply = decode_reply(content)
    except MessageError:
        return
    assert encode_reply(reply) == content


def _check_beacon(content: bytes) -> None:
    try:
        beacon = decode_beacon(content)
    except MessageError:
        return
    assert encode_beacon(beacon) == content


@given(beacons())
@pytest.mark.slow
def test_beacons_come_back(beacon: Beacon) -> None:
    """What is sent is what is understood."""
    assert decode_beacon(encode_beacon(beacon)) == beacon


@examples(200)
@given(replies | plain_replies)
def test_replies_come_back(reply: Reply) -> None:
    """What is sent is what is understood, to the last bit of every measurement."""
    content = encode_reply(reply)
    assert decode_reply(content) == _as_decoded(reply)
    assert reply_bytes(reply) == len(content) + 4


@given(beacons(), st.data())
@pytest.mark.slow
def test_every_damaged_beacon_is_refused_or_means_what_it_says(beacon: Beacon, data: st.DataObject) -> None:
    """Cut off anywhere, lengthened, or with a bit flipped: there is one form in bytes for each beacon."""
    content = encode_beacon(beacon)
    for length in range(len(content)):
        _check_beacon(content[:length])
    _check_beacon(content + data.draw(st.binary(min_size=1, max_size=2)))
    for bit in range(8 * len(content)):
        _check_beacon((int.from_bytes(content, "big") ^ 1 << bit).to_bytes(len(content), "big"))


@examples(50)
@given(replies | plain_replies, st.data())
@pytest.mark.slow
def test_every_damaged_reply_is_refused_or_means_what_it_says(reply: Reply, data: st.DataObject) -> None:
    """Cut off anywhere, lengthened, or with a bit flipped: there is one form in bytes for each reply."""
    content = encode_reply(reply)
    for length in range(len(content)):
        _check_reply(content[:length])
    _check_reply(content + data.draw(st.binary(min_size=1, max_size=2)))
    bits = data.draw(st.lists(st.integers(0, 8 * len(content) - 1), max_size=40))
    for bit in bits:
        _check_reply((int.from_bytes(content, "big") ^ 1 << bit).to_bytes(len(content), "big"))


@examples(500)
@given(st.binary(max_size=MAX_PACKET_BYTES), st.integers(0, 15))
def test_foreign_packets_break_nothing(content: bytes, start: int) -> None:
    """Whatever comes over the air, also with a beginning like ours, is refused or has one meaning."""
    for packet in (content, bytes([0x40 | start << 2]) + content):
        _check_beacon(packet)
        _check_reply(packet)


@given(st.integers(0, MAX_PACKET_BYTES))
def test_zeros_and_ones_break_nothing(length: int) -> None:
    """A run of equal bits is the likeliest packet of a chip gone wrong."""
    for byte in (b"\x00", b"\xff"):
        for start in (b"", b"\x50", b"\x60"):
            _check_beacon(start + byte * length)
            _check_reply(start + byte * length)
