"""What a knock of the IMU adds to the poses of one or two stations."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.records import START, imu_samples, recording_bytes

from tsgt.config import ScenarioConfig, SimulatedImu, scenario_parameters
from tsgt.simulation.checks.poses.knocks import displaced_covariance, displacements, untold_displacements

if TYPE_CHECKING:
    from pathlib import Path

PARAMETERS = scenario_parameters(ScenarioConfig(imu=SimulatedImu(model="industrial")), imu=True)
POSES: Any = SimpleNamespace(stamp_ns=START + np.array([50, 100, 150]) * 1_000_000_000)


def mission(prisms: int) -> Any:
    """Return a mission with knocks at 60 and 110 s."""
    parameters = replace(PARAMETERS, prisms=PARAMETERS.prisms[:prisms])
    return SimpleNamespace(parameters=parameters, knocks_s=(110.0, 60.0))


def log(path: Path | None, shocks_before: int = 0) -> Any:
    """Return the log of a master that knew of shocks before its start."""
    assert PARAMETERS.imu is not None
    parameters = replace(PARAMETERS, imu=replace(PARAMETERS.imu, shocks_before=shocks_before))
    return SimpleNamespace(unix_at_zero_ns=START, recording=lambda: path, parameters=parameters)


@pytest.mark.parametrize(("prisms", "knocks"), [(3, [0, 0, 0]), (2, [0, 1, 2]), (1, [0, 1, 2])])
def test_few_prisms_do_not_tell_how_the_imu_was_knocked(prisms: int, knocks: list[int]) -> None:
    """By a degree and 20 mm each time; three prisms tell it."""
    untold = untold_displacements(POSES, log(None), mission(prisms))
    assert untold[:, 1] == pytest.approx(np.radians(knocks))
    # The prisms are between a quarter of a metre and two metres from the IMU.
    assert (untold[:, 0] >= 0.02 * np.array(knocks) + 0.25 * untold[:, 1]).all()
    assert (untold[:, 0] <= 0.02 * np.array(knocks) + 2.0 * untold[:, 1]).all()


@pytest.mark.parametrize(("shocks_before", "knocks"), [(0, [0, 0, 1]), (1, [0, 0, 0])])
def test_recorded_and_earlier_shocks_tell_of_knocks(
    tmp_path: Path, shocks_before: int, knocks: list[int]
) -> None:
    """The samples of the knock at 60 s are recorded, those of the one at 110 s are not."""
    line = imu_samples(200 * 60)
    line = replace(line, specific_force_mps2=((0.0, -90.0, 9.8), *line.specific_force_mps2[1:]))
    path = tmp_path / "recording.jsonl"
    path.write_bytes(recording_bytes(imu_samples(0), line, imu_samples(200 * 110)))
    untold = untold_displacements(POSES, log(path, shocks_before), mission(1))
    assert untold[:, 1] == pytest.approx(np.radians(knocks))
    assert displacements(POSES, log(path), mission(1))[:, 1] == pytest.approx(np.radians([0, 1, 2]))


def test_poses_from_before_the_samples_of_a_shock_do_not_know_of_it(tmp_path: Path) -> None:
    """Predicted ones, of half a second after it."""
    line = replace(imu_samples(200 * 60, 1), specific_force_mps2=((0.0, -90.0, 9.8),))
    path = tmp_path / "recording.jsonl"
    path.write_bytes(recording_bytes(line))
    poses: Any = SimpleNamespace(stamp_ns=START + np.array([60_500_000_000, 62_000_000_000]))
    untold = untold_displacements(poses, log(path), mission(1))
    assert untold[:, 1] == pytest.approx(np.radians([1, 0]))


def test_displacement_is_part_of_the_stated_error() -> None:
    """An error of a degree and 20 mm is one sigma after such a knock, and seventeen without it, whatever else is uncertain."""
    stated = np.tile(np.diag([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3]) ** 2, (2, 1, 1))
    untold = np.array([[0.0, 0.0], [0.03, np.radians(1.0)]])
    error = np.array([0.0, 0.0, 0.02, 0.0, 0.0, np.radians(1.0)])
    before, after = (
        float(error @ np.linalg.solve(each, error))
        for each in displaced_covariance(stated, untold, PARAMETERS)
    )
    assert before > 300.0
    assert after < 1.1
