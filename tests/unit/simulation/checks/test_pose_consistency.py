"""Limits of the checks of poses against the truth."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tsgt.config import ScenarioConfig, SimulatedImu, scenario_parameters
from tsgt.simulation.checks.poses.consistency import max_median_rotation_rad


@pytest.mark.parametrize(
    ("prisms", "model", "limit_rad"),
    [(3, "consumer", 0.005), (2, "consumer", 0.026), (1, "industrial", 0.0071), (1, "consumer", 0.026)],
)
def test_limit_of_the_median_rotation(prisms: int, model: str, limit_rad: float) -> None:
    """Of one or two prisms: 0.07 % and 0.7 % of misalignment, three times, beside what noise may cause."""
    imu = SimulatedImu(model=model)  # type: ignore[arg-type]
    parameters = scenario_parameters(ScenarioConfig(imu=imu), imu=True)
    parameters = replace(parameters, prisms=parameters.prisms[:prisms])
    assert max_median_rotation_rad(parameters) == pytest.approx(limit_rad)
