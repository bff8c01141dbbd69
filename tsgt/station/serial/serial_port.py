"""A serial port on asyncio: opened exclusively, and with the lowest latency that its adapter allows."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import termios
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import serial
import serial_asyncio
import structlog

from tsgt.errors import InstrumentError
from tsgt.station.serial.base import Chunk
from tsgt.station.serial.chunk_queue import ChunkQueue

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.station.serial.base import Port

log = structlog.get_logger()

_ROOT: Final = Path("/")
_GOOD_LATENCY_MS: Final = 2
_KEPT_CHUNKS: Final = 1024  # of at most 1 KiB; unread data must not fill the memory
_PTY_MAJORS: Final = range(136, 144)

_FAILURES: Final = (OSError, ValueError, termios.error)
"""Exceptions of pyserial: SerialException is an OSError, ``termios.error`` is not."""


async def open_serial_port(path: Path, baud: int, clock: Clock) -> Port:
    """Open a serial port exclusively, with 8 data bits, no parity and one stop bit.

    Raises InstrumentError if the port does not exist, is in use, may not be opened, or does not support the baud rate.
    """
    try:
        device = serial.Serial(os.fspath(path), baud, timeout=0, exclusive=True)
    except _FAILURES as error:
        raise InstrumentError(_open_error(path, baud, error)) from error
    try:
        if os.major(os.fstat(device.fileno()).st_rdev) not in _PTY_MAJORS:
            # The lock above is advisory. On a pseudo-terminal TIOCEXCL would outlive this process.
            fcntl.ioctl(device.fileno(), termios.TIOCEXCL)
    except _FAILURES as error:
        device.close()
        raise InstrumentError(_open_error(path, baud, error)) from error
    _lower_latency(path, device)
    port = _SerialPort(str(path), baud, clock)
    serial_asyncio.SerialTransport(asyncio.get_running_loop(), port, device)
    await port.opened
    return port


def port_holder(path: Path, *, root: Path = _ROOT) -> str | None:
    """Return the process that has a port open, as ``minicom (process 123)``; None if there is none, or it is unknown."""
    device = os.path.realpath(path)
    for descriptor in root.glob("proc/[0-9]*/fd/*"):
        with suppress(OSError):  # another user's, or gone meanwhile
            if str(descriptor.readlink()) == device:
                return _process(descriptor.parents[1])
    # Other users' processes hide their open files, but /proc/locks is public.
    with suppress(OSError, ValueError):
        status = Path(device).stat()
        place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
        for line in (root / "proc" / "locks").read_text(encoding="ascii").splitlines():
            fields = line.split()
            if place in fields:
                return _process(root / "proc" / fields[fields.index(place) - 1])
    return None


def latency_timer_ms(path: Path, *, root: Path = _ROOT) -> int | None:
    """Return the time for which a USB adapter holds data back; FTDI: 16 ms by default. None: without a timer."""
    try:
        return int(_latency_timer(path, root).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


class _SerialPort(asyncio.Protocol):
    """A :class:`~tsgt.station.serial.base.Port`."""

    def __init__(self, name: str, baud: int, clock: Clock) -> None:
        loop = asyncio.get_running_loop()
        self.name = name
        self.baud = baud
        self.opened: asyncio.Future[None] = loop.create_future()
        self._closed: asyncio.Future[None] = loop.create_future()
        self._clock = clock
        self._transport: Any = None
        self._received = ChunkQueue(_KEPT_CHUNKS)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        if not self.opened.done():
            self.opened.set_result(None)

    def data_received(self, data: bytes) -> None:
        self._received.put(Chunk(data, self._clock.monotonic_ns()))

    def connection_lost(self, exc: Exception | None) -> None:
        self._received.fail(_lost_message(self.name, exc))
        self._closed.set_result(None)

    def write(self, data: bytes) -> None:
        self._received.check()
        try:
            # Not by the transport: it would log a traceback when the cable has just been unplugged.
            os.write(self._transport.serial.fileno(), data)
        except BlockingIOError:
            pass  # the output buffer is full; the missing reply reveals the lost request
        except _FAILURES as error:
            message = _lost_message(self.name, error)
            self._received.fail(message)
            raise InstrumentError(message) from error

    async def read(self) -> Chunk:
        return await self._received.read()

    def drain(self) -> bytes:
        return self._received.drain()

    async def close(self) -> None:
        self._received.fail(f"{self.name}: closed")
        if not self._transport.is_closing():
            with suppress(*_FAILURES):
                # Closing would otherwise block until the kernel has sent its buffer.
                self._transport.serial.reset_output_buffer()
            self._transport.abort()
        await asyncio.shield(self._closed)


def _lost_message(name: str, error: Exception | None) -> str:
    return f"{name}: the line is gone, probably unplugged ({error})"


def _lower_latency(path: Path, device: serial.Serial) -> None:
    with suppress(*_FAILURES):  # not supported by every port
        device.set_low_latency_mode(True)
    latency_ms = latency_timer_ms(path, root=_ROOT)
    if latency_ms is not None and latency_ms > _GOOD_LATENCY_MS:
        with suppress(OSError):
            _latency_timer(path, _ROOT).write_text("1", encoding="ascii")
            latency_ms = latency_timer_ms(path, root=_ROOT)
    if latency_ms is not None and latency_ms > _GOOD_LATENCY_MS:
        _warn_latency(str(path), latency_ms)


@cache  # once, not at every baud rate tried
def _warn_latency(port: str, latency_ms: int) -> None:
    log.warning("serial_latency", port=port, latency_ms=latency_ms)


def _latency_timer(path: Path, root: Path) -> Path:
    return root / "sys/bus/usb-serial/devices" / Path(os.path.realpath(path)).name / "latency_timer"


def _process(folder: Path) -> str:
    name = "a process"
    with suppress(OSError):
        name = (folder / "comm").read_text(encoding="utf-8", errors="replace").strip()
    return f"{name} (process {folder.name})"


def _open_error(path: Path, baud: int, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return f"there is no {path}: plug the cable in, or list the ports with: ls /dev/serial/by-id/"
    if number in (errno.EACCES, errno.EPERM):
        return f"no permission for {path}: add the user to the group of the device (dialout or uucp)"
    if number in (errno.EBUSY, errno.EAGAIN):
        holder = port_holder(path) or "a process of another user"
        return f"{path} is taken by {holder}: stop it, a port can have one user only"
    return f"{path} cannot be opened at {baud} baud: {error}"
