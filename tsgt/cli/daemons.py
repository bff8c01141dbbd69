"""Entry points of the daemons, which wait for the radio link: until then they say so, and the master checks."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import click

from tsgt.cli.main import HELP_OPTIONS, run
from tsgt.errors import TsgtError

_config_option = click.option(
    "--config", "config_path", type=click.Path(path_type=Path), required=True, help="Configuration, TOML."
)


@click.command("tsgt-client", context_settings=HELP_OPTIONS)
@_config_option
def client(config_path: Path) -> None:
    """Read the total station beside this computer and answer the master over the radio (not in this release)."""
    raise TsgtError(
        f"{config_path}: this release has no instrument driver and no radio link, so there is no station client "
        "to start; see CHANGELOG.md"
    )


@click.command("tsgt-master", context_settings=HELP_OPTIONS)
@_config_option
def master(config_path: Path) -> None:
    """Collect the stations' measurements over the radio and stream poses (in this release: only check its file)."""
    # Only here, as `--help` needs none of it.
    from tsgt.config import MasterConfig, load, parameters  # noqa: PLC0415
    from tsgt.master.pipeline import Pipeline  # noqa: PLC0415

    Pipeline(parameters(load(config_path, MasterConfig)))
    raise TsgtError(
        f"{config_path}: the configuration is good, but this release has no radio link to collect from; "
        "`tsgt demo` and `tsgt replay` run the same pipeline and stream"
    )


def main_client() -> NoReturn:
    """Entry point of the script ``tsgt-client``."""
    run(client)


def main_master() -> NoReturn:
    """Entry point of the script ``tsgt-master``."""
    run(master)
