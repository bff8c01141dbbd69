from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from tsgt.model import Status
from tsgt.radio.classic import CommandMessage, MeasurementMessage, decode_command, raw_status, status_of
from tsgt.radio.classic.messages import (
    Acknowledgement,
    PingReply,
    TimeReply,
    decode_reply,
    no_measurement_yet,
)

MEASUREMENT = MeasurementMessage(
    station=3,
    status=0,
    zenith_angle_rad=1.5,
    horizontal_angle_rad=0.25,
    slope_distance_m=64.125,
    time_ns=1_700_000_000_999_999_999,
)
MEASUREMENT_HEX = "03 00 000000000000f83f 000000000000d03f 0000000000085040 00f15365 ffc99a3b"

COMMANDS = [
    (CommandMessage("t", 1), "7431"),
    (CommandMessage("p", 2), "7032"),
    (CommandMessage("e", 3), "6533"),
    (CommandMessage("s", 4), "7334"),
    (CommandMessage("c", 9), "6339"),
    (CommandMessage("d", 1), "6431"),
    (CommandMessage("n", 1), "6e31"),
    (CommandMessage("n", 1, 3), "6e3133"),
]
REPLIES = [
    (PingReply(1), "6531"),
    (TimeReply(1_700_000_000_000_000_001), "73 00f15365 01000000"),
    (TimeReply(0), "73 00000000 00000000"),
    (TimeReply(2**32 * 10**9 - 1), "73 ffffffff ffc99a3b"),
    (Acknowledgement("d", ok=True), "644f6b"),
    (Acknowledgement("d", ok=False), "644e6f"),
    (Acknowledgement("n", ok=True), "6e4f6b"),
    (Acknowledgement("n", ok=False), "6e4e6f"),
    (MEASUREMENT, MEASUREMENT_HEX),
]


@pytest.mark.parametrize(("command", "golden"), COMMANDS)
def test_commands_match_the_golden_bytes(command: CommandMessage, golden: str) -> None:
    """Commands encode to the bytes of the authors' nodes, and decode from them."""
    assert command.to_bytes() == bytes.fromhex(golden)
    assert decode_command(bytes.fromhex(golden)) == command


@pytest.mark.parametrize(("reply", "golden"), REPLIES)
def test_replies_match_the_golden_bytes(
    reply: PingReply | TimeReply | Acknowledgement | MeasurementMessage, golden: str
) -> None:
    """Replies encode to the bytes of the authors' nodes, and decode from them."""
    assert reply.to_bytes() == bytes.fromhex(golden)
    assert decode_reply(bytes.fromhex(golden)) == reply


@pytest.mark.parametrize(
    "payload",
    [b"", b"t", b"t0", b"ta", b"x1", b"T1", b"t1 ", b"t13", b"n10", b"n1a", b"n133", b"\xb2\xb9", b"t\xb2"],
)
def test_other_packets_are_no_commands(payload: bytes) -> None:
    """Station 0, unknown letters, misplaced prisms and bytes beyond ASCII are rejected."""
    assert decode_command(payload) is None


@pytest.mark.parametrize(
    "payload",
    [
        *(b"", b"e", b"e0", b"t1", b"dok", b"tOk", b"s", bytes(9), bytes(33), bytes(35)),
        b"s" + struct.pack("<II", 1, 1_000_000_000),
    ],
)
def test_other_packets_are_no_replies(payload: bytes) -> None:
    """Wrong letters and lengths, and nanoseconds beyond a second, are rejected."""
    assert decode_reply(payload) is None


def _packed(**changes: Any) -> bytes:
    fields = {"station": 1, "status": 0, "zenith": 1.5, "horizontal": 2.0, "distance": 50.0, "s": 7, "ns": 8}
    return struct.pack("<BBdddII", *(fields | changes).values())


@pytest.mark.parametrize(
    "changes",
    [
        *({"station": station} for station in (0, 10, 255)),
        *({"status": status} for status in (5, 255)),
        *({name: value} for name in ("zenith", "horizontal", "distance") for value in (math.nan, -math.inf)),
        *({"status": 3, name: math.nan} for name in ("zenith", "horizontal", "distance")),
        {"zenith": 13.0},
        {"horizontal": -13.0},
        {"distance": -1.0},
        {"distance": 20_001.0},
        {"status": 4, "distance": -1.0},
        {"ns": 1_000_000_000},
    ],
)
def test_impossible_values_are_no_measurement(changes: dict[str, float]) -> None:
    """A packet of 34 bytes with a value that no station sends is rejected."""
    assert isinstance(decode_reply(_packed()), MeasurementMessage)
    assert decode_reply(_packed(**changes)) is None


@pytest.mark.parametrize("status", [1, 2, 3])
@pytest.mark.parametrize(
    ("seconds", "nanoseconds"), [(0, 0), (2**32 - 1, 2**32 - 1), (0, 2**32 - 1), (7, 10**9)]
)
def test_invalid_times_of_errors_are_ignored(status: int, seconds: int, nanoseconds: int) -> None:
    """The authors' nodes have no time for an error; what they send is decoded as none."""
    reply = decode_reply(
        _packed(status=status, zenith=-1.0, horizontal=-1.0, distance=-1.0, s=seconds, ns=nanoseconds)
    )
    assert isinstance(reply, MeasurementMessage)
    assert (reply.status, reply.time_ns, reply.slope_distance_m) == (status, 0, -1.0)


def test_time_of_our_own_errors_is_decoded() -> None:
    """A tsgt client timestamps failed attempts too."""
    reply = decode_reply(_packed(status=3, zenith=0.0, horizontal=0.0, distance=0.0))
    assert isinstance(reply, MeasurementMessage)
    assert reply.time_ns == 7_000_000_008


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (0, Status.OK),
        (1, Status.TILT),
        (2, Status.WRONG_DISTANCE),
        (3, Status.NO_TARGET),
        (4, Status.ANGLE_ONLY),
    ],
)
def test_status_numbers_are_mapped(status: int, expected: Status) -> None:
    """Only 0 is usable for a pose."""
    reply = decode_reply(_packed(status=status))
    assert isinstance(reply, MeasurementMessage)
    assert status_of(reply) is expected
    assert expected.usable == (status == 0)


def test_every_status_has_a_number() -> None:
    """Exactly the usable statuses are sent as good."""
    assert {status for status in Status if raw_status(status) == 0} == {s for s in Status if s.usable}
    assert raw_status(Status.ERROR) == raw_status(Status.NO_TARGET) == 3


def test_zeros_are_no_good_measurement() -> None:
    """An authors' node sends zeros with a good status before its first measurement; they are rejected."""
    reply = decode_reply(b"\x02" + bytes(33))
    assert isinstance(reply, MeasurementMessage)
    assert status_of(reply) is Status.NO_TARGET
    assert status_of(no_measurement_yet(2)) is Status.NO_TARGET


def test_good_status_without_distance_is_angle_only() -> None:
    """A distance of 0 would put the prism into the station."""
    reply = decode_reply(_packed(distance=0.0))
    assert isinstance(reply, MeasurementMessage)
    assert status_of(reply) is Status.ANGLE_ONLY


@pytest.mark.parametrize(
    "arguments", [("x", 1), ("t", 0), ("t", 10), ("t", 1, 3), ("n", 1, 0), ("n", 1, 10), ("n", -1)]
)
def test_invalid_command_is_rejected(arguments: Any) -> None:
    """Values that do not fit into a command raise an error."""
    with pytest.raises(ValueError, match=r"expected 1 to 9|only 1 to 9|there is no command"):
        CommandMessage(*arguments)


@pytest.mark.parametrize(
    "changes",
    [
        {"station": 10},
        {"status": 5},
        {"zenith_angle_rad": math.nan},
        {"slope_distance_m": math.inf},
        {"time_ns": -1},
        {"time_ns": 2**32 * 10**9},
    ],
)
def test_invalid_measurement_is_rejected(changes: dict[str, Any]) -> None:
    """Values that do not fit into a measurement raise an error."""
    fields = {name: getattr(MEASUREMENT, name) for name in MeasurementMessage.__slots__}
    with pytest.raises(ValueError, match=r"expected|finite|does not fit"):
        MeasurementMessage(**(fields | changes))
