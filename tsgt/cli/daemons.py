"""Entry points of the daemons: each puts its parts together as its configuration says, and runs them."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import click

from tsgt.cli.main import HELP_OPTIONS, run

_config_option = click.option(
    "--config", "config_path", type=click.Path(path_type=Path), required=True, help="Configuration, TOML."
)


@click.command("tsgt-client", context_settings=HELP_OPTIONS)
@_config_option
def client(config_path: Path) -> None:
    """Read the total station beside this computer, journal it, and answer the master over the radio.

    Runs until SIGTERM or Ctrl-C. Instrument, radio and disk may fail and come back meanwhile.
    """
    # Only here, as `--help` needs none of it.
    from tsgt import service
    from tsgt.cli.composition import make_instrument, radio_key, radio_opener
    from tsgt.clock import SystemClock, boot_id
    from tsgt.config import (
        ClientConfig,
        check_trust,
        load,
    )
    from tsgt.radio.from_config import lora_settings
    from tsgt.station import run_client

    check_trust(config_path)
    config = load(config_path, ClientConfig)
    clock = SystemClock()
    settings = lora_settings(config.radio, config_path)
    key = radio_key(config.protocol)
    open_radio = radio_opener(config.radio, settings, clock)
    instrument = make_instrument(config.instrument, clock)
    boot = boot_id()
    service.run(
        lambda: run_client(
            config, settings, instrument=instrument, open_radio=open_radio, clock=clock, key=key, boot=boot
        )
    )


@click.command("tsgt-master", context_settings=HELP_OPTIONS)
@_config_option
def master(config_path: Path) -> None:
    """Collect the stations' measurements over the radio, and stream and record poses.

    Runs until SIGTERM or Ctrl-C. Stations, radio and disk may fail and come back meanwhile.
    """
    # Only here, as `--help` needs none of it.
    from tsgt import service
    from tsgt.cli.composition import radio_key, radio_opener
    from tsgt.clock import SystemClock
    from tsgt.config import (
        MasterConfig,
        check_trust,
        load,
        parameters,
    )
    from tsgt.master import run_master
    from tsgt.radio.from_config import lora_settings

    check_trust(config_path)
    config = load(config_path, MasterConfig)
    check_trust(config.setup.station_frames)
    check_trust(config.setup.prism_layout)
    in_force = parameters(config)
    settings = lora_settings(config.radio, config_path)
    key = radio_key(config.protocol)
    clock = SystemClock()
    open_radio = radio_opener(config.radio, settings, clock)
    service.run(lambda: run_master(config, in_force, settings, open_radio=open_radio, clock=clock, key=key))


def main_client() -> NoReturn:
    """Entry point of the script ``tsgt-client``."""
    run(client)


def main_master() -> NoReturn:
    """Entry point of the script ``tsgt-master``."""
    run(master)
