"""A program that reads a device on a serial port and prints its lines; it blocks, and has nothing else to do.

docs/reference/imu-program.md specifies what it prints and how it ends.
"""

from __future__ import annotations

import os
import select
import sys
import time
from typing import TYPE_CHECKING

from tsgt.errors import InstrumentError
from tsgt.imu.lines import SamplesLine
from tsgt.recording import encode_line

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.imu.device import Device, DeviceSample, Step

RESPONSE_TIMEOUT_S = 0.5
ATTEMPTS = 6  # of each request: a device that sends at full rate may garble the first responses

SILENCE_TIMEOUT_S = 1.0  # without a sample

LINES_PER_S = 40

_READ_BYTES = 4096


class Port:
    """The serial port and the program's stdin; ``name`` is the port's, for errors."""

    def __init__(self, name: str, baud: int) -> None:
        import serial  # noqa: PLC0415 (only these programs need it)

        self.name = f"{name} at {baud} baud"
        try:
            self._port = serial.Serial(name, baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            raise InstrumentError(f"{name} cannot be opened: {error}") from error
        self._stdin = sys.stdin.fileno()

    def write(self, data: bytes) -> None:
        """Send bytes to the device."""
        try:
            self._port.write(data)
        except OSError as error:
            raise InstrumentError(f"{self.name}: cannot be written: {error}") from error

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """Return bytes of the device and when they arrived on CLOCK_MONOTONIC; none after the timeout.

        Raises SystemExit at the end of stdin, and InstrumentError when the device is gone.
        """
        ready, _, _ = select.select([self._port.fileno(), self._stdin], [], [], timeout_s)
        if self._stdin in ready and not os.read(self._stdin, _READ_BYTES):
            raise SystemExit(0)
        if self._port.fileno() not in ready:
            return b"", time.monotonic_ns()
        try:
            data = os.read(self._port.fileno(), _READ_BYTES)
        except OSError as error:
            raise InstrumentError(f"{self.name}: the device is gone: {error}") from error
        if not data:
            raise InstrumentError(f"{self.name}: the device is gone")
        # Not before the bytes are read: others may arrive meanwhile, and a time that is early displaces all those after.
        return data, time.monotonic_ns()


def run(device: Device, port: Port, rate_hz: int, put: Callable[[bytes], None]) -> None:
    """Set a device up and print its samples until stdin ends; ``put`` prints a line and flushes.

    Raises InstrumentError if the device does not respond, refuses a request, or falls silent.
    """
    for step in device.steps:
        _execute(step, device, port)
    put(encode_line(device.hello()))
    per_line = max(1, round(rate_hz / LINES_PER_S))
    pending: list[tuple[DeviceSample, int]] = []
    last_ns = time.monotonic_ns()
    while True:
        data, at_ns = port.read(SILENCE_TIMEOUT_S)
        samples, _ = device.push(data)
        pending += [(sample, at_ns) for sample in samples]
        if samples:
            last_ns = at_ns
        elif at_ns - last_ns > SILENCE_TIMEOUT_S * 1e9:
            raise InstrumentError(f"{port.name}: no sample for {SILENCE_TIMEOUT_S:g} s")
        while len(pending) >= per_line:
            put(encode_line(samples_line(pending[:per_line])))
            del pending[:per_line]


def samples_line(samples: Sequence[tuple[DeviceSample, int]]) -> SamplesLine:
    """Return the line of samples and when each arrived."""
    counters = [sample.counter for sample, _ in samples if sample.counter is not None]
    times_ns = [sample.instrument_time_ns for sample, _ in samples if sample.instrument_time_ns is not None]
    return SamplesLine(
        counter=tuple(counters) if len(counters) == len(samples) else None,
        instrument_time_ns=tuple(times_ns) if len(times_ns) == len(samples) else None,
        host_time_ns=tuple(at_ns for _, at_ns in samples),
        delta_angle_rad=tuple(sample.delta_angle_rad for sample, _ in samples),
        delta_velocity_mps=tuple(sample.delta_velocity_mps for sample, _ in samples),
    )


def _execute(step: Step, device: Device, port: Port) -> None:
    """Send a request until the device responds."""
    reason = "does not respond; check the cable and the baud rate"
    for _ in range(ATTEMPTS):
        port.write(step.request)
        until_ns = time.monotonic_ns() + round(RESPONSE_TIMEOUT_S * 1e9)
        while (left_ns := until_ns - time.monotonic_ns()) > 0:
            data, _ = port.read(left_ns / 1e9)
            _, messages = device.push(data)
            if any(map(step.matches, messages)):
                return
            refusals = [why for why in map(step.refusal, messages) if why is not None]
            if refusals:
                reason = f"refuses a request: {refusals[0]}"
                break
    raise InstrumentError(f"{port.name}: the device {reason}")
