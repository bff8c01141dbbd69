"""Short simulated missions for tests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tsgt.config import ClassicMasterConfig, ScenarioConfig, SuperframeMasterConfig
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.runner import simulate

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from pathlib import Path

    from tsgt.simulation.mission import Mission, MissionResult

QUICK = ClassicMasterConfig(kind="classic", initial_cycles=5)
"""Protocol classic with a short first synchronisation: 1.2 s per station."""

SUPERFRAME = SuperframeMasterConfig(kind="superframe")


def run_mission(
    folder: Path,
    scenario: ScenarioConfig | None = None,
    *,
    script: Callable[[Mission], Coroutine[None, None, None]] | None = None,
    protocol: ClassicMasterConfig | SuperframeMasterConfig = QUICK,
    **options: Any,
) -> MissionResult:
    """Simulate half a minute of the reference scenario, or as given."""
    settings: dict[str, Any] = {"duration_s": 30.0, "protocol": protocol} | options
    folder.mkdir(parents=True, exist_ok=True)
    return simulate(scenario or ScenarioConfig(), SimulationOptions(**settings), folder=folder, script=script)
