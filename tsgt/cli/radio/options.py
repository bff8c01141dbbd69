"""Options of the commands on radios: how a packet is modulated, and how the radio is wired."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from tsgt.radio import BANDWIDTHS_HZ
from tsgt.radio.sx127x import DRAGINO_HAT, Wiring

if TYPE_CHECKING:
    from collections.abc import Callable

_BANDWIDTHS_HZ = {bandwidth_hz / 1000: bandwidth_hz for bandwidth_hz in BANDWIDTHS_HZ}


@dataclass(frozen=True, slots=True, kw_only=True)
class Modem:
    """What the options of :func:`modem_options` say; fields as in :class:`~tsgt.radio.base.LoRaSettings`."""

    spreading_factor: int
    bandwidth_hz: int
    coding_rate: int
    preamble_symbols: int


def modem_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that say how a packet is modulated; the command gets them as ``modem``."""

    @functools.wraps(command)
    def with_modem(
        *args: Any, sf: int, bandwidth_khz: int, coding_rate: int, preamble: int, **kwargs: Any
    ) -> Any:
        modem = Modem(
            spreading_factor=sf,
            bandwidth_hz=bandwidth_khz,
            coding_rate=coding_rate,
            preamble_symbols=preamble,
        )
        return command(*args, modem=modem, **kwargs)

    return _with_options(
        with_modem,
        click.option(
            "--sf", type=click.IntRange(7, 12), default=9, show_default=True, help="Spreading factor."
        ),
        click.option(
            "--bandwidth-khz",
            type=float,
            callback=_in_hertz,
            default=250.0,
            show_default=True,
            help="Bandwidth.",
        ),
        click.option(
            "--coding-rate",
            type=click.IntRange(5, 8),
            default=6,
            show_default=True,
            help="Denominator of the coding rate: 6 for 4/6.",
        ),
        click.option(
            "--preamble",
            type=click.IntRange(6, 65_535),
            default=8,
            show_default=True,
            help="Preamble in symbols as programmed; 4.25 more are sent.",
        ),
    )


def wiring_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that say how the radio is wired; the command gets them as ``wiring``."""

    @functools.wraps(command)
    def with_wiring(
        *args: Any,
        backend: Any,
        spi_bus: int,
        spi_device: int,
        spi_hz: int,
        reset_pin: int,
        dio0_pin: int,
        nss_pin: int,
        gpio_chip: str | None,
        **kwargs: Any,
    ) -> Any:
        wiring = Wiring(
            backend=backend,
            spi_bus=spi_bus,
            spi_device=spi_device,
            spi_hz=spi_hz,
            reset_pin=reset_pin,
            dio0_pin=dio0_pin,
            nss_pin=None if nss_pin < 0 else nss_pin,
            gpio_chip=gpio_chip,
        )
        return command(*args, wiring=wiring, **kwargs)

    pin = click.IntRange(min=0)
    return _with_options(
        with_wiring,
        click.option(
            "--backend",
            type=click.Choice(["gpiod", "rpi-gpio"]),
            default=DRAGINO_HAT.backend,
            show_default=True,
            help="Access to the pins; gpiod stamps edges in the kernel.",
        ),
        click.option("--spi-bus", type=pin, default=0, show_default=True, help="B of /dev/spidevB.D."),
        click.option("--spi-device", type=pin, default=0, show_default=True, help="D of /dev/spidevB.D."),
        click.option(
            "--spi-hz",
            type=click.IntRange(1, 10_000_000),
            default=DRAGINO_HAT.spi_hz,
            show_default=True,
            help="Clock of the bus; lower for long wires.",
        ),
        click.option(
            "--reset-pin",
            type=pin,
            default=DRAGINO_HAT.reset_pin,
            show_default=True,
            help="NRESET, BCM number; the defaults are the Dragino HAT's.",
        ),
        click.option(
            "--dio0-pin", type=pin, default=DRAGINO_HAT.dio0_pin, show_default=True, help="DIO0, BCM number."
        ),
        click.option(
            "--nss-pin",
            type=click.IntRange(min=-1),
            default=DRAGINO_HAT.nss_pin,
            show_default=True,
            help="Chip select, BCM number; -1 leaves it to the SPI driver of the kernel.",
        ),
        click.option("--gpio-chip", help="As /dev/gpiochip0; gpiod only.  [default: found by its label]"),
    )


def _with_options(
    command: Callable[..., Any], *options: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> Callable[..., Any]:
    """Apply options so that the help shows them in the order given."""
    for option in reversed(options):
        command = option(command)
    return command


def _in_hertz(_context: click.Context, _parameter: click.Parameter, value: float) -> int:
    if value not in _BANDWIDTHS_HZ:
        raise click.BadParameter(
            f"{value:g} is not one of {', '.join(f'{khz:g}' for khz in _BANDWIDTHS_HZ)}."
        )
    return _BANDWIDTHS_HZ[value]
