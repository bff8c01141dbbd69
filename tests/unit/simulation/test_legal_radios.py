"""Configurations that the simulation writes for real daemons obey the law of the region that they name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.config import ClientConfig, MasterConfig, ScenarioConfig, load
from tsgt.radio.legality import legality
from tsgt.simulation.demo import write_demo_files
from tsgt.simulation.rehearsal import SCENARIO
from tsgt.simulation.rehearsal.scenario import REGION

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(("scenario", "region"), [(SCENARIO, REGION), (ScenarioConfig(), None)])
def test_written_configurations_are_legal(
    tmp_path: Path, scenario: ScenarioConfig, region: str | None
) -> None:
    """The rehearsal names a region, as a configuration for outside has to; the demonstration transmits nothing."""
    files = write_demo_files(tmp_path, scenario, tmp_path / "poses.sock", region=region)
    configs: list[ClientConfig | MasterConfig] = [load(files.master_config, MasterConfig)]
    configs += [load(files.client_config(number), ClientConfig) for number in files.stations]
    for config in configs:
        assert config.radio.region == region
        found = legality(config, files.master_config)
        assert (found.violations, found.warning) == ((), None)
