"""The examples on the page of the radio protocol are what the code sends and understands."""

from __future__ import annotations

import hashlib
import math
import re
from pathlib import Path
from typing import NamedTuple

import pytest

from tsgt.model import Status
from tsgt.radio import DirectCommand, Direction, LoRaSettings, MeasureCommand, SearchCommand, TrackCommand
from tsgt.radio.classic import LinkTiming, MeasurementMessage, decode_command, raw_status, status_of
from tsgt.radio.classic.messages import Acknowledgement, PingReply, TimeReply, decode_reply
from tsgt.radio.superframe.wire import (
    GRANT_BYTES,
    Authenticator,
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
    encode_beacon,
    encode_command,
    encode_reply,
)
from tsgt.radio.superframe.wire import decode_reply as decode_superframe_reply
from tsgt.radio.superframe.wire.block_codec import (
    DISTANCE_WIDTHS,
    HORIZONTAL_WIDTHS,
    TIME_WIDTHS,
    ZENITH_WIDTHS,
)
from tsgt.radio.superframe.wire.codec import spread_rad

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "radio-protocol.md").read_text()


def _rows(first_heading: str) -> list[list[str]]:
    """Return the cells of the table whose heading begins so, without its heading."""
    table = PAGE[PAGE.index(f"| {first_heading}") :].split("\n\n")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def _bytes(cell: str) -> bytes:
    return bytes.fromhex(cell.strip("`"))


def test_every_command_stands_there() -> None:
    """Each letter once, with the bytes that are understood as that command."""
    rows = _rows("bytes (hex) | text")
    for cell, text, *_ in rows:
        command = decode_command(_bytes(cell))
        assert command is not None
        assert command.to_bytes() == _bytes(cell) == text.strip("`").encode()
    assert {row[1].strip("`")[0] for row in rows} == set("tpescdn")


def test_every_short_reply_stands_there() -> None:
    """Each reply is understood as what the page says, and sent as these bytes."""
    kinds = set()
    for cell, says in _rows("bytes (hex) | reply"):
        reply = decode_reply(_bytes(cell))
        assert reply is not None
        assert reply.to_bytes() == _bytes(cell)
        match reply:
            case PingReply(station):
                assert says == f"ping of station {station}"
            case TimeReply(time_ns):
                assert says == f"time {time_ns // 10**9}.{time_ns % 10**9:09}"
            case Acknowledgement(letter, ok):
                assert says == f"{'done' if ok else 'failed'}: {letter}"
        kinds.add(type(reply))
    assert kinds == {PingReply, TimeReply, Acknowledgement}


def test_the_measurement_stands_there() -> None:
    """Field by field, each at its offset, the example is the message."""
    rows = _rows("offset | type")
    packed = b""
    for offset, _, _, cell, _ in rows:
        assert int(offset) == len(packed)
        packed += _bytes(cell)
    station, status, zenith, horizontal, distance, seconds, nanoseconds = (row[4] for row in rows)
    message = MeasurementMessage(
        station=int(station),
        status=int(status),
        zenith_angle_rad=float(zenith),
        horizontal_angle_rad=float(horizontal),
        slope_distance_m=float(distance),
        time_ns=int(seconds) * 10**9 + int(nanoseconds),
    )
    assert message.to_bytes() == packed
    assert decode_reply(packed) == message


def test_every_status_stands_there() -> None:
    """The table of verdicts is that of the code, and its text names the two that are not in it."""
    for number, _, name in _rows("status | meaning"):
        status = Status(name.strip("`"))
        message = MeasurementMessage(
            station=1,
            status=int(number),
            zenith_angle_rad=1.0,
            horizontal_angle_rad=1.0,
            slope_distance_m=1.0,
            time_ns=1,
        )
        assert status_of(message) is status
        assert raw_status(status) == int(number)
    sentence = re.search(r"it sends `low_accuracy` as (\d) and `error` as (\d)", PAGE)
    assert sentence is not None
    assert [raw_status(s) for s in (Status.LOW_ACCURACY, Status.ERROR)] == [int(n) for n in sentence.groups()]


@pytest.mark.parametrize(("spreading_factor", "column"), [(9, 2), (8, 3)])
def test_airtimes_stand_there(spreading_factor: int, column: int) -> None:
    """Each packet's time on air at both spreading factors, rounded to 10 microseconds."""
    settings = LoRaSettings(
        frequency_hz=905_000_000, spreading_factor=spreading_factor, bandwidth_hz=250_000, coding_rate=6
    )
    timing = LinkTiming(settings, 250_000_000)
    *packets, reported = _rows("packet | bytes")
    assert [row[column] for row in packets] == [
        f"{timing.airtime_ns(int(row[1])) / 1e6:.2f} ms" for row in packets
    ]
    assert reported[column] == f"{timing.rx_done_ns / 1e6:.2f} ms"


# --- The superframe ------------------------------------------------------------------------------------------------


def test_every_grant_stands_there() -> None:
    """The table of grants is that of the code."""
    rows = _rows("grant | reply, at most")
    assert [int(grant) for grant, _ in rows] == list(range(16))
    assert rows[0][1] == "no slot"
    assert [longest for _, longest in rows[1:]] == [f"{length} bytes" for length in GRANT_BYTES[1:]]


def test_every_status_of_the_superframe_stands_there() -> None:
    """The table of verdicts is that of the code: a shot with each of them has its number in these bits."""
    rows = _rows("status | in tsgt")
    assert {Status(name.strip("`")) for _, name in rows} == set(Status)
    for number, name in rows:
        content = encode_reply(
            Reply(single_measurement=SingleMeasurement(0, Status(name.strip("`")), 0, 0, None))
        )
        assert int.from_bytes(content[:2], "big") & 0b111 == int(number)


def test_every_command_of_the_superframe_stands_there() -> None:
    """The table of commands is that of the code, and so is the half-width of a search window."""
    rows = _rows("command | the station")
    direction = Direction(1.0, 1.5, math.radians(1.9))
    orders = (TrackCommand(4), SearchCommand(), DirectCommand(), MeasureCommand(), SearchCommand(direction))
    parts = [encode_command(1, 0, order, tracked=1) for order in orders]
    assert [part.code for part in parts] == [int(order) for order, *_ in rows]
    arguments = [argument for *_, argument in rows]
    assert arguments[:4] == ["its number less 1", "0", "0", "0"]
    assert [part.argument for part in parts] == [3, 0, 0, 0, 6]
    times, divided = re.findall(r"([\d.]+)° times 2\^\(argument / (\d)\)", arguments[4])[0]
    for code in range(16):
        assert math.degrees(spread_rad(code)) == pytest.approx(float(times) * 2 ** (code / int(divided)))


def test_the_widths_of_residuals_stand_there() -> None:
    """Four for each kind of number."""
    widths = {kind: tuple(map(int, cells)) for kind, *cells in _rows("residual | 0")}
    assert widths == {
        "time": TIME_WIDTHS,
        "horizontal": HORIZONTAL_WIDTHS,
        "zenith": ZENITH_WIDTHS,
        "distance": DISTANCE_WIDTHS,
    }


class Example(NamedTuple):
    """What stands under one heading of an example."""

    field_bits: str
    content: bytes
    sender: str
    code: bytes


def _examples() -> dict[str, Example]:
    found = {}
    for section in re.split(r"^#### Example: ", PAGE, flags=re.MULTILINE)[1:]:
        title, _, body = section.partition("\n")
        rows = re.findall(r"^\| (\d+) \| (-?\d+) \| [^|]+ \|$", body, re.MULTILINE)
        field_bits = "".join(f"{int(value) % 2 ** int(bits):0{bits}b}" for bits, value in rows)
        content, sender, code = re.findall(r"Content `(.*?)`, (code .*?): `(.*?)`", body)[0]
        found[title] = Example(field_bits, bytes.fromhex(content), sender, bytes.fromhex(code))
    return found


EXAMPLES = _examples()
BEACON = Beacon(
    frame=421 % 256,
    sent=160_123_456 % 2**16,
    cumulative=1029 % 256,
    slot_order=SlotOrder(first=1),
    stations=(StationEntry(0b1111, 2), StationEntry(0b1110, 4), StationEntry(0b1111, 8)),
)
BEACON_WITH_ITEMS = Beacon(
    frame=424 % 256,
    sent=161_296_000 % 2**16,
    cumulative=1035 % 256,
    slot_order=SlotOrder(first=2, reverse=True),
    stations=(StationEntry(0b1111, 2), StationEntry(0b1111, 2), StationEntry(0b0100, 8)),
    session=SessionInfo(
        nonce=0x0123456789AB, counter_high=424 >> 8, sent_high=161_296_000 >> 16, guard=23, turnaround=32
    ),
    confirmations=(JoinConfirmation(3, 0x33333333),),
    commands=(EncodedCommand(2, 5, 0, 3),),
)
BEACON_WITH_DIRECTION = Beacon(
    frame=425 % 256,
    sent=161_700_000 % 2**16,
    cumulative=144,
    slot_order=SlotOrder(first=2, reverse=True),
    stations=(StationEntry(0b1111, 2), StationEntry(0b1111, 2), StationEntry(0b1111, 3)),
    commands=(EncodedCommand(3, 6, 4, 6, EncodedDirection(19_532, 16_537)),),
)
SINGLE = EncodedMeasurement(1041 % 256, 10_025_000 % 2**17, Status.OK, 5_000_000, 4_233_600, 756_032)
BLOCK = MeasurementBlock(
    measurements=(
        EncodedMeasurement(1032 % 256, 57_903, Status.OK, 3_010_000, 4_200_100, 612_300),
        EncodedMeasurement(1031 % 256, 57_903 - 25_003, Status.OK, 2_994_895, 4_200_280, 608_057),
        EncodedMeasurement(1030 % 256, 57_903 - 50_001, Status.LOW_ACCURACY, 2_979_988, 4_200_430, 603_756),
        EncodedMeasurement(1028 % 256, 57_903 - 100_011, Status.LOW_ACCURACY, 2_950_388, 4_200_760, 595_046),
    ),
    quality=2,
)
JOINING = Reply(
    join_request=JoinRequest(nonce=0x33333333, stream_id=0xBEEF, first_sequence=5417, oldest=5417),
    status_report=StatusReport(
        prism=3,
        direct=False,
        connected=True,
        missed_slots=1,
        rejected_beacons=0,
        rssi_dbm=-97,
        condition=ConditionItem(0, 86),
    ),
    blocks=(
        MeasurementBlock(
            measurements=(
                EncodedMeasurement(5418, 2**36 - 9_000, Status.OK, 9_000_000, 4_190_000, 1_843_212),
            ),
            beacon_relative=True,
            quality=5,
            wide=True,
            prism=3,
            far=True,
        ),
    ),
)
REPLIES = {
    "one measurement": Reply(blocks=(MeasurementBlock(measurements=(SINGLE,)),)),
    "a block": Reply(blocks=(BLOCK,)),
    "a station joins": JOINING,
    "a response": Reply(
        status_report=StatusReport(
            prism=4,
            direct=False,
            connected=True,
            missed_slots=0,
            rejected_beacons=0,
            rssi_dbm=-88,
            condition=ConditionItem(2, 133),
        ),
        turnaround_us=178_344,
        response=CommandResponse(5, ok=True),
    ),
    "a single measurement": Reply(
        single_measurement=SingleMeasurement(6, Status.OK, 12_345_678, 4_100_000, 423_456)
    ),
}
BEACONS = {
    "a beacon": BEACON,
    "a beacon with items": BEACON_WITH_ITEMS,
    "a beacon with a direction": BEACON_WITH_DIRECTION,
}
GIVEN = {name: _bytes(cell) for name, cell in _rows("given | value")}


def test_every_example_is_tested() -> None:
    """None more, none less."""
    assert EXAMPLES.keys() == BEACONS.keys() | REPLIES.keys()


@pytest.mark.parametrize("title", EXAMPLES)
def test_the_fields_of_an_example_are_its_content(title: str) -> None:
    """Number after number, with zeros at the end, they are the bytes."""
    example = EXAMPLES[title]
    bits = example.field_bits + "0" * (-len(example.field_bits) % 8)
    assert int(bits, 2).to_bytes(len(bits) // 8, "big") == example.content


@pytest.mark.parametrize("title", BEACONS)
def test_the_beacons_stand_there(title: str) -> None:
    """Each is sent in these bytes, and understood from them."""
    assert encode_beacon(BEACONS[title]) == EXAMPLES[title].content
    assert decode_beacon(EXAMPLES[title].content) == BEACONS[title]


@pytest.mark.parametrize("title", REPLIES)
def test_the_replies_stand_there(title: str) -> None:
    """Each is sent in these bytes, and understood from them."""
    assert encode_reply(REPLIES[title]) == EXAMPLES[title].content
    assert decode_superframe_reply(EXAMPLES[title].content) == REPLIES[title]


@pytest.mark.parametrize("title", EXAMPLES)
def test_the_codes_stand_there(title: str) -> None:
    """Each is what the code computes, and what the table of its input says, computed here."""
    example = EXAMPLES[title]
    session = int.from_bytes(GIVEN["session"], "big")
    numbers = [int(number) for number in re.findall(r"\d+", example.sender)]
    authenticator = Authenticator(GIVEN["key"])
    if title in BEACONS:
        (counter,) = numbers
        code = authenticator.beacon_code(session=session, counter=counter, content=example.content)
        values = [1, session, 0, 0, counter, 0, 0, len(example.content)]
    else:
        (station, sequence), counter = numbers, 421
        nonce = int.from_bytes(GIVEN[f"nonce of station {station}"], "big")
        answered = EXAMPLES["a beacon"].code
        code = authenticator.reply_code(
            session=session,
            station=station,
            station_nonce=nonce,
            counter=counter,
            beacon_code=answered,
            sequence=sequence,
            content=example.content,
        )
        answered_number = int.from_bytes(answered, "big")
        values = [2, session, station, nonce, counter, answered_number, sequence, len(example.content)]
    lengths = [int(row[0]) for row in _rows("bytes | input")[:-1]]
    hashed = b"".join(value.to_bytes(length, "big") for value, length in zip(values, lengths, strict=True))
    assert code == example.code
    person = re.findall(r"the person `(.*?)`", PAGE)[0].encode()
    digest = hashlib.blake2s(hashed + example.content, digest_size=4, key=GIVEN["key"], person=person)
    assert digest.digest() == example.code
