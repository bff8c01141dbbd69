"""The examples on the page of the radio protocol are what the code sends and understands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tsgt.model import Status
from tsgt.radio.base import LoRaSettings
from tsgt.radio.classic import Timing
from tsgt.radio.classic_messages import (
    Acknowledgement,
    MeasurementMessage,
    PingReply,
    TimeReply,
    decode_command,
    decode_reply,
    raw_status,
    status_of,
)

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
    timing = Timing.of(settings, 250_000_000)
    *packets, reported = _rows("packet | bytes")
    assert [row[column] for row in packets] == [
        f"{timing.airtime_ns(int(row[1])) / 1e6:.2f} ms" for row in packets
    ]
    assert reported[column] == f"{timing.rx_done_ns / 1e6:.2f} ms"
