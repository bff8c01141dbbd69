"""Looks for the radio with each wiring, and for instruments at each serial port, by asking them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from tsgt.config import WiringConfig
from tsgt.errors import InstrumentError, RadioError, RadioNotFoundError
from tsgt.radio.from_config import wiring
from tsgt.radio.sx127x import Chip

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from tsgt.clock import Clock
    from tsgt.config import TcpAddress
    from tsgt.radio import LoRaSettings
    from tsgt.radio.sx127x import Hal, Wiring
    from tsgt.station.serial import OpenPort

Backend = Literal["gpiod", "rpi-gpio"]

DEFAULT_BAUD: Final = 115_200
BACKENDS: Final[tuple[Backend, ...]] = ("gpiod", "rpi-gpio")
HAT_NSS_PIN: Final = 25
HAT_RESET_PIN: Final = 17
KERNEL_NSS: Final = -1
DIO0_PINS: Final = (4, 22)  # of the HAT, and of a bare module wired as docs/how-to/wire-the-radio.md says


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundInstrument:
    """An instrument that responds at a serial port."""

    port: Path | TcpAddress
    baud: int | None
    model: str
    serial_number: str

    def __str__(self) -> str:
        number = f", number {self.serial_number}" if self.serial_number else ""
        rate = f", at {self.baud} baud" if self.baud is not None else ""
        return f"{self.model or 'an instrument without a name'}{number}{rate}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Ports:
    """Access to ports: how to open one, and the process that has a serial one open, or None."""

    open_port: Callable[[Path | TcpAddress], OpenPort]
    holder: Callable[[Path], str | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class WiringSearch:
    """Wirings to try, by what was asked for; None: what a radio may be wired to, with the reset pin of the Dragino HAT."""

    backend: Backend | None = None
    spi_device: str | None = None
    nss_pin: int | None = None
    reset_pin: int | None = None
    dio0_pin: int | None = None
    gpio_chip: str | None = None

    def wirings(self, devices: Sequence[str]) -> Iterator[WiringConfig]:
        """Yield each wiring in turn; ``devices``: names such as ``spidev0.0``.

        Chip select on the HAT's pin first: a HAT whose pin happens to be low would also respond to the kernel's.
        """
        backends = BACKENDS if self.backend is None else (self.backend,)
        nss_pins = (HAT_NSS_PIN, KERNEL_NSS) if self.nss_pin is None else (self.nss_pin,)
        dio0_pins = DIO0_PINS if self.dio0_pin is None else (self.dio0_pin,)
        used = devices if self.spi_device is None else (self.spi_device,)
        for backend, nss_pin, device, dio0_pin in product(backends, nss_pins, used, dio0_pins):
            bus, select = _bus_and_select(device)
            yield WiringConfig(
                backend=backend,
                spi_bus=bus,
                spi_device=select,
                reset_pin=HAT_RESET_PIN if self.reset_pin is None else self.reset_pin,
                dio0_pin=dio0_pin,
                nss_pin=nss_pin,
                gpio_chip=self.gpio_chip if backend == "gpiod" else None,
            )

    def applied_to(self, before: WiringConfig) -> WiringConfig:
        """Return the wiring of a configuration with what was asked for."""
        names = ("backend", "nss_pin", "reset_pin", "dio0_pin", "gpio_chip")
        asked = {name: value for name in names if (value := getattr(self, name)) is not None}
        if self.spi_device is not None:
            asked["spi_bus"], asked["spi_device"] = _bus_and_select(self.spi_device)
        if asked.get("backend", before.backend) != "gpiod":
            asked["gpio_chip"] = None
        return before.model_copy(update=asked)

    def completed_from(self, before: WiringConfig) -> WiringSearch:
        """Return the search with what no radio tells, where it was not asked for, from the wiring of a configuration."""
        applied = self.applied_to(before)
        return replace(self, reset_pin=applied.reset_pin, gpio_chip=applied.gpio_chip)


def _bus_and_select(device: str) -> tuple[int, int]:
    bus, _, select = device.removeprefix("spidev").partition(".")
    return int(bus), int(select)


async def find_radio(
    wirings: Iterable[WiringConfig],
    open_hal: Callable[[Wiring], Hal],
    settings: LoRaSettings,
    clock: Clock,
) -> WiringConfig:
    """Return the first wiring with which a radio responds, accepts all settings and drives DIO0; nothing is transmitted.

    Raises RadioError if there is none: with the reason for each wiring, or the pins that are not DIO0.
    """
    reasons: dict[str, str] = {}
    not_dio0: dict[int, None] = {}
    for candidate in wirings:
        try:
            connected = await _ask_radio(open_hal(wiring(candidate)), settings, clock)
        except RadioError as error:
            reasons.setdefault(str(error), _wiring_text(candidate))
            continue
        if connected:
            return candidate
        not_dio0[candidate.dio0_pin] = None
    if not_dio0:
        pins = " or ".join(map(str, not_dio0))
        raise RadioError(f"the radio responds, but its DIO0 is not on BCM {pins}: give its pin as --dio0-pin")
    if not reasons:
        raise RadioNotFoundError("there is no SPI device /dev/spidev*")
    told = "; ".join(f"{where}: {reason}" for reason, where in reasons.items())
    raise RadioError(f"no radio responds: {told}. Check that the board sits on all pins")


async def _ask_radio(hal: Hal, settings: LoRaSettings, clock: Clock) -> bool:
    """Return whether DIO0 is connected."""
    try:
        chip = Chip(hal, clock, settings)
        await chip.set_up()
        connected = await chip.dio0_connected()
        chip.sleep()
        return connected
    finally:
        hal.close()


def _wiring_text(candidate: WiringConfig) -> str:
    select = "by the kernel" if candidate.nss_pin < 0 else f"on BCM {candidate.nss_pin}"
    return f"{candidate.backend}, spidev{candidate.spi_bus}.{candidate.spi_device}, chip select {select}"


async def find_instruments(
    ports: Sequence[Path | TcpAddress], access: Ports, clock: Clock
) -> tuple[list[FoundInstrument], dict[Path | TcpAddress, str]]:
    """Ask for an instrument at each port, at all common baud rates, which takes ten seconds for a silent port.

    Returns the instruments, and for every other port why there is none.
    """
    # Imported here: a master needs none of it.
    from tsgt.station.geocom import connect  # noqa: PLC0415
    from tsgt.station.leica import identify  # noqa: PLC0415

    found: list[FoundInstrument] = []
    silent: dict[Path | TcpAddress, str] = {}
    for port in ports:
        if isinstance(port, Path) and (holder := access.holder(port)) is not None:
            silent[port] = f"it is open in {holder}"
            continue
        try:
            connection = await connect(access.open_port(port), DEFAULT_BAUD, clock, checksum=False)
        except InstrumentError as error:
            silent[port] = str(error)
            continue
        try:
            identity = await identify(connection)
        except InstrumentError as error:
            silent[port] = str(error)
        else:
            found.append(
                FoundInstrument(
                    port=port,
                    baud=connection.port.baud,
                    model=identity.model,
                    serial_number=identity.serial_number,
                )
            )
        finally:
            await connection.close()
    return found, silent
