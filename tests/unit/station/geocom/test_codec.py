"""The GeoCOM codec and the table of return codes."""

from __future__ import annotations

import pytest

from tsgt.errors import MessageError
from tsgt.station.geocom import Outcome, ReturnCode, Rpc, name_of, outcome_of
from tsgt.station.geocom.codec import Byte, decode_reply, encode_request


def test_request_encoding() -> None:
    """Without and with a transaction, parameters and a checksum."""
    assert encode_request(Rpc.COM_NULL_PROC) == b"%R1Q,0:\r\n"
    assert encode_request(Rpc.TMC_GET_FULL_MEAS, (100, 1), transaction=7) == b"%R1Q,2167,7:100,1\r\n"
    assert (
        encode_request(Rpc.AUT_MAKE_POSITIONING, (1.5, -0.25, 0, False, True), transaction=32_767)
        == b"%R1Q,9027,32767:1.5,-0.25,0,0,1\r\n"
    )
    assert encode_request(Rpc.BAP_SET_PRISM_TYPE2, (9, "a,b")) == b'%R1Q,17030:9,"a,b"\r\n'
    assert encode_request(5007, (2026, Byte(0x0B))) == b"%R1Q,5007:2026,'0B'\r\n"
    with_checksum = encode_request(Rpc.COM_NULL_PROC, transaction=1, checksum=True)
    assert with_checksum.startswith(b"%R1Q,0,1,")


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (6.58e-7, 10, "0.000000658"),
        (1 / 3, 4, "0.3333"),
        (2.0, 10, "2.0"),
        (2.5, 0, "2.0"),
        (0.0, 10, "0.0"),
        (-1e-3, 10, "-0.001"),
        (400, 10, "400"),
        (True, 10, "1"),
        ("", 10, '""'),
        ('5" \\ %~\n', 10, r'"5\x22 \x5c \x25\x7e\x0a"'),
        ("Ä", 10, r'"\xc4"'),
    ],
)
def test_parameter_encoding(value: float | str, decimals: int, text: str) -> None:
    """No exponent, one trailing zero at most, no character that could end the string or the line."""
    assert encode_request(1, (value,), decimals=decimals) == f"%R1Q,1:{text}\r\n".encode()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), Byte(256), Byte(-1), "€"])
def test_invalid_parameter_is_rejected(value: float | str) -> None:
    """A number that is not finite, an invalid byte, a character that is not Latin-1."""
    with pytest.raises(MessageError):
        encode_request(1, (value,))


@pytest.mark.parametrize("transaction", [0, -1, 32_768])
def test_transaction_has_fifteen_bits(transaction: int) -> None:
    """A larger one would come back negative; 0 means none."""
    with pytest.raises(MessageError, match="between 1 and 32767"):
        encode_request(1, transaction=transaction)


def test_checksum_requires_transaction() -> None:
    """It is the third number of the header."""
    with pytest.raises(MessageError, match="needs a transaction"):
        encode_request(1, checksum=True)


def test_reply_decoding() -> None:
    """Numbers with and without exponent, strings with commas and escapes, bytes, and replies without values."""
    reply = decode_reply(b'%R1P,0,12:1284,1.5,-0.1e-07,3,"TS16, 1\\"",\'2f\',0x1F,""\r\n')
    assert (reply.com_code, reply.transaction, reply.code) == (0, 12, 1284)
    assert reply.values == (1.5, -0.1e-7, 3, 'TS16, 1"', 0x2F, 31, "")
    assert decode_reply(b"%R1P,0,0:0").values == ()
    assert decode_reply(b"%R1P,3081,4:0").com_code == 3081
    assert decode_reply(b"%R1P,3077:").com_code == 3077
    assert decode_reply(b"%R1P,0:27").transaction == 0
    assert decode_reply(b'%R1P,0,1:0,"a\\x0d\\\\\\%"').values == ("a\r\\%",)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"?",
        b"%R1Q,0,1:",
        b"%R1P,0,1",
        b"%R1P,0,1:",
        b"%R1P,x,1:0",
        b"%R1P,0,1:0,",
        b"%R1P,0,1:0,,1",
        b"%R1P,0,1:0,1.2.3",
        b"%R1P,0,1:0,nan",
        b"%R1P,0,1:0,inf",
        b"%R1P,0,1:0,1e999",
        b"%R1P,0,1:0,1_000",
        b'%R1P,0,1:0,"open',
        b'%R1P,0,1:0,"a"b',
        b"%R1P,0,1:0,'zz'",
        b'%R1P,0,1:"text"',
        b"%R1P,0,1:0.5",
        b"%R1P,0,1:'00'",
        b"%R1P,0,1:0,\xb2",
        b"%R1P,0,1:0,1\x00",
        b"%R1P,0,1234567:0",
    ],
)
def test_damaged_reply_is_rejected(line: bytes) -> None:
    """Truncated, mixed up, or with characters that no instrument sends."""
    with pytest.raises(MessageError):
        decode_reply(line)


def test_checksum_is_verified() -> None:
    """A wrong one is always rejected; a missing one only where it is required and the request was delivered."""
    line = encode_request(0, (0, 5), transaction=3, checksum=True).replace(b"%R1Q", b"%R1P")
    with pytest.raises(MessageError, match="checksum is"):
        decode_reply(line)
    with pytest.raises(MessageError, match="without its checksum"):
        decode_reply(b"%R1P,0,3:0", checksum=True)
    assert decode_reply(b"%R1P,3110,3:0", checksum=True).com_code == 3110


@pytest.mark.parametrize(
    ("code", "with_values", "without"),
    [
        (0, Outcome.USABLE, Outcome.USABLE),
        (16, Outcome.USABLE, Outcome.USABLE),
        (1283, Outcome.LOW_ACCURACY, Outcome.NO_VALUES),
        (1284, Outcome.LOW_ACCURACY, Outcome.NO_VALUES),
        (1285, Outcome.ANGLE_ONLY, Outcome.NO_VALUES),
        (1288, Outcome.ANGLE_ONLY, Outcome.NO_VALUES),
        (1289, Outcome.ANGLE_ONLY, Outcome.NO_VALUES),
        (1290, Outcome.TILT, Outcome.TILT),
        (1291, Outcome.WRONG_DISTANCE, Outcome.WRONG_DISTANCE),
        (1292, Outcome.NO_TARGET, Outcome.NO_TARGET),
        (1293, Outcome.BUSY, Outcome.BUSY),
        (1294, Outcome.ERROR, Outcome.ERROR),
        (1381, Outcome.LOW_ACCURACY, Outcome.ERROR),
        (1399, Outcome.LOW_ACCURACY, Outcome.ERROR),
        (517, Outcome.NO_TARGET, Outcome.NO_TARGET),
        (524, Outcome.NO_TARGET, Outcome.NO_TARGET),
        (8710, Outcome.NO_TARGET, Outcome.NO_TARGET),
        (27, Outcome.LICENCE, Outcome.LICENCE),
        (5, Outcome.UNAVAILABLE, Outcome.UNAVAILABLE),
        (3081, Outcome.UNAVAILABLE, Outcome.UNAVAILABLE),
        (12, Outcome.SHUT_DOWN, Outcome.SHUT_DOWN),
        (13, Outcome.BUSY, Outcome.BUSY),
        (3108, Outcome.ASLEEP, Outcome.ASLEEP),
        (22, Outcome.TILT, Outcome.TILT),
        (770, Outcome.ERROR, Outcome.ERROR),
        (8714, Outcome.ERROR, Outcome.ERROR),
        (4711, Outcome.ERROR, Outcome.ERROR),
    ],
)
def test_outcome_of_return_code(code: int, with_values: Outcome, without: Outcome) -> None:
    """With and without values."""
    assert outcome_of(code, has_values=True) is with_values
    assert outcome_of(code, has_values=False) is without


def test_name_of_return_code() -> None:
    """An unknown code has the name of its component."""
    assert name_of(ReturnCode.NA) == "27 NA"
    assert name_of(1284) == "1284 TMC_ACCURACY_GUARANTEE"
    assert name_of(8799) == "8799 (unknown, of AUT)"
    assert name_of(65_000) == "65000 (unknown)"
