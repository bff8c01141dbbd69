"""A rejected sight: its displacement, and whether the target moved or the station erred."""

from __future__ import annotations

import numpy as np
import pytest
from harness.instruments.target_field import TargetField

from tsgt.geometry.target_calibration import AIM, MOVED, READINGS, SightError, calibrate_network, sight_error
from tsgt.model import TARGET_NOISE


def probabilities(*displacement_mm: float, sigma_mm: float = 1.0) -> dict[str, float]:
    """Probabilities of a displacement with the same sigma in all directions, on a level line of sight."""
    error = SightError(1e-3 * np.array(displacement_mm), (1e-3 * sigma_mm) ** 2 * np.eye(3), 0.05)
    return dict(error.probabilities())


@pytest.mark.parametrize("row", range(3))
def test_one_component_is_one_reading(row: int) -> None:
    """Half a metre in one direction alone is that reading; the probabilities add up to one."""
    found = probabilities(*(500.0 * np.eye(3)[row]))
    assert found[READINGS[row]] > 0.95
    assert sum(found.values()) == pytest.approx(1.0)


def test_skew_displacement_is_a_moved_target() -> None:
    """No single reading, and not across the line of sight."""
    assert probabilities(30.0, 20.0, -25.0)[MOVED] > 0.95


def test_displacement_across_is_not_decided() -> None:
    """A target that moves across the line of sight looks like a point beside it."""
    found = probabilities(0.0, 20.0, -15.0)
    assert found[AIM] + found[MOVED] > 0.99
    assert found[MOVED] < 0.95


def test_small_displacement_is_not_decided() -> None:
    """What is as small as its noise has no direction."""
    found = probabilities(3.0, 2.0, -2.0, sigma_mm=2.0)
    assert max(found.values()) < 0.95


@pytest.mark.parametrize("station", [0, 2])
@pytest.mark.slow
def test_displacement_agrees_with_the_truth_within_its_covariance(station: int) -> None:
    """Normalised errors average one per component, also of the reference station."""
    squares = []
    shift = np.array([0.05, -0.02, 0.03])
    for seed in range(4):
        field = TargetField(
            rng=np.random.default_rng(seed), targets=8, in_specification=True, displaced={(station, 1): shift}
        )
        solved = calibrate_network(field.measure(), TARGET_NOISE)
        error = sight_error(solved, solved.causes[0], TARGET_NOISE)
        assert error is not None
        line = field.points_m[1] - field.translation_m[station]
        along = line / np.linalg.norm(line)
        across = np.cross(along, [0.0, 0.0, 1.0]) / np.hypot(*along[:2])
        truth = np.stack([along, across, np.cross(across, along)]) @ shift
        miss = error.displacement_m - truth
        squares.append(float(miss @ np.linalg.solve(error.covariance_m2, miss)) / 3)
    assert 0.2 < np.mean(squares) < 2.0
