"""Authentication codes of the superframe."""

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


def test_code_is_keyed_blake2s() -> None:
    """Over the header and content of the specification."""
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
def test_beacon_code_covers_all_fields(name: str, other: object) -> None:
    """Session, frame, and every bit and the length of the content."""
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
def test_reply_code_covers_all_fields(name: str, other: object) -> None:
    """Station, frame, beacon, full sequence number and content."""
    code = Authenticator(KEY).reply_code
    assert code(**REPLY) != code(**{**REPLY, name: other})


def test_beacon_and_reply_codes_differ() -> None:
    """For the same bytes."""
    authenticator = Authenticator(KEY)
    as_reply = authenticator.reply_code(
        **BEACON, station=0, station_nonce=0, beacon_code=bytes(CODE_BYTES), sequence=0
    )
    assert authenticator.beacon_code(**BEACON) != as_reply


def test_code_depends_on_key() -> None:
    """Another key and no key give other codes."""
    authenticators = [Authenticator(KEY), Authenticator(bytes(KEY_BYTES)), Authenticator(None)]
    assert len({authenticator.beacon_code(**BEACON) for authenticator in authenticators}) == 3
    assert [authenticator.authentic for authenticator in authenticators] == [True, True, False]


@pytest.mark.parametrize("length", [0, 16, KEY_BYTES + 1])
def test_key_of_wrong_length_is_rejected(length: int) -> None:
    """Including an empty key."""
    with pytest.raises(ValueError, match="32 bytes"):
        Authenticator(bytes(length))
