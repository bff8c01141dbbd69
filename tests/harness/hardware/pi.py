"""A Raspberry Pi without hardware: fakes of spidev, gpiod 2 and RPi.GPIO with pins and a bus."""

from __future__ import annotations

import enum
import os
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import Self


class Value(enum.Enum):
    """gpiod.line.Value."""

    INACTIVE = 0
    ACTIVE = 1


LINE = SimpleNamespace(
    Value=Value,
    Direction=enum.Enum("Direction", "INPUT OUTPUT"),
    Edge=enum.Enum("Edge", "NONE RISING FALLING"),
    Bias=enum.Enum("Bias", "AS_IS PULL_DOWN PULL_UP"),
    Clock=enum.Enum("Clock", "MONOTONIC REALTIME"),
)


class FakePi:
    """Pins, bus, and their faults.

    Attributes
    ----------
    levels
        Of each pin that has been set up, by BCM number.
    transfers
        Bytes of each transfer.
    nss_pin
        The pin whose level ``nss_during_transfer`` keeps for each transfer.
    answer, on_drive
        Response of the bus, and observer of every output.
    open_error, transfer_error, request_errors
        What spidev raises on opening and on transferring, and what asking for a pin raises.
    drive_error, read_error, release_error
        What setting an output, reading a pin or its edges, and releasing a pin raise.
    """

    def __init__(self, dev: Path, nss_pin: int | None = 25) -> None:
        self.levels: dict[int, bool] = {}
        self.transfers: list[bytes] = []
        self.nss_during_transfer: list[bool | None] = []
        self.answer: Callable[[bytes], bytes] = lambda data: data
        self.nss_pin = nss_pin
        self.open_error: Exception | None = None
        self.transfer_error: Exception | None = None
        self.no_cs_error: Exception | None = None
        self.drive_error: Exception | None = None
        self.read_error: Exception | None = None
        self.release_error: Exception | None = None
        # The kernel keeps these from one program to the next.
        self.bus_settings: dict[str, Any] = {
            **dict.fromkeys(("no_cs", "cshigh", "lsbfirst", "loop", "threewire"), False),
            "mode": 0,
            "bits_per_word": 0,
            "max_speed_hz": 500_000,
        }
        self.request_errors: dict[int, Exception] = {}
        self.chip_error: Exception | None = None
        self.labels = {"gpiochip0": "raspberrypi-exp-gpio", "gpiochip4": "pinctrl-rp1"}
        self.buses: list[Any] = []
        self.requests: list[FakeRequest] = []
        self.on_drive: Callable[[int, bool], None] = lambda _pin, _level: None
        self._dev = dev
        for name in (*self.labels, "spidev0.0"):
            (dev / name).touch()

    def drive(self, pin: int, *, level: bool) -> None:
        """Set an output, as a program does."""
        if self.drive_error is not None:
            raise self.drive_error
        self.levels[pin] = level
        self.on_drive(pin, level)

    @property
    def open_things(self) -> int:
        """Number of buses and pins that are not released."""
        return len([bus for bus in self.buses if bus.is_open]) + len(self.levels)

    def spidev(self) -> ModuleType:
        """Make a fake of spidev 3."""
        pi = self

        class SpiDev:
            def __init__(self) -> None:
                self._fd = -1
                self.is_open = False
                pi.buses.append(self)

            def __getattr__(self, name: str) -> Any:
                try:
                    return pi.bus_settings[name]
                except KeyError:
                    raise AttributeError(name) from None

            def __setattr__(self, name: str, value: Any) -> None:
                if name == "no_cs" and pi.no_cs_error is not None:
                    raise pi.no_cs_error
                if name in pi.bus_settings:
                    pi.bus_settings[name] = value
                else:
                    super().__setattr__(name, value)

            def open(self, bus: int, device: int) -> None:
                if pi.open_error is not None:
                    raise pi.open_error
                self._fd = os.open(pi._dev / f"spidev{bus}.{device}", os.O_RDWR)
                self.is_open = True

            def fileno(self) -> int:
                return self._fd

            def xfer2(self, data: list[int]) -> list[int]:
                if pi.transfer_error is not None:
                    raise pi.transfer_error
                pi.transfers.append(bytes(data))
                pi.nss_during_transfer.append(None if pi.nss_pin is None else pi.levels[pi.nss_pin])
                return list(pi.answer(bytes(data)))

            def close(self) -> None:
                if self.is_open:
                    os.close(self._fd)
                self.is_open = False

        return _module("spidev", SpiDev=SpiDev)

    def gpiod(self) -> ModuleType:
        """Make a fake of gpiod 2."""
        pi = self

        class Chip:
            def __init__(self, path: str) -> None:
                if pi.chip_error is not None:
                    raise pi.chip_error
                self._name = os.path.basename(path)  # noqa: PTH119 (as given)

            def __enter__(self) -> Self:
                return self

            def __exit__(self, *_: object) -> None: ...

            def get_info(self) -> SimpleNamespace:
                return SimpleNamespace(label=pi.labels[self._name])

        def request_lines(
            path: str, consumer: str, config: dict[int, LineSettings], event_buffer_size: int
        ) -> FakeRequest:
            assert consumer
            assert event_buffer_size
            ((pin, settings),) = config.items()
            if pin in pi.request_errors:
                raise pi.request_errors[pin]
            request = FakeRequest(pi, path, pin, settings)
            pi.requests.append(request)
            return request

        return _module("gpiod", Chip=Chip, LineSettings=LineSettings, line=LINE, request_lines=request_lines)

    def rpi(self) -> ModuleType:
        """Make a fake of the package RPi with its GPIO."""
        return _module("RPi", GPIO=FakeRpiGpio(self))


@dataclass
class LineSettings:
    """gpiod.LineSettings."""

    direction: Any
    output_value: Value | None = None
    edge_detection: Any = None
    bias: Any = None
    event_clock: Any = None


class FakeRequest:
    """gpiod.LineRequest of one line."""

    def __init__(self, pi: FakePi, path: str, pin: int, settings: LineSettings) -> None:
        self.path, self.pin, self.settings = path, pin, settings
        self.fd, self._writer = os.pipe()
        self._pi = pi
        self._events: list[SimpleNamespace] = []
        self._seqno = 0
        pi.levels[pin] = settings.output_value is Value.ACTIVE

    def set_value(self, pin: int, value: Value) -> None:
        """Drive the line."""
        assert pin == self.pin
        self._pi.drive(pin, level=value is Value.ACTIVE)

    def get_value(self, pin: int) -> Value:
        """Read the line."""
        assert pin == self.pin
        if self._pi.read_error is not None:
            raise self._pi.read_error
        return Value.ACTIVE if self._pi.levels[pin] else Value.INACTIVE

    def rise(self, timestamp_ns: int, *, lost: int = 0) -> None:
        """Raise an edge, after ``lost`` ones that overflowed the kernel's buffer."""
        self._seqno += 1 + lost
        self._events.append(SimpleNamespace(timestamp_ns=timestamp_ns, line_seqno=self._seqno))
        os.write(self._writer, b".")

    def read_edge_events(self) -> list[SimpleNamespace]:
        """Return all pending edges; would block without any."""
        if self._pi.read_error is not None:
            raise self._pi.read_error
        assert self._events, "read_edge_events() blocks when there are none"
        os.read(self.fd, 100)
        events, self._events = self._events, []
        return events

    def release(self) -> None:
        """Release the line."""
        if self._pi.release_error is not None:
            raise self._pi.release_error
        del self._pi.levels[self.pin]
        os.close(self.fd)
        os.close(self._writer)


@dataclass
class FakeRpiGpio:
    """RPi.GPIO; the test calls its interrupts from a thread."""

    pi: FakePi
    BCM: int = 11
    OUT: int = 0
    IN: int = 1
    LOW: int = 0
    HIGH: int = 1
    RISING: int = 31
    PUD_DOWN: int = 21
    detect_error: Exception | None = None
    mode_error: Exception | None = None
    callbacks: dict[int, Callable[[int], None]] = field(default_factory=dict)
    pulls: dict[int, int] = field(default_factory=dict)
    mode: int = 0

    def setwarnings(self, flag: bool) -> None:  # noqa: FBT001 (as there)
        """Accept it."""

    def setmode(self, mode: int) -> None:
        """Accept the numbering of the pins."""
        if self.mode_error is not None:
            raise self.mode_error
        self.mode = mode

    def setup(self, pin: int, direction: int, *, initial: int = 0, pull_up_down: int = 20) -> None:
        """Set up a pin."""
        assert self.mode == self.BCM
        if pin in self.pi.request_errors:
            raise self.pi.request_errors[pin]
        self.pi.levels[pin] = direction == self.OUT and bool(initial)
        self.pulls[pin] = pull_up_down

    def output(self, pin: int, level: int) -> None:
        """Drive a pin."""
        self.pi.drive(pin, level=bool(level))

    def input(self, pin: int) -> int:
        """Read a pin."""
        if self.pi.read_error is not None:
            raise self.pi.read_error
        return int(self.pi.levels[pin])

    def add_event_detect(self, pin: int, edge: int, callback: Callable[[int], None]) -> None:
        """Enable interrupts."""
        assert edge == self.RISING
        if self.detect_error is not None:
            raise self.detect_error
        self.callbacks[pin] = callback

    def remove_event_detect(self, pin: int) -> None:
        """Disable interrupts."""
        del self.callbacks[pin]

    def cleanup(self, pin: int) -> None:
        """Release a pin."""
        if self.pi.release_error is not None:
            raise self.pi.release_error
        del self.pi.levels[pin]


def _module(name: str, **attributes: Any) -> ModuleType:
    module = ModuleType(name)
    vars(module).update(attributes)
    return module
