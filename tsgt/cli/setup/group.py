"""The command group ``setup``: a station, the master, and the text that takes a mission from the master to its stations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tsgt.cli.model_options import add_options
from tsgt.cli.options import FiniteRange, json_option, path_type
from tsgt.cli.output import print_json
from tsgt.cli.setup.master import run_master_setup
from tsgt.cli.setup.mission import mission_of_master, show_mission
from tsgt.cli.setup.options import Common, SpiDevice
from tsgt.cli.setup.session import this_system
from tsgt.cli.setup.station import PRISM_TYPES, run_station_setup
from tsgt.radio.planning import REGIONS
from tsgt.setup import WiringSearch, encode_mission

if TYPE_CHECKING:
    from collections.abc import Callable

_root_option = click.option(
    "--root",
    type=path_type,
    default=Path("/"),
    help="Root file system to set up: this machine, or the folder of an SD card or image.",
)


@click.group()
def setup() -> None:
    """Set up this machine as a station or as the master.

    `station` and `master` enable SPI, make the user of the services, find the radio, write key and configuration, start the
    service and check everything. What is right already is left alone, so that they can be called again at any time. An
    edited configuration is kept unless --replace-config is given.
    """


def _common(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that both machines have; the command receives them as ``common``."""

    def with_common(**values: Any) -> Any:
        names = ("backend", "spi_device", "nss_pin", "reset_pin", "dio0_pin", "gpio_chip")
        search = WiringSearch(**{name: values.pop(name) for name in names})
        kept = (
            "root",
            "yes",
            "dry_run",
            "as_json",
            "antenna_gain_dbi",
            "licence",
            "replace_config",
            "replace_key",
        )
        return command(Common(search=search, **{name: values.pop(name) for name in kept}), **values)

    with_common.__doc__ = command.__doc__
    with_common.__name__ = command.__name__
    return add_options(
        click.option(
            "--antenna-gain-dbi",
            type=FiniteRange(-40, 40),
            help="Gain of the antenna, less the loss of its cable; the power follows from it.  [default: 2.15, a dipole]",
        ),
        click.option(
            "--licence",
            metavar="TEXT",
            help="Number or text of a radio licence, which lifts the limits of the region.",
        ),
        click.option(
            "--backend",
            type=click.Choice(["gpiod", "rpi-gpio"]),
            help="Access to the pins.  [default: found]",
        ),
        click.option(
            "--spi-device",
            type=SpiDevice(),
            metavar="spidevB.D",
            help="SPI device of the radio.  [default: found]",
        ),
        click.option(
            "--nss-pin",
            type=click.IntRange(-1, 1000),
            help="Chip select, BCM number; -1: by the kernel.  [default: found]",
        ),
        click.option(
            "--reset-pin",
            type=click.IntRange(0, 1000),
            help="Pin NRESET of the radio, BCM number.  [default: that of before, or 17]",
        ),
        click.option(
            "--dio0-pin",
            type=click.IntRange(0, 1000),
            help="Pin DIO0 of the radio, BCM number.  [default: found]",
        ),
        click.option("--gpio-chip", metavar="PATH", help="GPIO device.  [default: found by its label]"),
        click.option(
            "--replace-config",
            is_flag=True,
            help="Replace an edited configuration; the old one is kept beside it.",
        ),
        click.option(
            "--replace-key",
            is_flag=True,
            help="Replace the key of another mission; on the master: make a new key, which all stations then need.",
        ),
        _root_option,
        click.option(
            "--yes", is_flag=True, help="Do not ask; options that are not given take their defaults."
        ),
        click.option("--dry-run", is_flag=True, help="Print what would be changed, and change nothing."),
        json_option,
    )(with_common)


@setup.command()
@click.option("--station", type=click.IntRange(1, 16), help="Number of the station, written on its tripod.")
@click.option(
    "--prism",
    type=click.IntRange(1, 16),
    help="Number of the prism that it tracks.  [default: that of the station]",
)
@click.option(
    "--mission",
    metavar="FILE|TEXT",
    help="Channel and key of the mission, as `tsgt setup master` shows them; a file or the text.",
)
@click.option(
    "--instrument",
    metavar="PORT|none",
    help="Serial port of the instrument, or tcp://HOST:PORT; none: not there yet.  [default: found]",
)
@click.option("--prism-type", type=click.Choice(PRISM_TYPES), help="Reflector on the robot.")
@_common
def station(
    common: Common,
    station: int | None,
    prism: int | None,
    mission: str | None,
    instrument: str | None,
    prism_type: str | None,
) -> int:
    """Set up this machine as a station, beside a total station.

    Asks for what no option gives; with --yes, or without a terminal, --station, --mission and --prism-type are needed the
    first time. Asking the radio and the instrument transmits nothing and moves nothing.

    Exit code 3: a step failed; its line says what to do. --json prints "ok", "changed" and, under "steps", "ok", "detail"
    and "changed" of each step.
    """
    return run_station_setup(
        common, station=station, prism=prism, mission=mission, instrument=instrument, prism_type=prism_type
    )


@setup.command()
@click.option("--region", type=click.Choice(list(REGIONS)), help="Region whose law applies.")
@click.option("--stations", type=click.IntRange(1, 16), help="Number of stations.")
@_common
def master(common: Common, region: str | None, stations: int | None) -> int:
    """Set up this machine as the master, on the robot.

    Makes the key of a new mission, and shows the text that each station needs. Asks for what no option gives; with --yes,
    or without a terminal, --region and --stations are needed the first time.

    Exit code 3: a step failed; its line says what to do. --json prints "ok", "changed" and, under "steps", "ok", "detail"
    and "changed" of each step.
    """
    return run_master_setup(common, region=region, stations=stations)


@setup.command("mission")
@_root_option
@json_option
def mission_command(root: Path, *, as_json: bool) -> None:
    """Show the channel and key of this master's mission for its stations.

    The text is secret: anybody who has it can take part in the mission.
    """
    mission = mission_of_master(this_system(root))
    if as_json:
        print_json({"mission": encode_mission(mission)})
        return
    show_mission(mission)
