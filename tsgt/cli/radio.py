"""The command group ``radio``: what a channel carries, a bench test of two radios, the key of a mission."""

from __future__ import annotations

import click

from tsgt.cli.options import json_option
from tsgt.cli.output import print_json
from tsgt.cli.radio_key import key_command
from tsgt.cli.radio_options import Modem, modem_options
from tsgt.cli.radio_ping import ping_command
from tsgt.cli.radio_plan import plan_command
from tsgt.radio.airtime import (
    SYNC_QUARTER_SYMBOLS,
    airtime_us,
    bit_rate_Bps,
    low_data_rate_required,
    payload_symbols,
)
from tsgt.radio.base import MAX_PAYLOAD_BYTES


@click.group()
def radio() -> None:
    """LoRa radios: time on air, what a channel carries, a bench test of two, a key."""


radio.add_command(ping_command, "ping")
radio.add_command(plan_command, "plan")
radio.add_command(key_command, "key")


@radio.command()
@modem_options
@click.option(
    "--payload",
    "payload_bytes",
    type=click.IntRange(1, MAX_PAYLOAD_BYTES),
    required=True,
    help="Length of the payload in bytes.",
)
@json_option
def airtime(*, modem: Modem, payload_bytes: int, as_json: bool) -> None:
    """Compute how long a packet is on the air, by the data sheet of the SX1276.

    Explicit header, CRC, and low data rate optimisation where a symbol lasts longer than 16 ms. The bit rate is that
    of the payload alone.
    """
    low_data_rate = low_data_rate_required(modem.spreading_factor, modem.bandwidth_hz)
    airtime_ms = (
        airtime_us(
            payload_bytes,
            spreading_factor=modem.spreading_factor,
            bandwidth_hz=modem.bandwidth_hz,
            coding_rate=modem.coding_rate,
            preamble_symbols=modem.preamble_symbols,
        )
        / 1000
    )
    after_preamble = payload_symbols(
        payload_bytes,
        spreading_factor=modem.spreading_factor,
        coding_rate=modem.coding_rate,
        low_data_rate=low_data_rate,
    )
    symbols = modem.preamble_symbols + SYNC_QUARTER_SYMBOLS / 4 + after_preamble
    rate_Bps = bit_rate_Bps(modem.spreading_factor, modem.bandwidth_hz, modem.coding_rate)
    if as_json:
        print_json(
            {
                "airtime_ms": airtime_ms,
                "symbols": symbols,
                "payload_symbols": after_preamble,
                "low_data_rate": low_data_rate,
                "bit_rate_Bps": rate_Bps,
            }
        )
        return
    click.echo(f"time on air  {airtime_ms:.3f} ms")
    click.echo(f"symbols      {symbols:g}, of which {after_preamble} for header, payload and CRC")
    optimisation = "on" if low_data_rate else "off"
    click.echo(f"bit rate     {rate_Bps:.1f} B/s, low data rate optimisation {optimisation}")
