"""Limits of the checks of poses against the truth."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tsgt.config import ScenarioConfig, SimulatedImu, scenario_parameters
from tsgt.simulation.checks.poses.consistency import (
    displaced_covariance,
    max_median_rotation_rad,
    untold_displacements,
)


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


@pytest.mark.parametrize(("prisms", "knocks"), [(3, [0, 0, 0]), (2, [0, 1, 2]), (1, [0, 1, 2])])
def test_few_prisms_do_not_tell_how_the_imu_was_knocked(prisms: int, knocks: list[int]) -> None:
    """By a degree and 20 mm at 60 s and at 110 s; three prisms tell it."""
    parameters = scenario_parameters(ScenarioConfig(imu=SimulatedImu(model="industrial")), imu=True)
    parameters = replace(parameters, prisms=parameters.prisms[:prisms])
    result: Any = SimpleNamespace(parameters=parameters, knocks_s=(110.0, 60.0))
    poses: Any = SimpleNamespace(stamp_ns=np.array([50, 100, 150]) * 1_000_000_000)
    master_log: Any = SimpleNamespace(unix_at_zero_ns=0)
    untold = untold_displacements(poses, master_log, result)
    assert untold[:, 1] == pytest.approx(np.radians(knocks))
    # The prisms are between a quarter of a metre and two metres from the IMU.
    assert (untold[:, 0] >= 0.02 * np.array(knocks) + 0.25 * untold[:, 1]).all()
    assert (untold[:, 0] <= 0.02 * np.array(knocks) + 2.0 * untold[:, 1]).all()


def test_displacement_is_part_of_the_stated_error() -> None:
    """An error of a degree and 20 mm is one sigma after such a knock, and seventeen without it, whatever else is uncertain."""
    parameters = scenario_parameters(ScenarioConfig(imu=SimulatedImu(model="industrial")), imu=True)
    stated = np.tile(np.diag([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3]) ** 2, (2, 1, 1))
    untold = np.array([[0.0, 0.0], [0.03, np.radians(1.0)]])
    error = np.array([0.0, 0.0, 0.02, 0.0, 0.0, np.radians(1.0)])
    before, after = (
        float(error @ np.linalg.solve(each, error))
        for each in displaced_covariance(stated, untold, parameters)
    )
    assert before > 300.0
    assert after < 1.1
