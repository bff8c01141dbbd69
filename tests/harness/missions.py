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
"""The protocol with a short synchronisation at the start: 1.2 s for each station."""

SUPERFRAME = SuperframeMasterConfig(kind="superframe")


def mission(
    folder: Path,
    scenario: ScenarioConfig | None = None,
    *,
    script: Callable[[Mission], Coroutine[None, None, None]] | None = None,
    protocol: ClassicMasterConfig | SuperframeMasterConfig = QUICK,
    **options: Any,
) -> MissionResult:
    """Run half a minute of the reference scenario, or what else is asked for."""
    settings: dict[str, Any] = {"duration_s": 30.0, "protocol": protocol} | options
    folder.mkdir(parents=True, exist_ok=True)
    return simulate(scenario or ScenarioConfig(), SimulationOptions(**settings), folder=folder, script=script)
