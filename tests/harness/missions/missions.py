"""Short simulated missions for tests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tsgt.config import ClassicMasterConfig, ScenarioConfig, SuperframeMasterConfig
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import find_scenario

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
    """Simulate half a minute of the reference scenario, with the estimator ``linear``, or as given."""
    settings: dict[str, Any] = {"duration_s": 30.0, "protocol": protocol} | options
    folder.mkdir(parents=True, exist_ok=True)
    return simulate(scenario or linear_drive(), SimulationOptions(**settings), folder=folder, script=script)


def linear_drive() -> ScenarioConfig:
    """Return the scenario ``dynamic`` with the estimator ``linear``, which takes little computing."""
    scenario = find_scenario("dynamic")
    pipeline = scenario.pipeline.model_copy(update={"estimator": "linear"})
    return scenario.model_copy(update={"pipeline": pipeline})


def run_linear_drive(
    folder: Path,
    script: Callable[[Mission], Coroutine[None, None, None]] | None,
    duration_s: float,
    **options: Any,
) -> MissionResult:
    """Simulate it over the superframe."""
    return run_mission(
        folder, linear_drive(), script=script, protocol=SUPERFRAME, duration_s=duration_s, **options
    )
