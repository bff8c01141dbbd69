"""The command group ``radio``: what a channel carries, a bench test of two radios, the key of a mission.

The command ``radio key``: makes the key that all radios of a mission share.
"""

from __future__ import annotations

from pathlib import Path

import click

from tsgt.cli.options import json_option
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


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
def key_command(file: Path) -> None:
    """Make a random key and write it to FILE, which nobody but its owner may read.

    All radios of a mission that speak the superframe share one key. With it, master and stations take only each
    other's packets, and none that was recorded and played back. An existing file is never overwritten.
    """
    write_key(file)
    click.echo(f"""{file}: a new key, for all radios of one mission. Whoever has it can take part: keep it secret.

On each machine of the mission, for the daemon's user:
  sudo install -o tsgt -g tsgt -m 600 {file.name} /etc/tsgt/radio.key
In the configuration of each daemon, under [protocol]:
  kind = "superframe"
  key_file = "radio.key"
`tsgt status` says of each daemon whether it has one.""")


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
