"""Examine the packages of a Raspberry Pi that are installed here, and what tsgt makes of their failures; prints JSON.

Usage: examine_pi_libraries.py HAL RPI-MODULE, with the path of tsgt/radio/sx127x/hal.py. It runs in an environment that has these packages alone.
"""

from __future__ import annotations

import importlib.util
import inspect
import json
import os
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

UNWRITABLE = "/proc"  # Also for root, as is the working directory of a service for its user


def error_of(call: Callable[[], object]) -> str:
    """Return class and text of what a call raises."""
    try:
        call()
    except Exception as error:  # noqa: BLE001 (that is the question)
        return f"{type(error).__name__}: {error}"
    return ""


def gpiod_package() -> dict[str, Any]:
    """Return names and parameters of the package gpiod."""
    import gpiod  # noqa: PLC0415 (one of two environments has it)

    return {
        "request_lines": list(inspect.signature(gpiod.request_lines).parameters),
        "LineSettings": list(inspect.signature(gpiod.LineSettings).parameters),
        "LineRequest": dir(gpiod.LineRequest),
        "EdgeEvent": [*inspect.signature(gpiod.EdgeEvent).parameters],
        "ChipInfo": [*inspect.signature(gpiod.ChipInfo).parameters],
        "Chip": dir(gpiod.Chip),
        "line": {
            name: [each.name for each in getattr(gpiod.line, name)]
            for name in ("Value", "Direction", "Edge", "Bias", "Clock")
        },
        "no chip": error_of(
            lambda: gpiod.request_lines("/dev/gpiochip77", consumer="tsgt", config={4: gpiod.LineSettings()})
        ),
    }


def main(hal_path: str, backend: str) -> None:
    """Examine everything."""
    spec = importlib.util.spec_from_file_location("hal", hal_path)
    assert spec is not None
    assert spec.loader is not None
    hal = importlib.util.module_from_spec(spec)
    sys.modules["hal"] = hal
    spec.loader.exec_module(hal)
    import spidev  # noqa: PLC0415 (with the others)

    os.chdir(UNWRITABLE)
    bus = SimpleNamespace(path="/dev/spidev0.0", close=lambda: None)

    def wiring(**options: Any) -> Any:
        return hal.Wiring(reset_pin=17, dio0_pin=4, nss_pin=25, **options)

    found: dict[str, Any] = {
        "spidev": {
            "names": dir(spidev.SpiDev),
            "no bus": error_of(lambda: spidev.SpiDev().open(7, 7)),
            "not open": error_of(lambda: spidev.SpiDev().xfer2([0x42, 0])),
            "open_hal": error_of(lambda: hal.open_hal(wiring(spi_bus=7, spi_device=7))),
        },
        "rpi": {
            "open": error_of(lambda: hal._RpiGpioHal(wiring(backend="rpi-gpio"), bus)),
            "cwd": str(Path.cwd()),
        },
    }
    if backend == "rpi-lgpio":
        from RPi import GPIO  # noqa: PLC0415 (tsgt has imported it in another folder)

        found["rpi"]["names"] = dir(GPIO)
        found["rpi"]["parameters"] = {
            name: list(inspect.signature(getattr(GPIO, name)).parameters)
            for name in ("setup", "output", "input", "add_event_detect", "remove_event_detect", "cleanup")
        }
        found["gpiod"] = gpiod_package()
        found["gpiod"]["open"] = {
            path: error_of(partial(hal._GpiodHal, wiring(gpio_chip=path), bus))
            for path in ("/dev/gpiochip77", "/dev/null")
        }
    print(json.dumps(found))  # noqa: T201 (the result)


if __name__ == "__main__":
    main(*sys.argv[1:])
