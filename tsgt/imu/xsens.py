"""Xsens (Movella) MTi: MTData2 messages with packet counter, sample time, delta angle and delta velocity. Sans-I/O.

Source: MT low level communication protocol documentation (MT0101P), messages and data identifiers. A message is preamble,
bus id, message id, length, data, and a check with which all bytes after the preamble add up to 0 modulo 256.
"""

from __future__ import annotations

import math
import struct
from functools import partial
from typing import TYPE_CHECKING, Final

from tsgt.imu.device import DeviceSample, Step, Unwrapped
from tsgt.imu.lines import FORMAT_VERSION, HelloLine

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tsgt.model import Vector3

PREAMBLE, BUS = 0xFA, 0xFF
_EXTENDED = 0xFF  # length: two bytes with the length follow

REQ_DID, REQ_PRODUCT_CODE, REQ_FIRMWARE = 0x00, 0x1C, 0x12
GO_TO_CONFIG, GO_TO_MEASUREMENT, SET_OUTPUT = 0x30, 0x10, 0xC0
ERROR, MT_DATA2 = 0x42, 0x36

PACKET_COUNTER, SAMPLE_TIME_FINE, DELTA_V, DELTA_Q = 0x1020, 0x1060, 0x4010, 0x8030
_KIND = 0xFFF0  # of an identifier; its last digit is the precision and the frame of reference
_FLOATS: Final = {0: "f", 3: "d"}  # precision; the fixed-point formats are not used here

_TICK_NS = 100_000  # of the sample time

_MAX_DATA_BYTES = 2048

_FULL_SCALES = (("A5G4", 450.0, 5.0), ("MTi-6", 2000.0, 10.0))
"""Of what is in a product code: angular rate in deg/s and specific force in g (MTi User Manual MT0605P, MTi 600-series data sheet
MT1603P). Those of other devices are not known here; the estimators notice saturation by repeated values.
"""

_STANDARD_GRAVITY_MPS2 = 9.80665

_EVERY = 0xFFFF  # with every other output

_ERRORS = {
    0x03: "period out of range",
    0x04: "message not valid",
    0x1E: "timer overflow: baud rate too low for this output",
    0x20: "baud rate not valid",
    0x21: "parameter not valid",
    0x28: "device error",
}


class Xsens:
    """The codec of an MTi; ``rate_hz`` is one that the device offers, such as 100, 200 or 400."""

    def __init__(self, rate_hz: int) -> None:
        if not 1 <= rate_hz <= 2000:
            raise ValueError(f"{rate_hz} Hz is not a rate of an MTi")
        self._rate_hz = rate_hz
        self._buffer = b""
        self._count = Unwrapped(1 << 16)
        self._time = Unwrapped(1 << 32)
        self._identity: dict[int, bytes] = {}

    @property
    def steps(self) -> Sequence[Step]:
        """Stop the device, ask who it is, set up its output, and start it."""
        outputs = (
            (PACKET_COUNTER, _EVERY),
            (SAMPLE_TIME_FINE, _EVERY),
            (DELTA_Q, self._rate_hz),
            (DELTA_V, self._rate_hz),
        )
        configuration = b"".join(struct.pack(">HH", *output) for output in outputs)
        return [
            _step(GO_TO_CONFIG),
            _step(REQ_DID),
            _step(REQ_PRODUCT_CODE),
            _step(REQ_FIRMWARE),
            _step(SET_OUTPUT, configuration),
            _step(GO_TO_MEASUREMENT),
        ]

    def push(self, data: bytes) -> tuple[list[DeviceSample], list[bytes]]:
        """Take bytes; return samples, and other messages as message id and data."""
        samples: list[DeviceSample] = []
        others: list[bytes] = []
        self._buffer += data
        for number, content in self._messages():
            if number == MT_DATA2:
                sample = self._sample(content)
                if sample is not None:
                    samples.append(sample)
            else:
                others.append(bytes([number]) + content)
                self._identity[number - 1] = content
        return samples, others

    def hello(self) -> HelloLine:
        """Return what the device has said about itself."""
        revision = self._identity.get(REQ_FIRMWARE, b"")
        model = self._identity.get(REQ_PRODUCT_CODE, b"").decode("ascii", "replace").strip()
        scales = next(((rate, force) for part, rate, force in _FULL_SCALES if part in model), None)
        return HelloLine(
            imu=FORMAT_VERSION,
            make="Xsens",
            model=model,
            serial_number=self._identity.get(REQ_DID, b"").hex().upper(),
            firmware=".".join(str(part) for part in revision[:3]),
            rate_hz=float(self._rate_hz),
            clock="sample time, 0.1 ms",
            angular_rate_limit_radps=None if scales is None else math.radians(scales[0]),
            specific_force_limit_mps2=None if scales is None else scales[1] * _STANDARD_GRAVITY_MPS2,
        )

    def _messages(self) -> Iterator[tuple[int, bytes]]:
        """Remove the complete messages from the buffer, and what cannot be one."""
        while True:
            start = self._buffer.find(PREAMBLE)
            self._buffer = self._buffer[start:] if start >= 0 else b""
            data = self._buffer
            if len(data) < 4:
                return
            header, length = (4, data[3])
            if length == _EXTENDED:
                if len(data) < 6:
                    return
                header, length = 6, int.from_bytes(data[4:6], "big")
            end = header + length + 1
            if data[1] != BUS or length > _MAX_DATA_BYTES:
                self._buffer = data[1:]
            elif len(data) < end:
                return
            elif sum(data[1:end]) % 256:
                self._buffer = data[1:]
            else:
                self._buffer = data[end:]
                yield data[2], data[header : end - 1]

    def _sample(self, content: bytes) -> DeviceSample | None:
        """Decode MTData2; None if it lacks rotation or velocity."""
        counter = time_ns = angle = velocity = None
        for identifier, data in _packets(content):
            kind = identifier & _KIND
            if kind == PACKET_COUNTER and len(data) == 2:
                counter = self._count(int.from_bytes(data, "big"))
            elif kind == SAMPLE_TIME_FINE and len(data) == 4:
                time_ns = self._time(int.from_bytes(data, "big")) * _TICK_NS
            elif kind == DELTA_Q:
                angle = _rotation_vector(_floats(identifier, data))
            elif kind == DELTA_V:
                velocity = _vector(_floats(identifier, data))
        if angle is None or velocity is None or (counter is None and time_ns is None):
            return None
        return DeviceSample(counter, time_ns, angle, velocity)


def message(number: int, data: bytes = b"") -> bytes:
    """Return a message."""
    if len(data) < _EXTENDED:
        length = bytes([len(data)])
    else:
        length = bytes([_EXTENDED]) + len(data).to_bytes(2, "big")
    body = bytes([BUS, number]) + length + data
    return bytes([PREAMBLE]) + body + bytes([-sum(body) % 256])


def _packets(content: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 3 <= len(content):
        identifier, size = int.from_bytes(content[at : at + 2], "big"), content[at + 2]
        yield identifier, content[at + 3 : at + 3 + size]
        at += 3 + size


def _floats(identifier: int, data: bytes) -> tuple[float, ...]:
    code = _FLOATS.get(identifier & 0x3)
    if code is None or len(data) % struct.calcsize(code):
        return ()
    return struct.unpack(f">{len(data) // struct.calcsize(code)}{code}", data)


def _vector(values: tuple[float, ...]) -> Vector3 | None:
    return (values[0], values[1], values[2]) if len(values) == 3 and all(map(math.isfinite, values)) else None


def _rotation_vector(values: tuple[float, ...]) -> Vector3 | None:
    """Return the rotation vector of a unit quaternion [w, x, y, z]."""
    if len(values) != 4 or not all(map(math.isfinite, values)):
        return None
    w, *axis = values
    sine = math.hypot(*axis)
    angle = 2 * math.atan2(sine, abs(w))
    factor = math.copysign(angle / sine if sine > 0 else 2.0, w)
    return (factor * axis[0], factor * axis[1], factor * axis[2])


def _step(number: int, data: bytes = b"") -> Step:
    return Step(message(number, data), partial(_matches, number), _refusal)


def _matches(number: int, response: bytes) -> bool:
    return response[0] == number + 1


def _refusal(response: bytes) -> str | None:
    if response[0] != ERROR:
        return None
    code = response[1] if len(response) > 1 else 0
    return _ERRORS.get(code, f"error {code}")
