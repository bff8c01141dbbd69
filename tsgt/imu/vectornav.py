"""VectorNav VN-100: binary output of start-up time, delta angle and delta velocity. Sans-I/O.

Sources: VN-100 user manual (UM001), binary output messages, registers 1, 3, 4, 6, 75 and 82; the check is CRC-16-CCITT
with initial value 0, in binary messages over all bytes after the sync byte.
"""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx
from functools import partial
from typing import TYPE_CHECKING

from tsgt.imu.device import DeviceSample, Step
from tsgt.imu.lines import FORMAT_VERSION, HelloLine

if TYPE_CHECKING:
    from collections.abc import Sequence

IMU_RATE_HZ = 800  # of the VN-100's own samples; outputs are whole fractions of it

SYNC = 0xFA

# Group 1 (common) with TimeStartup and DeltaTheta; a header names its groups and, little-endian, the fields of each.
_HEADER = struct.Struct("<BBH")
_PAYLOAD = struct.Struct("<Qf3f3f")  # ns; s, deg, m/s
_GROUPS, _FIELDS = 0x01, 0x0801
_FRAME_BYTES = _HEADER.size + _PAYLOAD.size + 2

_MAX_TEXT_BYTES = 256

_BOTH_PORTS = 3

_ERRORS = {
    "01": "hard fault",
    "02": "serial buffer overflow",
    "03": "invalid checksum",
    "04": "invalid command",
    "05": "not enough parameters",
    "06": "too many parameters",
    "07": "invalid parameter",
    "08": "invalid register",
    "09": "unauthorized access",
    "0A": "watchdog reset",
    "0B": "output buffer overflow",
    "0C": "insufficient baud rate",
}

# Full scale of the VN-100: 2000 deg/s and 16 g.
_RATE_LIMIT_RADPS = math.radians(2000.0)
_FORCE_LIMIT_MPS2 = 16 * 9.80665


class VectorNav:
    """The codec of a VN-100; ``rate_hz`` divides 800. Raises ValueError for another rate."""

    def __init__(self, rate_hz: int) -> None:
        if not 1 <= rate_hz <= IMU_RATE_HZ or IMU_RATE_HZ % rate_hz:
            raise ValueError(f"{rate_hz} Hz is not a whole fraction of {IMU_RATE_HZ} Hz")
        self._rate_hz = rate_hz
        self._buffer = b""
        self._registers: dict[int, str] = {}

    @property
    def steps(self) -> Sequence[Step]:
        """Silence the device, ask who it is, and set up its output: in its own axes, without its own corrections."""
        divisor = IMU_RATE_HZ // self._rate_hz
        return [
            _step("VNWRG,75,0,1,00"),
            _step("VNWRG,06,0"),
            _step("VNRRG,01"),
            _step("VNRRG,03"),
            _step("VNRRG,04"),
            _step("VNWRG,82,0,0,0,0,0"),
            _step(f"VNWRG,75,{_BOTH_PORTS},{divisor},{_GROUPS:02X},{_FIELDS:04X}"),
        ]

    def push(self, data: bytes) -> tuple[list[DeviceSample], list[bytes]]:
        """Take bytes; return samples, and texts without ``$``, check and line end."""
        samples: list[DeviceSample] = []
        texts: list[bytes] = []
        self._buffer += data
        while self._buffer:
            used = self._take(self._buffer, samples, texts)
            if not used:
                break
            self._buffer = self._buffer[used:]
        return samples, texts

    def hello(self) -> HelloLine:
        """Return what registers 1, 3 and 4 have said."""
        return HelloLine(
            imu=FORMAT_VERSION,
            make="VectorNav",
            model=self._registers.get(1, ""),
            serial_number=self._registers.get(3, ""),
            firmware=self._registers.get(4, ""),
            rate_hz=float(self._rate_hz),
            clock="time since start-up",
            angular_rate_limit_radps=_RATE_LIMIT_RADPS,
            specific_force_limit_mps2=_FORCE_LIMIT_MPS2,
        )

    def _take(self, data: bytes, samples: list[DeviceSample], texts: list[bytes]) -> int:
        """Decode what the bytes begin with; return how many are done with, 0: more are needed."""
        if data[0] == SYNC:
            if data[: _HEADER.size] != _HEADER.pack(SYNC, _GROUPS, _FIELDS)[: len(data)]:
                return 1
            if len(data) < _FRAME_BYTES:
                return 0
            if crc_hqx(data[1:_FRAME_BYTES], 0) != 0:
                return 1
            sample = _sample(data[_HEADER.size :])
            # A line has several samples, and one that is no number would cost all of them.
            if all(map(math.isfinite, (*sample.delta_angle_rad, *sample.delta_velocity_mps))):
                samples.append(sample)
            return _FRAME_BYTES
        if data[:1] == b"$":
            end = data.find(b"\n", 0, _MAX_TEXT_BYTES)
            if end < 0:
                return 1 if len(data) >= _MAX_TEXT_BYTES else 0
            text = checked_text(data[: end + 1])
            if text is None:
                return 1
            texts.append(text)
            self._note(text)
            return end + 1
        starts = [at for at in (data.find(SYNC, 1), data.find(b"$", 1)) if at > 0]
        return min(starts, default=len(data))

    def _note(self, text: bytes) -> None:
        match text.decode("ascii", "replace").split(","):
            case ["VNRRG", number, *values] if number.isdecimal():
                self._registers[int(number)] = ",".join(values)


def command(text: str) -> bytes:
    """Return a command with its check."""
    return f"${text}*{crc_hqx(text.encode('ascii'), 0):04X}\r\n".encode("ascii")


def checked_text(line: bytes) -> bytes | None:
    """Return the text of a line whose check, of 8 or 16 bits, is right."""
    text, star, check = line.strip().removeprefix(b"$").rpartition(b"*")
    expected = {2: _xor(text), 4: crc_hqx(text, 0)}.get(len(check))
    try:
        return text if star and int(check, 16) == expected else None
    except ValueError:
        return None


def frame(
    time_ns: int, duration_s: float, angle_deg: Sequence[float], velocity_mps: Sequence[float]
) -> bytes:
    """Return the message of a sample, as the device sends it."""
    payload = _PAYLOAD.pack(time_ns, duration_s, *angle_deg, *velocity_mps)
    message = _HEADER.pack(SYNC, _GROUPS, _FIELDS) + payload
    return message + crc_hqx(message[1:], 0).to_bytes(2, "big")


def _sample(payload: bytes) -> DeviceSample:
    time_ns, _, *values = _PAYLOAD.unpack_from(payload)
    angle = [math.radians(value) for value in values[:3]]
    return DeviceSample(None, time_ns, (angle[0], angle[1], angle[2]), (values[3], values[4], values[5]))


def _step(text: str) -> Step:
    prefix = ",".join(text.split(",")[:2]).encode("ascii")
    return Step(command(text), partial(_matches, prefix), _refusal)


def _matches(prefix: bytes, text: bytes) -> bool:
    name, _, register = prefix.partition(b",")
    return text.startswith(name + b",") and text.split(b",")[1].lstrip(b"0") == register.lstrip(b"0")


def _refusal(text: bytes) -> str | None:
    if not text.startswith(b"VNERR"):
        return None
    code = text.partition(b",")[2].decode("ascii", "replace")
    return _ERRORS.get(code, f"error {code}")


def _xor(text: bytes) -> int:
    check = 0
    for byte in text:
        check ^= byte
    return check
