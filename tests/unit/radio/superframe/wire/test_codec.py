from __future__ import annotations

import math
from dataclasses import replace

import pytest

from tsgt.errors import MessageError
from tsgt.model import Status
from tsgt.radio import LoRaSettings
from tsgt.radio.superframe.wire import (
    GRANT_BYTES,
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
    angle_code,
    angle_rad,
    decode_beacon,
    decode_reply,
    distance_code,
    distance_m,
    encode_beacon,
    encode_reply,
    is_far,
    reply_bytes,
)
from tsgt.radio.superframe.wire.bits import BitReader, BitWriter
from tsgt.radio.superframe.wire.messages import VERSION

SIGHTING = EncodedMeasurement(200, 100_000, Status.OK, 5_000_000, 4_194_304, 750_000)
SINGLE = Reply(blocks=(MeasurementBlock(measurements=(SIGHTING,)),))
INTRODUCTION = JoinRequest(nonce=0x89ABCDEF, stream_id=0x1234, first_sequence=2**32 - 1, oldest=2**32 - 1)
STATE = StatusReport(
    prism=16,
    direct=True,
    connected=True,
    missed_slots=255,
    rejected_beacons=15,
    rssi_dbm=-127,
    condition=ConditionItem(3, 511),
)
SESSION = SessionInfo(nonce=2**48 - 1, counter_high=1, sent_high=2, guard=3, turnaround=4)

BEACON = Beacon(
    frame=0xA5,
    sent=0x1234,
    cumulative=0x56,
    slot_order=SlotOrder(first=2, reverse=True),
    stations=(StationEntry(0xF, 2), StationEntry(0, 15), StationEntry(5, 0)),
)


def robot(count: int) -> MeasurementBlock:
    """Return measurements of a robot at 75 m and 1.5 m/s, at 45 degrees to the line of sight."""
    measurements = []
    for k in range(count):
        ahead_m, aside_m = 75.0 - 0.424 * k, 0.424 * k
        direction = (angle_code(1.0 + math.atan2(aside_m, ahead_m)), angle_code(1.55 + 2e-4 * k))
        distance = distance_code(math.hypot(ahead_m, aside_m), far=False)
        measurements.append(
            EncodedMeasurement(200 - k, 100_000 - 25_000 * k - k % 3 * 30, Status.OK, *direction, distance)
        )
    return MeasurementBlock(measurements=tuple(measurements))


# --- Sizes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stations", "length"), [(1, 6), (3, 8), (16, 21)])
def test_plain_beacon_length(stations: int, length: int) -> None:
    """Five bytes and one per station."""
    beacon = replace(BEACON, stations=(StationEntry(1, 2),) * stations)
    assert len(encode_beacon(beacon)) == length


def test_empty_reply_length() -> None:
    """Five bytes: the smallest grant."""
    assert reply_bytes(Reply()) == GRANT_BYTES[1] == 5


def test_single_measurement_length() -> None:
    """Thirteen bytes, seventeen with the code: the second grant."""
    assert len(encode_reply(SINGLE)) == 13
    assert reply_bytes(SINGLE) == GRANT_BYTES[2]


@pytest.mark.parametrize(("count", "length"), [(2, 26), (3, 33), (4, 39), (8, 62)])
def test_block_length_of_moving_robot(count: int, length: int) -> None:
    """About eight bytes per further measurement."""
    assert reply_bytes(Reply(blocks=(robot(count),))) <= length


def test_join_request_with_measurement_fits_default_grant() -> None:
    """With a status report and every option of a block."""
    block = MeasurementBlock(
        measurements=(SIGHTING,), beacon_relative=True, quality=15, wide=True, prism=16, far=True
    )
    assert reply_bytes(Reply(join_request=INTRODUCTION, status_report=STATE, blocks=(block,))) <= 44


def test_condition_costs_no_airtime() -> None:
    """It fills the code block of a reply with turnaround, status report and one measurement."""
    reply = Reply(status_report=STATE, turnaround_us=0, blocks=SINGLE.blocks)
    settings = LoRaSettings(frequency_hz=905_000_000, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6)
    length = reply_bytes(reply)
    assert length == GRANT_BYTES[4] == 26
    assert settings.airtime_ns(length) == settings.airtime_ns(length - 1)  # 11 bits, and 6 were padding


# --- What comes back ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "beacon",
    [
        BEACON,
        replace(BEACON, stations=(StationEntry(0, 1),) * 16),
        replace(BEACON, session=SESSION),
        replace(BEACON, confirmations=(JoinConfirmation(3, 2**32 - 1), JoinConfirmation(1, 0))),
        replace(BEACON, commands=(EncodedCommand(1, 15, 0, 15), EncodedCommand(2, 0, 3))),
        replace(
            BEACON,
            session=SESSION,
            confirmations=(JoinConfirmation(2, 7),),
            commands=(EncodedCommand(3, 1, 1),),
        ),
    ],
)
def test_beacons_round_trip(beacon: Beacon) -> None:
    """With no part, each part, all parts."""
    assert decode_beacon(encode_beacon(beacon)) == beacon


@pytest.mark.parametrize(
    "reply",
    [
        Reply(),
        SINGLE,
        Reply(
            blocks=(
                robot(16),
                replace(robot(2), beacon_relative=True, quality=0),
                MeasurementBlock(measurements=(SIGHTING,), far=True),
            )
        ),
        Reply(
            join_request=INTRODUCTION,
            status_report=STATE,
            turnaround_us=2**22 - 1,
            response=CommandResponse(15, ok=True),
        ),
        Reply(
            status_report=STATE,
            single_measurement=SingleMeasurement(9, Status.ERROR, 1, 2**24 - 1, None),
            blocks=SINGLE.blocks,
        ),
        Reply(turnaround_us=0),
        Reply(response=CommandResponse(0, ok=False)),
    ],
)
def test_replies_round_trip(reply: Reply) -> None:
    """Empty, of each form, with each part."""
    assert decode_reply(encode_reply(reply)) == reply


def test_unknown_session_time_has_no_high_bits() -> None:
    """Both halves are 0."""
    beacon = decode_beacon(encode_beacon(replace(BEACON, sent=0, session=SESSION)))
    assert beacon.session == replace(SESSION, sent_high=0)


@pytest.mark.parametrize(("quality", "back"), [(0, 3), (3, 3), (4, 4)])
def test_single_form_has_fixed_quality(quality: int, back: int) -> None:
    """Only a worse quality needs another form."""
    reply = decode_reply(
        encode_reply(Reply(blocks=(MeasurementBlock(measurements=(SIGHTING,), quality=quality),)))
    )
    assert reply.blocks[0].quality == back


def test_newest_measurement_wraps() -> None:
    """To 8 and 17 bits, or 32 and 36 in a wide block."""
    measurement = replace(SIGHTING, sequence=2**40 + 300, time=2**40 + 2**20 + 5)
    narrow, wide = (
        decode_reply(encode_reply(Reply(blocks=(MeasurementBlock(measurements=(measurement,), wide=wide),))))
        .blocks[0]
        .measurements[0]
        for wide in (False, True)
    )
    assert (narrow.sequence, narrow.time) == (300 - 256, 5)
    assert (wide.sequence, wide.time) == (300, 2**20 + 5)


def test_older_measurements_are_relative_to_newest() -> None:
    """Across any gap, also below zero."""
    block = MeasurementBlock(
        measurements=(
            SIGHTING,
            replace(SIGHTING, sequence=SIGHTING.sequence - 9_000, time=SIGHTING.time - 225_000_000),
            replace(SIGHTING, sequence=SIGHTING.sequence - 9_001, time=SIGHTING.time - 225_025_000),
        )
    )
    back = decode_reply(encode_reply(Reply(blocks=(block,)))).blocks[0]
    assert back.measurements == block.measurements
    assert reply_bytes(Reply(blocks=(block,))) < 35


def test_angle_differences_wrap() -> None:
    """From just above 0 to just below a full turn is a small step."""
    across = MeasurementBlock(
        measurements=(replace(SIGHTING, horizontal=3), replace(SIGHTING, sequence=199, horizontal=2**24 - 3))
    )
    nearby = MeasurementBlock(
        measurements=(replace(SIGHTING, horizontal=9), replace(SIGHTING, sequence=199, horizontal=3))
    )
    assert decode_reply(encode_reply(Reply(blocks=(across,)))).blocks == (across,)
    assert reply_bytes(Reply(blocks=(across,))) == reply_bytes(Reply(blocks=(nearby,)))


def test_missing_distances_round_trip() -> None:
    """Between measurements with a distance, and before them."""
    bare = replace(SIGHTING, status=Status.ANGLE_ONLY, distance=None)
    block = MeasurementBlock(
        measurements=(
            SIGHTING,
            replace(bare, sequence=199, time=75_000),
            replace(bare, sequence=198, time=50_000),
            replace(SIGHTING, sequence=197, time=25_000),
        )
    )
    assert decode_reply(encode_reply(Reply(blocks=(block,)))).blocks == (block,)


# --- What is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "beacon",
    [
        replace(BEACON, frame=256),
        replace(BEACON, sent=-1),
        replace(BEACON, stations=()),
        replace(BEACON, stations=(StationEntry(0, 0),) * 17),
        replace(BEACON, confirmations=(JoinConfirmation(4, 0),)),
        replace(BEACON, commands=(EncodedCommand(0, 0, 0),)),
        replace(BEACON, commands=(EncodedCommand(1, 0, 4),)),
        replace(BEACON, commands=(EncodedCommand(1, 0, 5),)),
        replace(BEACON, commands=(EncodedCommand(1, 0, 1, 1),)),
        replace(BEACON, commands=(EncodedCommand(1, 0, 1, 0, EncodedDirection(1, 2)),)),
        replace(BEACON, commands=(EncodedCommand(1, 0, 4, 16, EncodedDirection(1, 2)),)),
        replace(BEACON, commands=(EncodedCommand(1, 0, 4, 0, EncodedDirection(2**16, 2)),)),
    ],
)
def test_invalid_beacons_are_rejected(beacon: Beacon) -> None:
    """Numbers beyond their fields, unknown stations, unknown commands."""
    with pytest.raises(MessageError):
        encode_beacon(beacon)


@pytest.mark.parametrize(
    "block",
    [
        MeasurementBlock(measurements=()),
        MeasurementBlock(measurements=tuple(replace(SIGHTING, sequence=k) for k in range(17, 0, -1))),
        MeasurementBlock(measurements=(SIGHTING, SIGHTING)),
        MeasurementBlock(measurements=(SIGHTING, replace(SIGHTING, sequence=201))),
        MeasurementBlock(measurements=(SIGHTING, replace(SIGHTING, sequence=200 - 2**32))),
        MeasurementBlock(measurements=(SIGHTING, replace(SIGHTING, sequence=199, time=-(2**36)))),
        MeasurementBlock(measurements=(SIGHTING,), quality=16),
        MeasurementBlock(measurements=(SIGHTING,), prism=17),
        MeasurementBlock(measurements=(replace(SIGHTING, distance=2**24),)),
        MeasurementBlock(measurements=(replace(SIGHTING, zenith=-1),)),
        MeasurementBlock(measurements=(SIGHTING, replace(SIGHTING, sequence=199, distance=2**24))),
        MeasurementBlock(measurements=(SIGHTING, replace(SIGHTING, sequence=199, horizontal=-1))),
    ],
)
def test_invalid_blocks_are_rejected(block: MeasurementBlock) -> None:
    """No or too many measurements, wrong order, weeks apart, numbers beyond their fields."""
    with pytest.raises(MessageError):
        encode_reply(Reply(blocks=(block,)))


def _bits(*fields: tuple[int, int]) -> bytes:
    writer = BitWriter()
    for value, width in fields:
        writer.put(value, width)
    return writer.to_bytes()


_PLAIN = ((VERSION, 2), (7, 8), (0, 1), (9, 16), (3, 8), (0, 5))
_EXTENDED = ((VERSION, 2), (7, 8), (1, 1), (9, 16), (3, 8), (0, 5), (0, 4), (0x12, 8))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cut off"),
        (_bits(*_PLAIN), "1 to 16 stations, got 0"),
        (_bits((1, 2), *_PLAIN[1:], (0x12, 8)), "version 1"),
        (_bits(*_EXTENDED, (0, 2)), "canonical form"),
        (_bits(*_EXTENDED, (3, 2), (0, 4), (0, 4), (0, 4), (0, 4), (0, 2), (1, 1)), "canonical form"),
        (_bits(*_EXTENDED, (3, 2), (1, 4), (0, 4), (0, 4), (0, 4), (0, 2)), "station 2"),
        (_bits(*_EXTENDED, (2, 2), (0, 4), (0, 16)), "cut off"),
        (_bits(*_EXTENDED, (3, 2), (0, 4), (0, 4), (4, 4), (0, 4), (0, 16)), "cut off"),
        (_bits(*_EXTENDED, (3, 2), (0, 4), (0, 4), (5, 4), (0, 4), (0, 2)), "no command 5"),
        (_bits(*_EXTENDED, (2, 2), (0, 4), (0, 32), (1, 2), *[(0, 8)] * 13, (0, 2)), "canonical form"),
    ],
)
def test_malformed_beacons_are_rejected(content: bytes, message: str) -> None:
    """Truncated, of another version, padded with ones, items unknown or out of order."""
    with pytest.raises(MessageError, match=message):
        decode_beacon(content)


_HEADER = ((VERSION, 2), (1, 2))
_RUN = ((3, 4), (0, 1), (1, 4), (200, 8), (100_000, 17), (0, 3), (5, 24), (6, 24), (7, 24))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cut off"),
        (_bits((0, 2), (1, 2)), "version 0"),
        (_bits((VERSION, 2), (3, 2)), "form 3"),
        (_bits(*_HEADER, (1, 4)), "canonical form"),
        (_bits((VERSION, 2), (2, 2), (0, 5)), "canonical form"),
        (_bits((VERSION, 2), (0, 2), (200, 8), (5, 17), (7, 3), (0, 72)), "status 7"),
        (_bits((VERSION, 2), (0, 2), (200, 8), (5, 17), (0, 3), (0, 72), (0, 8)), "canonical form"),
        (_bits(*_HEADER, (3, 4), (0, 1), (0, 4), (200, 8), (5, 17), (0, 3), (0, 72)), "canonical form"),
        (_bits(*_HEADER, *_RUN, (0, 1), (0, 10), (0, 9), (0, 9)), "cut off"),
        (_bits(*_HEADER, *_RUN, (0, 1), (1, 2), (0, 12), (0, 9), (0, 9), (0, 10)), "canonical form"),
        (_bits(*_HEADER, *_RUN, (1, 1), (0, 3), (1, 1), (0, 10), (0, 9), (0, 9), (0, 10)), "canonical form"),
    ],
)
def test_malformed_replies_are_rejected(content: bytes, message: str) -> None:
    """Truncated, of another version or form, padded, in a longer form or wider field than necessary."""
    with pytest.raises(MessageError, match=message):
        decode_reply(content)


def test_bit_fields_check_their_width() -> None:
    """Values above and below the range, and reading past the end."""
    writer = BitWriter()
    for value in (4, -1):
        with pytest.raises(MessageError):
            writer.put(value, 2)
    writer.put(3, 2)
    reader = BitReader(writer.to_bytes())
    assert (reader.take(0), reader.take(2), reader.remaining) == (0, 3, 6)
    with pytest.raises(MessageError):
        reader.take(7)


# --- Angles and distances ----------------------------------------------------------------------------------------


def test_angles_wrap() -> None:
    """A full turn is 2^24."""
    assert angle_code(math.pi) == 2**23
    assert angle_code(-math.pi / 2) == angle_code(1.5 * math.pi + 4 * math.pi) == 3 * 2**22
    assert angle_code(math.tau - 1e-9) == 0
    assert angle_rad(2**22) == pytest.approx(math.pi / 2, abs=1e-15)


@pytest.mark.parametrize(
    ("metres", "far", "code"),
    [
        (None, False, None),
        (0.0, False, None),
        (-1.0, True, None),
        (0.0001, False, 1),
        (123.45674, False, 1_234_567),
        (1677.7215, False, 2**24 - 1),
        (1677.7216, False, None),
        (1677.7216, True, 1_677_722),
        (20_000.0, True, None),
    ],
)
def test_distance_codes(metres: float | None, *, far: bool, code: int | None) -> None:
    """0.1 mm, or 1 mm in a far block; None outside the range."""
    assert distance_code(metres, far=far) == code
    if code is not None and metres is not None:
        assert distance_m(code, far=far) == pytest.approx(metres, abs=5.01e-4 if far else 5.01e-5)


def test_long_distances_need_a_far_block() -> None:
    """From the end of the 0.1 mm range."""
    assert [is_far(metres) for metres in (None, 1677.7215, 1677.7216, 5000.0)] == [False, False, True, True]
