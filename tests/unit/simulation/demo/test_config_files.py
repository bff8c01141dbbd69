"""The configuration files of a demo are whole, and say what the scenario says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.cli.composition import radio_key
from tsgt.config import (
    ClientConfig,
    LeicaInstrumentConfig,
    MasterConfig,
    ScenarioConfig,
    load,
    parameters,
    scenario_parameters,
)
from tsgt.simulation.demo import write_demo_files

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.demo.config_files import Protocol


def test_the_master_knows_exactly_the_set_up_of_the_scenario(tmp_path: Path) -> None:
    """What the master's files come to is what the scenario's parameters are."""
    files = write_demo_files(tmp_path, ScenarioConfig(), tmp_path / "poses.sock")
    assert parameters(load(files.master_config, MasterConfig)) == scenario_parameters(ScenarioConfig())


@pytest.mark.parametrize("protocol", ["superframe", "classic"])
@pytest.mark.parametrize("station", [1, 2, 3])
def test_each_client_finds_its_instrument_and_the_master_s_air(
    tmp_path: Path, station: int, protocol: Protocol
) -> None:
    """A client's file names its own instrument and journal, and the modem settings and protocol of the master."""
    files = write_demo_files(tmp_path, ScenarioConfig(), tmp_path / "poses.sock", protocol)
    client = load(files.client_config(station), ClientConfig)
    master = load(files.master_config, MasterConfig)
    assert client.station == station
    assert isinstance(client.instrument, LeicaInstrumentConfig)
    assert client.instrument.port == files.instrument_port(station)
    assert client.journal.directory == files.journals(station)
    names = {"name"}
    assert client.radio.model_dump(exclude=names) == master.radio.model_dump(exclude=names)
    assert client.protocol.kind == master.protocol.kind == protocol
    assert radio_key(client.protocol) == radio_key(master.protocol)
    assert (radio_key(master.protocol) is not None) == (protocol == "superframe")
