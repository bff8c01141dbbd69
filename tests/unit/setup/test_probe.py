"""The radio is found behind the real backends, with each of its wirings."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.hardware.pi import FakePi
from harness.hardware.radios import PAPER, running_timeline

from tsgt.errors import RadioError
from tsgt.radio.sx127x import hal, open_hal
from tsgt.setup import WiringSearch, find_radio
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.lora import Air, LinkModel, SX1276Chip

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def pi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakePi:
    """Make a Pi with all its packages."""
    made = FakePi(tmp_path, nss_pin=None)
    monkeypatch.setattr(hal, "_DEV", tmp_path)
    for name, module in (("spidev", made.spidev()), ("gpiod", made.gpiod()), ("RPi", made.rpi())):
        monkeypatch.setitem(sys.modules, name, module)
    return made


def solder(pi: FakePi, nss_pin: int | None, dio0_pin: int = 4) -> None:
    """Connect a chip; its chip select to a pin, or to the SPI controller."""
    timeline = running_timeline()
    air = Air(timeline, np.random.default_rng(0), LinkModel())
    chip = SX1276Chip(timeline, lambda antenna: air.join(antenna, "here"), np.random.default_rng(1))

    def answer(data: bytes) -> bytes:
        selected = not pi.levels.get(nss_pin, True) if nss_pin is not None else not pi.bus_settings["no_cs"]
        return chip.transfer(data) if selected else bytes(len(data))

    def raised(_at_ns: int, level: bool) -> None:  # noqa: FBT001 (a level)
        if dio0_pin in pi.levels:
            pi.levels[dio0_pin] = level

    chip.on_dio(0, raised)
    pi.answer = answer
    pi.on_drive = lambda pin, level: chip.set_reset(not level) if pin == 17 else None


@pytest.mark.parametrize(("soldered", "found"), [(25, 25), (None, -1)])
async def test_chip_select_is_found(pi: FakePi, soldered: int | None, found: int) -> None:
    """On the HAT's pin, or by the SPI controller; bus and pins are released."""
    solder(pi, soldered)
    wiring = await find_radio(WiringSearch().wirings(["spidev0.0"]), open_hal, PAPER, VirtualClock(0))
    assert (wiring.backend, wiring.nss_pin) == ("gpiod", found)
    assert pi.open_things == 0


async def test_pin_of_dio0_is_found(pi: FakePi) -> None:
    """A bare module is not wired as the HAT."""
    solder(pi, None, dio0_pin=22)
    wiring = await find_radio(WiringSearch().wirings(["spidev0.0"]), open_hal, PAPER, VirtualClock(0))
    assert (wiring.nss_pin, wiring.dio0_pin) == (-1, 22)


async def test_unconnected_dio0_is_an_error(pi: FakePi) -> None:
    """Without its edges all packets would be read late."""
    solder(pi, None, dio0_pin=27)
    with pytest.raises(RadioError, match="its DIO0 is not on BCM 4 or 22: give its pin as --dio0-pin"):
        await find_radio(WiringSearch().wirings(["spidev0.0"]), open_hal, PAPER, VirtualClock(0))
    assert pi.open_things == 0


async def test_rpi_gpio_serves_without_gpiod(pi: FakePi, monkeypatch: pytest.MonkeyPatch) -> None:
    """On an older system."""
    solder(pi, 25)
    monkeypatch.delattr(sys.modules["gpiod"], "request_lines")
    wiring = await find_radio(WiringSearch().wirings(["spidev0.0"]), open_hal, PAPER, VirtualClock(0))
    assert wiring.backend == "rpi-gpio"


async def test_each_reason_is_told_once(pi: FakePi) -> None:
    """Without a chip: where it was looked for, and what came back."""
    pi.answer = lambda data: bytes(len(data))
    with pytest.raises(RadioError) as caught:
        await find_radio(WiringSearch().wirings(["spidev0.0"]), open_hal, PAPER, VirtualClock(0))
    assert "gpiod, spidev0.0, chip select on BCM 25: " in str(caught.value)
    assert pi.open_things == 0
