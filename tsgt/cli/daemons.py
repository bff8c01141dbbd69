"""Entry points of the daemons: build the parts that the configuration names, and run them."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, NoReturn

import click

from tsgt.cli.main import HELP_OPTIONS, run
from tsgt.cli.options import path_type

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.model import Parameters

_config_option = click.option(
    "--config", "config_path", type=path_type, required=True, help="Configuration (TOML)."
)


@click.command("tsgt-client", context_settings=HELP_OPTIONS)
@_config_option
def client(config_path: Path) -> None:
    """Read a total station, journal its measurements and send them to the master.

    Runs until SIGTERM or Ctrl-C. Failures of instrument, radio and disk are retried meanwhile.
    """
    # Imported here: `--help` needs none of it.
    from tsgt import service
    from tsgt.cli.composition import make_instrument, radio_key, radio_opener
    from tsgt.clock import SystemClock, boot_id
    from tsgt.config import ClientConfig, check_permissions, load
    from tsgt.radio.from_config import lora_settings
    from tsgt.radio.legality import check_legality
    from tsgt.station import ClientDependencies, run_client

    check_permissions(config_path)
    config = load(config_path, ClientConfig)
    clock = SystemClock()
    settings = lora_settings(config.radio, config_path)
    check_legality(config, config_path)
    key = radio_key(config.protocol)
    open_radio = radio_opener(config.radio, settings, clock)
    instrument = make_instrument(config.instrument, clock)
    dependencies = ClientDependencies(
        instrument=instrument, open_radio=open_radio, clock=clock, key=key, boot=boot_id()
    )
    service.run(lambda: run_client(config, settings, dependencies))


@click.command("tsgt-master", context_settings=HELP_OPTIONS)
@_config_option
def master(config_path: Path) -> None:
    """Collect the stations' measurements over the radio; stream and record poses.

    Runs until SIGTERM or Ctrl-C. Failures of stations, radio and disk are retried meanwhile. Before the first calibration,
    when set-up files are missing, it streams and records raw measurements without poses. SIGUSR1 (`systemctl reload
    tsgt-master`, or --apply of the calibrating commands) makes it read the set-up files again.
    """
    # Imported here: `--help` needs none of it.
    from tsgt import service
    from tsgt.cli.composition import radio_key, radio_opener
    from tsgt.clock import SystemClock
    from tsgt.config import MasterConfig, check_permissions, load, parameters_in_force
    from tsgt.master.daemon import MasterDependencies, run_through_suspensions
    from tsgt.master.reload import RELOAD_SIGNAL
    from tsgt.radio.from_config import lora_settings
    from tsgt.radio.legality import check_legality

    signal.signal(RELOAD_SIGNAL, signal.SIG_IGN)  # one that comes early must not kill
    check_permissions(config_path)
    config = load(config_path, MasterConfig)

    def read_setup() -> Parameters:
        for path in config.setup_files:
            check_permissions(path)
        return parameters_in_force(config)

    in_force = read_setup()
    settings = lora_settings(config.radio, config_path)
    check_legality(config, config_path)
    key = radio_key(config.protocol)
    clock = SystemClock()
    open_radio = radio_opener(config.radio, settings, clock)
    dependencies = MasterDependencies(open_radio=open_radio, clock=clock, key=key, read_setup=read_setup)
    service.run(lambda: run_through_suspensions(config, in_force, settings, dependencies))


def main_client() -> NoReturn:
    """Entry point of the script ``tsgt-client``."""
    run(client)


def main_master() -> NoReturn:
    """Entry point of the script ``tsgt-master``."""
    run(master)
