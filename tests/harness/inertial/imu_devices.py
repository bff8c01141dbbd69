"""Simulated devices: bytes in, bytes out; and a pseudo-terminal at which one sends its samples in real time."""

from __future__ import annotations

import math
import os
import pty
import select
import struct
import threading
import time
import tty
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol, Self

from tsgt.imu import vectornav, xsens

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.model import Vector3

Motion = tuple["Vector3", "Vector3"]
"""Angular rate in rad/s and specific force in m/s^2."""


class SimulatedDevice(Protocol):
    """A device without its clock: what it sends, and when it is on."""

    rate_hz: float

    @property
    def running(self) -> bool:
        """Whether it sends samples."""
        ...

    def respond(self, data: bytes) -> bytes:
        """Take bytes of the program; return the responses."""
        ...

    def sample(self, number: int, motion: Motion) -> bytes:
        """Return the message of a sample."""
        ...


class SimulatedVectorNav:
    """A VN-100 that starts as from the factory: texts at 40 Hz, which are off after the first command."""

    def __init__(self) -> None:
        self.rate_hz = 0.0
        self.commands: list[str] = []
        self._buffer = b""

    @property
    def running(self) -> bool:
        """Whether binary output is on."""
        return self.rate_hz > 0

    def respond(self, data: bytes) -> bytes:
        """Execute commands; a wrong check gets an error."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return b"".join(map(self._respond, lines))

    def sample(self, number: int, motion: Motion) -> bytes:
        """Return the binary message."""
        duration_s = 1 / self.rate_hz
        rate, force = motion
        return vectornav.frame(
            5_000_000_000 + round(number * 1e9 * duration_s),
            duration_s,
            [math.degrees(value * duration_s) for value in rate],
            [value * duration_s for value in force],
        )

    def _respond(self, line: bytes) -> bytes:
        text = vectornav.checked_text(line)
        if text is None:
            return vectornav.command("VNERR,03")
        self.commands.append(text.decode())
        match text.decode().split(","):
            case ["VNRRG", "01"]:
                return vectornav.command("VNRRG,01,VN-100T-CR")
            case ["VNRRG", "03"]:
                return vectornav.command("VNRRG,03,0100012345")
            case ["VNRRG", "04"]:
                return vectornav.command("VNRRG,04,2.1.0.0")
            case ["VNWRG", "75", "0", *_]:
                self.rate_hz = 0.0
            case ["VNWRG", "75", mode, divisor, "01", "0801"] if mode in "123":
                self.rate_hz = 800 / int(divisor)
            case ["VNWRG", "06" | "82", *_]:
                pass
            case _:
                return vectornav.command("VNERR,08")
        return vectornav.command(text.decode())


class SimulatedXsens:
    """An MTi that measures when it is switched on."""

    def __init__(self) -> None:
        self.rate_hz = 100.0
        self.running = True
        self._buffer = b""

    def respond(self, data: bytes) -> bytes:
        """Execute messages."""
        self._buffer += data
        responses = b""
        while len(self._buffer) >= 5 and len(self._buffer) >= 5 + self._buffer[3]:
            length = self._buffer[3]
            content, self._buffer = (
                self._buffer[4 : 4 + length],
                self._buffer[:3] + self._buffer[5 + length :],
            )
            number, self._buffer = self._buffer[2], self._buffer[3:]
            responses += self._respond(number, content)
        return responses

    def sample(self, number: int, motion: Motion) -> bytes:
        """Return MTData2."""
        duration_s = 1 / self.rate_hz
        rate, force = motion
        half = [0.5 * value * duration_s for value in rate]
        angle = math.hypot(*half)
        quaternion = [
            math.cos(angle),
            *(value * (math.sin(angle) / angle if angle else 1.0) for value in half),
        ]
        count, ticks = (65_500 + number) % 65_536, (2**32 - 7_000 + round(number * 1e4 * duration_s)) % 2**32
        content = (
            struct.pack(">HBH", xsens.PACKET_COUNTER, 2, count)
            + struct.pack(">HBI", xsens.SAMPLE_TIME_FINE, 4, ticks)
            + struct.pack(">HB4f", xsens.DELTA_Q, 16, *quaternion)
            + struct.pack(">HB3f", xsens.DELTA_V, 12, *(value * duration_s for value in force))
            + struct.pack(">HBI", 0xE020, 4, 0x00400003)
        )
        return xsens.message(xsens.MT_DATA2, content)

    def _respond(self, number: int, content: bytes) -> bytes:
        match number:
            case xsens.GO_TO_CONFIG:
                self.running = False
            case xsens.GO_TO_MEASUREMENT:
                self.running = True
            case _ if self.running:
                return b""  # only in config state
            case xsens.REQ_DID:
                content = bytes.fromhex("037003F8")
            case xsens.REQ_PRODUCT_CODE:
                content = b"MTi-300-2A5G4       "
            case xsens.REQ_FIRMWARE:
                content = bytes.fromhex("0108020000002500011534")
            case xsens.SET_OUTPUT:
                rates = [rate for _, rate in struct.iter_unpack(">HH", content) if rate != 0xFFFF]
                self.rate_hz = float(rates[0])
            case _:
                return xsens.message(xsens.ERROR, b"\x04")
        return xsens.message(number + 1, content)


class PtyDevice:
    """A device behind a pseudo-terminal, in real time in a thread; a context manager. ``path`` is its port."""

    def __init__(self, device: SimulatedDevice, path: Path, motion: Callable[[int], Motion]) -> None:
        self._device = device
        self._motion = motion
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self.path = path
        self.silent = False

    def __enter__(self) -> Self:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path.symlink_to(os.ttyname(self._slave))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)
        self.path.unlink()

    def _serve(self) -> None:
        number, due_s = 0, time.monotonic()
        while not self._end.is_set():
            ready, _, _ = select.select([self._master], [], [], max(0.0, min(due_s - time.monotonic(), 0.05)))
            if ready:
                self._write(self._device.respond(os.read(self._master, 4096)))
            if not self._device.running:
                due_s = time.monotonic()
            elif time.monotonic() >= due_s:
                if not self.silent:
                    self._write(self._device.sample(number, self._motion(number)))
                number, due_s = number + 1, due_s + 1 / self._device.rate_hz

    def _write(self, data: bytes) -> None:
        with suppress(BlockingIOError):  # nobody reads
            os.write(self._master, data)
