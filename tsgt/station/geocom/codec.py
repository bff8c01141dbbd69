"""Encodes requests and decodes replies of GeoCOM's ASCII protocol, for Leica instruments on a serial line. Sans-I/O.

``%R1Q,<rpc>,<transaction>:<parameters>`` is answered by ``%R1P,<com code>,<transaction>:<code>,<values>``; both end in
CR LF. The com code is the transport's result, the return code the procedure's. With checksums both headers have a third
number. Metres and radians. Source: Leica, TPS1200 GeoCOM Reference Manual 1.20; the checksum: GeoComPy 1.0.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from tsgt.errors import MessageError

if TYPE_CHECKING:
    from collections.abc import Sequence

MAX_TRANSACTION: Final = 32_767  # largest transaction number: instruments store it in a signed 16-bit integer

_HEADER: Final = re.compile(
    r"%R1P,(?P<com_code>\d{1,5})(?:,(?P<transaction>-?\d{1,5}))?(?:,(?P<checksum>\d{1,5}))?:"
)
_STRING: Final = re.compile(r'"((?:[^"\\]|\\.)*)"')
_ESCAPE: Final = re.compile(r"\\(x[0-9a-fA-F]{2}|.)")
_BYTE: Final = re.compile(r"'([0-9a-fA-F]{1,2})'")
_INTEGER: Final = re.compile(r"[+-]?\d{1,20}")
_HEX: Final = re.compile(r"0[xX][0-9a-fA-F]{1,16}")
_REAL: Final = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_PLAIN_NUMBERS: Final = re.compile(r"[+-]?\d{1,15}(?:\.\d{1,15})?(?:,[+-]?\d{1,15}(?:\.\d{1,15})?)*")
_UNSAFE: Final = re.compile(r'[^ -~]|[\\"%~]')


class Rpc(IntEnum):
    """Numbers of the remote procedure calls, by the names of the manual."""

    COM_NULL_PROC = 0
    COM_SET_DOUBLE_PRECISION = 107
    COM_GET_DOUBLE_PRECISION = 108
    COM_GET_SW_VERSION = 110
    COM_SWITCH_ON_TPS = 111
    COM_SWITCH_OFF_TPS = 112
    EDM_LASERPOINTER = 1004
    EDM_GET_EGL_INTENSITY = 1058
    EDM_SET_EGL_INTENSITY = 1059
    EDM_IS_CONT_MEAS_ACTIVE = 1070
    TMC_GET_ANGLE1 = 2003
    TMC_SET_INCLINE_SWITCH = 2006
    TMC_GET_INCLINE_SWITCH = 2007
    TMC_DO_MEASURE = 2008
    TMC_GET_STATION = 2009
    TMC_SET_STATION = 2010
    TMC_GET_HEIGHT = 2011
    TMC_SET_HEIGHT = 2012
    TMC_GET_ANG_SWITCH = 2014
    TMC_SET_ANG_SWITCH = 2016
    TMC_SET_EDM_MODE = 2020
    TMC_GET_EDM_MODE = 2021
    TMC_GET_SIGNAL = 2022
    TMC_GET_PRISM_CORR = 2023
    TMC_SET_PRISM_CORR = 2024
    TMC_GET_FACE = 2026
    TMC_SET_ATM_CORR = 2028
    TMC_GET_ATM_CORR = 2029
    TMC_SET_REFRACTIVE_CORR = 2030
    TMC_GET_REFRACTIVE_CORR = 2031
    TMC_GET_COORDINATE = 2082
    TMC_SET_REFRACTIVE_METHOD = 2090
    TMC_GET_REFRACTIVE_METHOD = 2091
    TMC_GET_ANGLE5 = 2107
    TMC_GET_SIMPLE_MEA = 2108
    TMC_SET_ORIENTATION = 2113
    TMC_IF_DATA_AZE_CORR_ERROR = 2114
    TMC_IF_DATA_INC_CORR_ERROR = 2115
    TMC_GET_SIMPLE_COORD = 2116
    TMC_QUICK_DIST = 2117
    TMC_GET_SLOPE_DIST_CORR = 2126
    TMC_SET_ATM_PPM = 2148
    TMC_GET_ATM_PPM = 2151
    TMC_SET_GEO_PPM = 2153
    TMC_GET_GEO_PPM = 2154
    TMC_GET_FULL_MEAS = 2167
    CSV_GET_INSTRUMENT_NO = 5003
    CSV_GET_INSTRUMENT_NAME = 5004
    CSV_GET_DATE_TIME = 5008
    CSV_GET_INT_TEMP = 5011
    CSV_GET_SW_VERSION = 5034
    CSV_GET_DEVICE_CONFIG = 5035
    CSV_CHECK_POWER = 5039
    CSV_GET_REFLECTORLESS_CLASS = 5100
    CSV_GET_DATE_TIME_CENTI_SEC = 5117
    MOT_START_CONTROLLER = 6001
    MOT_STOP_CONTROLLER = 6002
    MOT_SET_VELOCITY = 6004
    MOT_READ_LOCK_STATUS = 6021
    AUT_SET_TOL = 9007
    AUT_READ_TOL = 9008
    AUT_SET_TIMEOUT = 9011
    AUT_READ_TIMEOUT = 9012
    AUT_LOCK_IN = 9013
    AUT_SET_ATR_STATUS = 9018
    AUT_GET_ATR_STATUS = 9019
    AUT_SET_LOCK_STATUS = 9020
    AUT_GET_LOCK_STATUS = 9021
    AUT_MAKE_POSITIONING = 9027
    AUT_CHANGE_FACE = 9028
    AUT_SEARCH = 9029
    AUT_GET_FINE_ADJUST_MODE = 9030
    AUT_SET_FINE_ADJUST_MODE = 9031
    AUT_FINE_ADJUST = 9037
    AUT_GET_USER_SPIRAL = 9040
    AUT_SET_USER_SPIRAL = 9041
    AUT_GET_SEARCH_AREA = 9042
    AUT_SET_SEARCH_AREA = 9043
    AUT_PS_SET_RANGE = 9047
    AUT_PS_ENABLE_RANGE = 9048
    AUT_PS_SEARCH_NEXT = 9051
    AUT_PS_SEARCH_WINDOW = 9052
    BMM_BEEP_NORMAL = 11_003
    BMM_BEEP_ALARM = 11_004
    CTL_GET_UP_COUNTER = 12_003
    SUP_GET_CONFIG = 14_001
    SUP_SET_CONFIG = 14_002
    BAP_SET_PRISM_TYPE = 17_008
    BAP_GET_PRISM_TYPE = 17_009
    BAP_MEAS_DISTANCE_ANGLE = 17_017
    BAP_GET_MEAS_PRG = 17_018
    BAP_SET_MEAS_PRG = 17_019
    BAP_SEARCH_TARGET = 17_020
    BAP_SET_TARGET_TYPE = 17_021
    BAP_GET_TARGET_TYPE = 17_022
    BAP_GET_PRISM_DEF = 17_023
    BAP_SET_PRISM_TYPE2 = 17_030
    BAP_GET_PRISM_TYPE2 = 17_031
    BAP_SET_USER_PRISM_DEF = 17_032
    BAP_GET_USER_PRISM_DEF = 17_033
    BAP_GET_ATR_SETTING = 17_034
    BAP_SET_ATR_SETTING = 17_035
    BAP_GET_RED_ATR_FOV = 17_036
    BAP_SET_RED_ATR_FOV = 17_037
    AUS_SET_USER_ATR_STATE = 18_005
    AUS_GET_USER_ATR_STATE = 18_006
    AUS_SET_USER_LOCK_STATE = 18_007
    AUS_GET_USER_LOCK_STATE = 18_008
    IOS_BEEP_OFF = 20_000
    IOS_BEEP_ON = 20_001


class Byte(int):
    """0 to 255; in GeoCOM two hexadecimal digits in single quotes."""

    __slots__ = ()


Parameter = int | float | bool | str | Byte  # a value in a request or reply; a bool is sent as 0 or 1


@dataclass(frozen=True, slots=True)
class ReplyLine:
    """A decoded reply.

    Attributes
    ----------
    com_code
        Result of the transport; 0: the request was delivered and understood.
    transaction
        Number of the request; 0 where that had none.
    code
        Return code of the procedure.
    values
        Its results. A real number may be an int: instruments omit trailing zeros.
    """

    com_code: int
    transaction: int
    code: int
    values: tuple[int | float | str, ...] = ()


def crc16_arc(data: bytes) -> int:
    """Return the CRC-16/ARC: polynomial 0x8005, reflected, initial value 0; check value of ``b"123456789"``: 0xBB3D."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def encode_request(
    rpc: int,
    parameters: Sequence[Parameter] = (),
    *,
    transaction: int | None = None,
    checksum: bool = False,
    decimals: int = 10,
) -> bytes:
    """Return a request line, with CR LF.

    Raises MessageError if a number is not finite, a byte or the transaction is out of range, or a string is not
    Latin-1.

    Parameters
    ----------
    transaction
        1 to 32767, repeated by the reply; None for none.
    checksum
        Whether the header has a checksum, which requires a transaction.
    decimals
        Number of decimals, 0 to 15.
    """
    if transaction is not None and not 0 < transaction <= MAX_TRANSACTION:
        raise MessageError(f"transaction {transaction} is not between 1 and {MAX_TRANSACTION}")
    if checksum and transaction is None:
        raise MessageError("a request with a checksum needs a transaction")
    header = f"%R1Q,{int(rpc)}" if transaction is None else f"%R1Q,{int(rpc)},{transaction}"
    body = ",".join(_encode_value(value, decimals) for value in parameters)
    if checksum:
        header = f"{header},{crc16_arc(f'{header}:{body}'.encode('ascii'))}"
    return f"{header}:{body}\r\n".encode("ascii")


def decode_reply(line: bytes, *, checksum: bool = False) -> ReplyLine:
    """Decode a reply.

    ``line``: from ``%R1P``, with or without the line end. ``checksum``: whether a checksum is required, unless the com
    code reports that the request was not delivered. A checksum that is present is always verified. Raises MessageError
    if it is not a reply, or damaged.
    """
    stripped = line.rstrip(b"\r\n")
    text = stripped.decode("ascii", errors="replace")
    if not (text.isascii() and text.isprintable()):
        raise MessageError(f"reply with bytes that GeoCOM does not use: {line!r}")
    header = _HEADER.match(text)
    if header is None:
        raise MessageError(f"not a GeoCOM reply: {line!r}")
    com_code = int(header["com_code"])
    _verify_checksum(header, needed=checksum and com_code == 0)
    values = _decode_values(text[header.end() :])
    if not values and com_code == 0:
        raise MessageError(f"reply without a return code: {line!r}")
    code = values[0] if values else 0
    if type(code) is not int:
        raise MessageError(f"reply with the return code {code!r}: {line!r}")
    return ReplyLine(com_code, int(header["transaction"] or 0), code, values[1:])


def _encode_value(value: Parameter, decimals: int) -> str:
    match value:
        case Byte():
            if not 0 <= value <= 0xFF:
                raise MessageError(f"{int(value)} is not a byte")
            return f"'{value:02X}'"
        case int():  # also bool and IntEnum
            return f"{int(value):d}"
        case float():
            if not math.isfinite(value):
                raise MessageError(f"{value} is not a finite number")
            digits = f"{value:.{decimals}f}"
            whole, _, fraction = digits.partition(".")
            return f"{whole}.{fraction.rstrip('0') or '0'}"
        case str():
            return f'"{_UNSAFE.sub(_escape, value)}"'


def _escape(found: re.Match[str]) -> str:
    code = ord(found.group())
    if code > 0xFF:
        raise MessageError(f"{found.group()!r} cannot be sent: GeoCOM strings are Latin-1")
    # The only form that no firmware mistakes for the end of the string or the start of a line.
    return f"\\x{code:02x}"


def _unescape(found: re.Match[str]) -> str:
    escape = found.group(1)
    return chr(int(escape[1:], 16)) if len(escape) > 1 else escape


def _verify_checksum(header: re.Match[str], *, needed: bool) -> None:
    line, checksum = header.string, header["checksum"]
    if checksum is None:
        if needed:
            raise MessageError(f"reply without its checksum: {line!r}")
        return
    start, end = header.span("checksum")
    expected = crc16_arc(f"{line[: start - 1]}{line[end:]}".encode("ascii"))
    if int(checksum) != expected:
        raise MessageError(f"the checksum is {checksum}, not {expected}: {line!r}")


def _decode_values(text: str) -> tuple[int | float | str, ...]:
    if not text:
        return ()
    if _PLAIN_NUMBERS.fullmatch(text):  # nearly all replies
        return tuple([float(value) if "." in value else int(value) for value in text.split(",")])
    if '"' not in text:
        return tuple(map(_decode_value, text.split(",")))
    values: list[int | float | str] = []
    position = 0
    while True:
        found = _STRING.match(text, position)
        if found is None:
            end = text.find(",", position)
            end = len(text) if end < 0 else end
            values.append(_decode_value(text[position:end]))
        else:
            values.append(_ESCAPE.sub(_unescape, found.group(1)))
            end = found.end()
        if end == len(text):
            return tuple(values)
        if text[end] != ",":
            raise MessageError(f"no comma after a string: {text!r}")
        position = end + 1


def _decode_value(text: str) -> int | float:
    text = text.strip()
    if _INTEGER.fullmatch(text):
        return int(text)
    if _REAL.fullmatch(text):
        number = float(text)
        if math.isfinite(number):
            return number
    if byte := _BYTE.fullmatch(text):
        return Byte(byte.group(1), 16)
    if _HEX.fullmatch(text):
        return int(text, 16)
    raise MessageError(f"not a GeoCOM value: {text!r}")
