"""Configurations of the daemons in a mission."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.config import ClassicMasterConfig, SuperframeMasterConfig
from tsgt.simulation.mission.daemon_configs import client_config
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("protocol", "other_protocol", "expected"),
    [
        (ClassicMasterConfig(kind="classic"), False, "classic"),
        (ClassicMasterConfig(kind="classic"), True, "superframe"),
        (SuperframeMasterConfig(kind="superframe"), False, "superframe"),
        (SuperframeMasterConfig(kind="superframe"), True, "classic"),
    ],
)
def test_client_of_the_other_protocol_does_not_speak_the_missions(
    tmp_path: Path,
    protocol: ClassicMasterConfig | SuperframeMasterConfig,
    expected: str,
    *,
    other_protocol: bool,
) -> None:
    """What it measures is delivered by nobody, whichever protocol the mission has."""
    scenario, options = (
        find_scenario("dynamic"),
        SimulationOptions(duration_s=10.0, seed=1, protocol=protocol),
    )
    config = client_config(scenario, scenario.stations[0], options, tmp_path, other_protocol=other_protocol)
    assert config.protocol.kind == expected
