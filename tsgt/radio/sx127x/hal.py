"""Hardware abstraction of an SX127x's bus and pins, and its backends on a Raspberry Pi."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from tsgt.errors import RadioError, RadioNotFoundError, RadioSettingsError


@dataclass(frozen=True, slots=True)
class Edge:
    """A rising edge of DIO0.

    ``at_ns``: on the driver's clock (CLOCK_MONOTONIC). ``lost``: number of edges before it that the hardware detected
    but could not report.
    """

    at_ns: int
    lost: int = 0


_DEV = Path("/dev")

EdgeCallback = Callable[[Edge], None]


class Hal(Protocol):
    """Bus and pins of one SX127x. All methods are called in the event loop's thread."""

    @property
    def stamp_sigma_ns(self) -> int:
        """One sigma of the edges' timestamps."""
        ...

    def transfer(self, data: bytes) -> bytes:
        """Exchange bytes in one chip-select window; as many are received as sent. Raises RadioError if the bus failed."""
        ...

    def set_reset(self, *, low: bool) -> None:
        """Pull NRESET low (True) or release it (False)."""
        ...

    def dio0(self) -> bool:
        """Return the level of DIO0. Raises RadioError if it cannot be read."""
        ...

    def on_dio0(self, callback: EdgeCallback) -> None:
        """Call ``callback`` in the running event loop's thread for every further rising edge of DIO0.

        Raises RadioError if edges cannot be detected. If they cannot be read later, each further transfer raises it.
        """
        ...

    def close(self) -> None:
        """Release bus and pins."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiring:
    """Connection of the radio; pins in BCM numbers.

    Attributes
    ----------
    backend
        ``gpiod``: the kernel timestamps edges; ``rpi-gpio``: RPi.GPIO or its replacement rpi-lgpio.
    spi_bus, spi_device
        /dev/spidev<bus>.<device>.
    spi_hz
        At most 10 MHz (data sheet, SPI timing).
    nss_pin
        Chip select driven as GPIO; None: by the kernel's SPI driver.
    gpio_chip
        Path such as /dev/gpiochip0; None: found by its label. ``gpiod`` only.
    """

    backend: Literal["gpiod", "rpi-gpio"] = "gpiod"
    spi_bus: int = 0
    spi_device: int = 0
    spi_hz: int = 5_000_000
    reset_pin: int
    dio0_pin: int
    nss_pin: int | None
    gpio_chip: str | None = None

    def __post_init__(self) -> None:
        if not 0 < self.spi_hz <= 10_000_000:
            raise RadioSettingsError(f"spi_hz must be at most 10000000, got {self.spi_hz}")


def open_hal(wiring: Wiring) -> Hal:
    """Open bus and pins on a Raspberry Pi.

    Raises RadioNotFoundError if there is no such SPI bus or GPIO chip. Raises RadioError if a package is missing, the
    bus or a pin is in use, or permission is denied.
    """
    spi = _Spi(wiring)
    try:
        return _GpiodHal(wiring, spi) if wiring.backend == "gpiod" else _RpiGpioHal(wiring, spi)
    except RadioError:
        spi.close()
        raise


class _PiHal(ABC):
    """Bus and pins, with chip select as GPIO; a subclass for each GPIO package."""

    stamp_sigma_ns: int
    _open: ExitStack  # releases the pins

    def __init__(self, wiring: Wiring, spi: _Spi) -> None:
        self._spi = spi
        self._broken: RadioError | None = None  # Edges are no longer reported: only opening it again helps
        self._nss_pin, self._reset_pin, self._dio0_pin = wiring.nss_pin, wiring.reset_pin, wiring.dio0_pin

    @abstractmethod
    def _drive(self, pin: int, *, low: bool) -> None: ...

    @abstractmethod
    def dio0(self) -> bool: ...

    @abstractmethod
    def on_dio0(self, callback: EdgeCallback) -> None: ...

    def transfer(self, data: bytes) -> bytes:
        if self._broken is not None:
            raise self._broken
        with _reported(f"{self._spi.path}: transfer failed"):
            if self._nss_pin is None:
                return self._spi.transfer(data)
            self._drive(self._nss_pin, low=True)
            try:
                return self._spi.transfer(data)
            finally:
                self._drive(self._nss_pin, low=False)

    def set_reset(self, *, low: bool) -> None:
        with _reported(f"BCM {self._reset_pin} (reset) cannot be set"):
            self._drive(self._reset_pin, low=low)

    def close(self) -> None:
        self._open.close()
        self._spi.close()


@contextmanager
def _reported(what: str) -> Iterator[None]:
    """Report any failure of the packages as RadioError: gpiod also raises ValueError, RPi.GPIO RuntimeError, lgpio a plain Exception."""
    try:
        yield
    except RadioError:
        raise
    except Exception as error:
        raise RadioError(f"{what}: {str(error) or type(error).__name__}") from error


def _release(stack: ExitStack, function: Callable[..., object], *arguments: object) -> None:
    """Call a function at the end, whatever it raises then: a pin of a chip that is gone cannot be released."""

    def release() -> None:
        with suppress(Exception):
            function(*arguments)

    stack.callback(release)


_INSTALL = "pip install 'tsgt[pi]', on a Pi 5 'tsgt[pi5]'"
_GPIO_GROUP = "no permission for the GPIO pins: sudo usermod -aG gpio $USER, then log in again"
_WHY_BUSY = {
    "NSS": "an overlay such as spi0-1cs,cs0_pin=25 drives it; remove that, or set no nss_pin",
    "reset": "another program drives it",
    "DIO0": "the overlay w1-gpio takes BCM 4; remove it or move it to another pin",
}


def _busy(pin: int, role: str) -> RadioError:
    return RadioError(
        f"BCM {pin} ({role}) is in use: {_WHY_BUSY[role]}, or tsgt runs twice; gpioinfo shows who has it"
    )


class _Spi:
    """The kernel's SPI bus, locked by this process."""

    def __init__(self, wiring: Wiring) -> None:
        try:
            import spidev  # noqa: PLC0415 (only on a Pi)
        except ImportError as error:
            raise RadioError(f"the Python package spidev is missing: {_INSTALL}") from error
        self.path = f"/dev/spidev{wiring.spi_bus}.{wiring.spi_device}"
        self._bus = spidev.SpiDev()
        try:
            self._bus.open(wiring.spi_bus, wiring.spi_device)
        except FileNotFoundError as error:
            raise RadioNotFoundError(
                f"there is no {self.path}: switch SPI on (sudo raspi-config nonint do_spi 0) and reboot"
            ) from error
        except PermissionError as error:
            raise RadioError(
                f"no permission for {self.path}: sudo usermod -aG spi $USER, then log in again"
            ) from error
        except OSError as error:
            raise RadioError(f"{self.path} cannot be opened: {error}") from error
        try:
            # Two programs on one radio would disturb each other, and the kernel allows it.
            fcntl.flock(self._bus.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._set_up(wiring)
        except BlockingIOError as error:
            self.close()
            raise RadioError(f"{self.path} is in use: tsgt runs twice, or two radios share it") from error
        except Exception as error:
            self.close()
            raise RadioError(f"{self.path} cannot be set to mode 0, {wiring.spi_hz} Hz: {error}") from error

    def _set_up(self, wiring: Wiring) -> None:
        """Set all settings: the kernel keeps those of the program before."""
        self._bus.mode = 0
        for flag in ("cshigh", "lsbfirst", "loop", "threewire"):
            if getattr(self._bus, flag):
                setattr(self._bus, flag, False)
        self._bus.bits_per_word = 8
        self._bus.max_speed_hz = wiring.spi_hz
        by_pin = wiring.nss_pin is not None
        if by_pin != self._bus.no_cs:
            # Some controllers cannot switch their own chip select off, and need not: nothing is connected to it.
            with suppress(OSError) if by_pin else contextlib.nullcontext():
                self._bus.no_cs = by_pin

    def transfer(self, data: bytes) -> bytes:
        return bytes(self._bus.xfer2(list(data)))

    def close(self) -> None:
        self._bus.close()


class _GpiodHal(_PiHal):
    """Pins of the GPIO character device; the kernel timestamps each edge in its interrupt handler."""

    stamp_sigma_ns = 10_000  # interrupt latency of a Pi is 2 to 10 us (published figures; not measured by us)

    _EVENT_BUFFER = 64
    _CHIP_LABELS = ("pinctrl-bcm2835", "pinctrl-bcm2711", "pinctrl-rp1")
    """Labels of the pin header's chip: Pi 0 to 3, 4, 5."""

    def __init__(self, wiring: Wiring, spi: _Spi) -> None:
        super().__init__(wiring, spi)
        try:
            import gpiod  # noqa: PLC0415 (only on a Pi)
        except ImportError as error:
            raise RadioError(f"the Python package gpiod is missing: {_INSTALL}") from error
        if not hasattr(gpiod, "request_lines"):
            raise RadioError(f"the Python package gpiod is older than 2.0: {_INSTALL}")
        self._gpiod = gpiod
        self._chip = wiring.gpio_chip or self._find_chip()
        line = gpiod.line
        self._released, self._low = line.Value.ACTIVE, line.Value.INACTIVE
        output = gpiod.LineSettings(direction=line.Direction.OUTPUT, output_value=line.Value.ACTIVE)
        edges = gpiod.LineSettings(
            direction=line.Direction.INPUT,
            edge_detection=line.Edge.RISING,
            bias=line.Bias.PULL_DOWN,
            event_clock=line.Clock.MONOTONIC,
        )
        self._last_seqno = 0
        self._lines: dict[int, Any] = {}
        with ExitStack() as stack:
            if self._nss_pin is not None:
                self._request(stack, self._nss_pin, "NSS", output)
            self._request(stack, self._reset_pin, "reset", output)
            self._request(stack, self._dio0_pin, "DIO0", edges)
            self._open = stack.pop_all()

    def _find_chip(self) -> str:
        try:
            for path in sorted(_DEV.glob("gpiochip*")):
                with self._gpiod.Chip(str(path)) as chip:
                    if chip.get_info().label in self._CHIP_LABELS:
                        return str(path)
        except PermissionError as error:
            raise RadioError(_GPIO_GROUP) from error
        except Exception as error:
            raise RadioError(f"{path} cannot be opened: {error}") from error
        raise RadioNotFoundError(
            f"no /dev/gpiochip* has the label {', '.join(self._CHIP_LABELS)}: on a board other than a Raspberry Pi, "
            "name it as gpio_chip"
        )

    def _request(self, stack: ExitStack, pin: int, role: str, settings: object) -> None:
        try:
            self._lines[pin] = self._gpiod.request_lines(
                self._chip, consumer="tsgt", config={pin: settings}, event_buffer_size=self._EVENT_BUFFER
            )
        except FileNotFoundError as error:
            raise RadioNotFoundError(f"there is no GPIO chip {self._chip}: gpiodetect lists them") from error
        except PermissionError as error:
            raise RadioError(_GPIO_GROUP) from error
        except OSError as error:
            if error.errno == errno.EBUSY:
                raise _busy(pin, role) from error
            raise RadioError(f"BCM {pin} ({role}) is not available: {error}") from error
        except Exception as error:  # ValueError: the chip has no such line
            raise RadioError(f"BCM {pin} ({role}) is not available on {self._chip}: {error}") from error
        _release(stack, self._lines[pin].release)

    def _drive(self, pin: int, *, low: bool) -> None:
        self._lines[pin].set_value(pin, self._low if low else self._released)

    def dio0(self) -> bool:
        with _reported(f"BCM {self._dio0_pin} (DIO0) cannot be read"):
            return bool(self._lines[self._dio0_pin].get_value(self._dio0_pin) == self._released)

    def on_dio0(self, callback: EdgeCallback) -> None:
        line = self._lines[self._dio0_pin]
        loop = asyncio.get_running_loop()

        def read_edges() -> None:
            try:
                with _reported(f"edges of BCM {self._dio0_pin} (DIO0) cannot be read"):
                    events = line.read_edge_events()
            except RadioError as error:
                # A line that is gone stays readable, and would be read again at once, for ever.
                loop.remove_reader(fd)
                self._broken = error
                return
            for event in events:
                # The sequence number increments with each edge; a full buffer drops the oldest.
                lost = event.line_seqno - self._last_seqno - 1
                self._last_seqno = event.line_seqno
                callback(Edge(event.timestamp_ns, lost))

        with _reported(f"edges of BCM {self._dio0_pin} (DIO0) cannot be awaited"):
            fd = line.fd
            loop.add_reader(fd, read_edges)
        _release(self._open, loop.remove_reader, fd)


class _RpiGpioHal(_PiHal):
    """Pins of RPi.GPIO or rpi-lgpio; a Python thread timestamps edges when it is scheduled."""

    stamp_sigma_ns = 1_000_000

    _LGPIO_DELAY_NS = 500_000
    """lgpio, below rpi-lgpio, holds each edge for that long, to report those of all pins in order (its lgPthAlerts.c)."""

    def __init__(self, wiring: Wiring, spi: _Spi) -> None:
        super().__init__(wiring, spi)
        try:
            with _writable_folder():
                from RPi import GPIO  # noqa: PLC0415 (only on a Pi)
        except ImportError as error:
            raise RadioError(f"the Python package RPi.GPIO is missing: {_INSTALL}") from error
        except Exception as error:
            raise RadioError(
                f"RPi.GPIO does not work on this board ({error}): use gpiod or rpi-lgpio"
            ) from error
        self._gpio = GPIO
        self._delay_ns = self._LGPIO_DELAY_NS if hasattr(GPIO, "lgpio") else 0
        try:
            GPIO.setwarnings(False)  # a killed program leaves its pins configured
            GPIO.setmode(GPIO.BCM)
        except Exception as error:
            raise _not_available("the GPIO chip", error) from error
        with ExitStack() as stack:
            if self._nss_pin is not None:
                self._set_up(stack, self._nss_pin, "NSS", GPIO.OUT, initial=GPIO.HIGH)
            self._set_up(stack, self._reset_pin, "reset", GPIO.OUT, initial=GPIO.HIGH)
            self._set_up(stack, self._dio0_pin, "DIO0", GPIO.IN, pull_up_down=GPIO.PUD_DOWN)
            self._open = stack.pop_all()

    def _set_up(self, stack: ExitStack, pin: int, role: str, direction: int, **options: int) -> None:
        try:
            self._gpio.setup(pin, direction, **options)
        except Exception as error:  # rpi-lgpio raises its own class, unknown to RPi.GPIO
            if "busy" in str(error).lower():
                raise _busy(pin, role) from error
            raise _not_available(f"BCM {pin} ({role})", error) from error
        _release(stack, self._gpio.cleanup, pin)

    def _drive(self, pin: int, *, low: bool) -> None:
        self._gpio.output(pin, self._gpio.LOW if low else self._gpio.HIGH)

    def dio0(self) -> bool:
        with _reported(f"BCM {self._dio0_pin} (DIO0) cannot be read"):
            return bool(self._gpio.input(self._dio0_pin))

    def on_dio0(self, callback: EdgeCallback) -> None:
        loop = asyncio.get_running_loop()

        def on_thread_edge(_channel: int) -> None:
            edge = Edge(time.monotonic_ns() - self._delay_ns)
            with suppress(RuntimeError):  # the loop was closed
                loop.call_soon_threadsafe(callback, edge)

        try:
            self._gpio.add_event_detect(self._dio0_pin, self._gpio.RISING, callback=on_thread_edge)
        except Exception as error:
            raise RadioError(
                f"RPi.GPIO gets no interrupts ({error}), as on every kernel since 6.6: use gpiod or rpi-lgpio"
            ) from error
        _release(self._open, self._gpio.remove_event_detect, self._dio0_pin)


def _not_available(what: str, error: Exception) -> RadioError:
    if "/dev/mem" in str(error) or "permission" in str(error).lower():
        return RadioError(_GPIO_GROUP)
    return RadioError(f"{what} is not available: {error}")


@contextmanager
def _writable_folder() -> Iterator[None]:
    """Work in a temporary folder: lgpio makes a pipe in the working directory when it is imported, and a service has ``/``."""
    before = os.environ.pop("LG_WD", None)  # It would lead lgpio elsewhere
    try:
        with tempfile.TemporaryDirectory(prefix="tsgt-") as folder, contextlib.chdir(folder):
            yield
    finally:
        if before is not None:
            os.environ["LG_WD"] = before
