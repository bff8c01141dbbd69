"""The configuration files of a demo are complete and match the scenario."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.cli.composition import radio_key
from tsgt.config import (
    ClientConfig,
    LeicaInstrumentConfig,
    MasterConfig,
    ReferencePointConfig,
    ScenarioConfig,
    load,
    parameters,
    scenario_parameters,
)
from tsgt.simulation.demo import write_demo_files

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.demo.config_files import Protocol


def test_master_setup_equals_the_scenario(tmp_path: Path) -> None:
    """The parameters read from the files are those of the scenario."""
    lidar = ReferencePointConfig(
        name="lidar", position_m=(0.1, 0.2, 1.3), orientation_xyzw=(0.0, 0.6, 0.0, 0.8)
    )
    scenario = ScenarioConfig(reference_point=lidar)
    files = write_demo_files(tmp_path, scenario, tmp_path / "poses.sock")
    assert parameters(load(files.master_config, MasterConfig)) == scenario_parameters(scenario)


@pytest.mark.parametrize("protocol", ["superframe", "classic"])
@pytest.mark.parametrize("station", [1, 2, 3])
def test_clients_match_the_master(tmp_path: Path, station: int, protocol: Protocol) -> None:
    """Each client has its own instrument and journal, and the master's modem settings and protocol."""
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
