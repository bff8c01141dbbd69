"""The codes of the superframe."""

from __future__ import annotations

import hashlib
from typing import Any

import pytest

from tsgt.radio.superframe.wire import CODE_BYTES, KEY_BYTES, Authenticator

KEY = bytes(range(KEY_BYTES))

BEACON: dict[str, Any] = {"session": 0xA1B2C3D4E5F6, "counter": 0x0102, "content": b"\x01\x02\x03"}
REPLY: dict[str, Any] = {
    "session": 0xA1B2C3D4E5F6,
    "station": 3,
    "station_nonce": 0xDEADBEEF,
    "counter": 0x0102,
    "beacon_code": b"\x11\x22\x33\x44",
    "sequence": 0x1_0000_0007,
    "content": b"\x01\x02\x03",
}


def test_a_code_is_keyed_blake2s_over_all_that_makes_a_packet_unique() -> None:
    """The specified bytes, put together by hand, give the code of a reply and that of a beacon."""
    head = bytes.fromhex("02 0000a1b2c3d4e5f6 03 deadbeef 0000000000000102 11223344 0000000100000007 0003")
    expected = hashlib.blake2s(head + b"\x01\x02\x03", digest_size=4, key=KEY, person=b"tsgt sf1").digest()
    assert Authenticator(KEY).reply_code(**REPLY) == expected
    head = bytes.fromhex("01 0000a1b2c3d4e5f6 00 00000000 0000000000000102 00000000 0000000000000000 0003")
    expected = hashlib.blake2s(head + b"\x01\x02\x03", digest_size=4, key=KEY, person=b"tsgt sf1").digest()
    assert Authenticator(KEY).beacon_code(**BEACON) == expected
    assert len(expected) == CODE_BYTES


@pytest.mark.parametrize(
    ("name", "other"),
    [("session", 1), ("counter", 0x0102 + (1 << 24)), ("content", b"\x01\x02"), ("content", b"\x01\x02\x83")],
)
def test_another_beacon_has_another_code(name: str, other: object) -> None:
    """A beacon fits in its own session and frame only, and no bit of it can be changed or cut off."""
    code = Authenticator(KEY).beacon_code
    assert code(**BEACON) != code(**{**BEACON, name: other})


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("session", 1),
        ("station", 4),
        ("station_nonce", 1),
        ("counter", 0x0102 + (1 << 24)),
        ("beacon_code", b"\x11\x22\x33\x45"),
        ("sequence", 7),
        ("content", b"\x01\x02\x03\x00"),
    ],
)
def test_another_reply_has_another_code(name: str, other: object) -> None:
    """A reply fits for its own station, frame, beacon and full sequence number only."""
    code = Authenticator(KEY).reply_code
    assert code(**REPLY) != code(**{**REPLY, name: other})


def test_a_beacon_is_no_reply() -> None:
    """The same bytes, sent in the other direction, do not fit."""
    authenticator = Authenticator(KEY)
    as_reply = authenticator.reply_code(
        **BEACON, station=0, station_nonce=0, beacon_code=bytes(CODE_BYTES), sequence=0
    )
    assert authenticator.beacon_code(**BEACON) != as_reply


def test_only_the_key_gives_the_code() -> None:
    """Another key, and none, give other codes; whether there is one can be asked."""
    authenticators = [Authenticator(KEY), Authenticator(bytes(KEY_BYTES)), Authenticator(None)]
    assert len({authenticator.beacon_code(**BEACON) for authenticator in authenticators}) == 3
    assert [authenticator.authentic for authenticator in authenticators] == [True, True, False]


@pytest.mark.parametrize("length", [0, 16, KEY_BYTES + 1])
def test_a_key_of_another_length_is_refused(length: int) -> None:
    """An empty key would be none at all."""
    with pytest.raises(ValueError, match="32 bytes"):
        Authenticator(bytes(length))
