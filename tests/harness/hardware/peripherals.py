"""Fakes of the hardware modules that third-party drivers import, with a simulated chip."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any
from unittest import mock

import pytest
from harness.hardware.blocking import ACCESS_S

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from harness.hardware.blocking import BlockingProgram

    from tsgt.simulation.lora import SX1276Chip


def import_driver(name: str, fakes: dict[str, ModuleType]) -> ModuleType:
    """Import a fresh copy of a driver with these fakes; skip where it is not installed."""
    package = name.partition(".")[0]
    with mock.patch.dict(sys.modules, fakes):
        for loaded in [module for module in sys.modules if module.partition(".")[0] == package]:
            del sys.modules[loaded]
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError:
            pytest.skip(f"{package} is missing: pip install --no-deps -r tests/interop/requirements.txt")


def module(name: str, **attributes: Any) -> ModuleType:
    """Make a module with the given attributes only."""
    made = ModuleType(name)
    vars(made).update(attributes)
    return made


class CircuitPythonSpi:
    """``busio.SPI``: separate writes and reads between edges of a chip-select pin."""

    def __init__(self, chip: SX1276Chip) -> None:
        self._chip = chip

    def try_lock(self) -> bool:
        """Lock the bus."""
        return True

    def unlock(self) -> None:
        """Unlock the bus."""

    def configure(self, baudrate: int, polarity: int, phase: int) -> None:
        """Set clock and mode."""
        assert (polarity, phase) == (0, 0)
        self._chip.set_sck(baudrate)

    def write(self, data: bytes, *, start: int = 0, end: int | None = None) -> None:
        """Send bytes."""
        for byte in data[start:end]:
            self._chip.exchange(byte)

    def readinto(
        self, buffer: bytearray, *, start: int = 0, end: int | None = None, write_value: int = 0
    ) -> None:
        """Receive bytes."""
        for index in range(start, len(buffer) if end is None else end):
            buffer[index] = self._chip.exchange(write_value)


class CircuitPythonPin:
    """``digitalio.DigitalInOut`` as an output."""

    def __init__(self, on_change: Callable[[bool], None]) -> None:
        self._on_change = on_change
        self._level = False

    def switch_to_output(self, *, value: bool = False) -> None:
        """Configure as an output with that level."""
        self.value = value

    @property
    def value(self) -> bool:
        """Level of the pin."""
        return self._level

    @value.setter
    def value(self, level: bool) -> None:
        self._level = level
        self._on_change(level)


def circuit_python_modules() -> dict[str, ModuleType]:
    """Return the modules that Adafruit's driver imports, mostly names for type annotations."""
    return {
        "micropython": module("micropython", const=lambda value: value),
        "busio": module("busio", SPI=CircuitPythonSpi),
        "digitalio": module("digitalio", DigitalInOut=CircuitPythonPin),
        "circuitpython_typing": module(
            "circuitpython_typing", ReadableBuffer=bytes, WriteableBuffer=bytearray
        ),
    }


class RaspberryPi:
    """A Pi's spidev and RPi.GPIO, a radio on bus 0 with its own chip select.

    Parameters
    ----------
    program
        Spends the time of each access.
    chip
        The radio's.
    reset_pin, dio0_pin
        How it is wired.
    """

    def __init__(
        self, program: BlockingProgram, chip: SX1276Chip, *, reset_pin: int = 17, dio0_pin: int = 4
    ) -> None:
        self._program = program
        self._chip = chip
        self._reset_pin = reset_pin
        self._dio0_pin = dio0_pin
        self._on_rising: Callable[[int], None] | None = None
        self._watching = False

    def modules(self) -> dict[str, ModuleType]:
        """Return the modules that a driver imports."""
        gpio = module(
            "RPi.GPIO",
            BCM=11,
            OUT=0,
            IN=1,
            LOW=0,
            HIGH=1,
            RISING=31,
            setmode=lambda _mode: None,
            setwarnings=lambda _on: None,
            setup=lambda _pin, _direction: None,
            cleanup=lambda: None,
            input=self._input,
            output=self._output,
            add_event_detect=self._add_event_detect,
            remove_event_detect=self._remove_event_detect,
        )
        package = module("RPi", __path__=[], GPIO=gpio)
        return {"spidev": module("spidev", SpiDev=self._spi_dev), "RPi": package, "RPi.GPIO": gpio}

    def _spi_dev(self) -> SpiDev:
        return SpiDev(self._program, self._chip)

    def _input(self, pin: int) -> int:
        assert pin == self._dio0_pin
        return self._chip.dio(0)

    def _output(self, pin: int, level: int) -> None:
        assert pin == self._reset_pin
        self._chip.set_reset(not level)

    def _add_event_detect(
        self, pin: int, _edge: int, *, callback: Callable[[int], None], bouncetime: int
    ) -> None:
        assert (pin, bouncetime) == (self._dio0_pin, 10)
        self._on_rising = callback
        if not self._watching:
            self._watching = True
            self._chip.on_dio(0, self._changed)

    def _remove_event_detect(self, pin: int) -> None:
        assert pin == self._dio0_pin
        self._on_rising = None

    def _changed(self, _at_ns: int, level: bool) -> None:  # noqa: FBT001 (a level)
        callback = self._on_rising
        if level and callback is not None:
            self._program.interrupt(lambda: callback(self._dio0_pin))


class SpiDev:
    """``spidev.SpiDev`` with the kernel's chip select: each transfer is one window."""

    def __init__(self, program: BlockingProgram, chip: SX1276Chip) -> None:
        self._program = program
        self._chip = chip
        self.mode = 0
        self.lsbfirst = False

    @property
    def max_speed_hz(self) -> int:
        """Clock of the bus; write-only."""
        raise NotImplementedError

    @max_speed_hz.setter
    def max_speed_hz(self, speed_hz: int) -> None:
        self._chip.set_sck(speed_hz)

    def open(self, bus: int, device: int) -> None:
        """Open the bus with the radio."""
        assert (bus, device) == (0, 0)

    def xfer2(self, data: Sequence[int]) -> list[int]:
        """Exchange bytes in one window."""
        assert (self.mode, self.lsbfirst) == (0, False)
        self._program.sleep(ACCESS_S)
        return list(self._chip.transfer(bytes(data)))

    def close(self) -> None:
        """Close the bus."""
