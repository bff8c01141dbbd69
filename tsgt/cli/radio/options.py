"""Options of the radio commands, made from the configuration of modem and wiring."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from tsgt.cli.model_options import add_options, model_option
from tsgt.config import ModemConfig, WiringConfig
from tsgt.radio import BANDWIDTHS_HZ
from tsgt.radio.from_config import wiring as wiring_of

if TYPE_CHECKING:
    from collections.abc import Callable

_BANDWIDTHS_HZ = {bandwidth_hz / 1000: bandwidth_hz for bandwidth_hz in BANDWIDTHS_HZ}


@dataclass(frozen=True, slots=True, kw_only=True)
class Modem:
    """Modulation; fields as in :class:`~tsgt.radio.base.LoRaSettings`."""

    spreading_factor: int
    bandwidth_hz: int
    coding_rate: int
    preamble_symbols: int


def modem_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of the modulation; the command receives them as ``modem``."""

    @functools.wraps(command)
    def with_modem(*, bandwidth_khz: int, **given: Any) -> Any:
        fields = {name: given.pop(name) for name in ("spreading_factor", "coding_rate", "preamble_symbols")}
        return command(modem=Modem(bandwidth_hz=bandwidth_khz, **fields), **given)

    return add_options(
        model_option(ModemConfig, "spreading_factor", "--sf", default=9, help="Spreading factor."),
        model_option(ModemConfig, "bandwidth_khz", type=float, callback=_bandwidth_hz),
        model_option(ModemConfig, "coding_rate"),
        model_option(ModemConfig, "preamble_symbols", "--preamble"),
    )(with_modem)


def wiring_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of the wiring; the command receives them as ``wiring``."""
    fields = tuple(WiringConfig.model_fields)

    @functools.wraps(command)
    def with_wiring(**given: Any) -> Any:
        config = WiringConfig(**{name: given.pop(name) for name in fields})
        return command(wiring=wiring_of(config), **given)

    return add_options(*(model_option(WiringConfig, name) for name in fields))(with_wiring)


def _bandwidth_hz(_context: click.Context, _parameter: click.Parameter, value: float) -> int:
    if value not in _BANDWIDTHS_HZ:
        raise click.BadParameter(
            f"{value:g} is not one of {', '.join(f'{khz:g}' for khz in _BANDWIDTHS_HZ)}."
        )
    return _BANDWIDTHS_HZ[value]
