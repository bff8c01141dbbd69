"""The command group ``radio``, with the commands ``airtime`` and ``key``."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from tsgt.cli.options import json_option, path_type
from tsgt.cli.output import print_json
from tsgt.cli.radio.options import Modem, modem_options
from tsgt.cli.radio.ping import ping_command
from tsgt.cli.radio.plan import plan_command
from tsgt.radio import (
    MAX_PAYLOAD_BYTES,
    SYNC_QUARTER_SYMBOLS,
    airtime_us,
    bit_rate_Bps,
    low_data_rate_required,
    payload_symbols,
)
from tsgt.radio.key_file import write_key

if TYPE_CHECKING:
    from pathlib import Path


@click.group()
def radio() -> None:
    """Plan and test the radio channel."""


radio.add_command(ping_command, "ping")
radio.add_command(plan_command, "plan")


@radio.command("key")
@click.argument("file", type=path_type)
def key_command(file: Path) -> None:
    """Make the key of a mission.

    Writes a random key to FILE, readable by its owner only; an existing file is never overwritten. All radios of a
    mission with the protocol superframe share one key. With it, master and stations reject packets of others and
    replayed packets.
    """
    write_key(file)
    click.echo(f"""{file}: a new key for all radios of one mission. Anybody who has it can take part: keep it secret.

On each machine of the mission, for the daemon's user:
  sudo install -o tsgt -g tsgt -m 600 {shlex.quote(file.name)} /etc/tsgt/radio.key
In the configuration of each daemon, under [protocol]:
  kind = "superframe"
  key_file = "radio.key"
`tsgt status` shows for each daemon whether it has a key.""")


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
    """Compute the time on air of a packet.

    By the formula of the SX1276 data sheet, section 4.1.1.7, with explicit header, CRC, and low data rate optimisation
    if a symbol is longer than 16 ms. The bit rate is that of the payload alone.
    """
    low_data_rate = low_data_rate_required(modem.spreading_factor, modem.bandwidth_hz)
    airtime_ms = airtime_us(payload_bytes, **asdict(modem)) / 1000
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
