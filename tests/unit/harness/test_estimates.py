"""Simulated estimates of other programs: the truth that they state, and the size of their errors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from harness.drives.estimates import (
    GNSS,
    LIDAR,
    VISUAL_INERTIAL,
    EstimateModel,
    SimulatedEstimate,
    draw_relation,
    simulate_estimate,
)

from tsgt.config import ScenarioConfig
from tsgt.geometry import invert, log_so3, rotation_from_quaternion, transform_from
from tsgt.simulation.world import World, scenario_world

UNTIL_S = 300.0
EXACT = EstimateModel(rate_hz=20.0)


@cache
def _world() -> World:
    return scenario_world(ScenarioConfig(), UNTIL_S, np.random.default_rng(2))


def _simulated(model: EstimateModel, seed: int = 1) -> SimulatedEstimate:
    rng = np.random.default_rng(seed)
    relation = draw_relation(model, rng)
    return simulate_estimate(model, relation, _world().pose_at, UNTIL_S, rng, start_ns=10**18)


def test_true_relation_takes_an_exact_estimate_to_the_truth() -> None:
    """Offset, frame and extrinsic, by their definition, explain everything."""
    rng = np.random.default_rng(3)
    truth = draw_relation(EXACT, rng)
    found = simulate_estimate(EXACT, truth, _world().pose_at, UNTIL_S, rng, start_ns=10**18)
    assert found.orientation_xyzw is not None
    time_s = (found.stamp_ns - 10**18) / 1e9 + truth.offset_s
    in_frame = transform_from(rotation_from_quaternion(found.orientation_xyzw), found.position_m)
    expected = _world().pose_at(time_s) @ truth.T_robot_sensor
    np.testing.assert_allclose(truth.T_station1_frame @ in_frame, expected, atol=1e-6)
    np.testing.assert_allclose(found.T_station1_sensor, expected, atol=1e-6)


@pytest.mark.parametrize(("model", "percent"), [(LIDAR, 0.55), (VISUAL_INERTIAL, 1.15)])
def test_drift_is_that_of_published_methods(model: EstimateModel, percent: float) -> None:
    """Position error after 400 m straight ahead at 2 m/s, relative to the pose at the start, as KITTI defines it."""

    def straight(time_s: np.ndarray) -> np.ndarray:
        return transform_from(np.eye(3), np.column_stack([2.0 * time_s, 0.0 * time_s, 0.0 * time_s]))

    slow = replace(model, rate_hz=1.0, dropouts_per_min=0.0)
    errors_m = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        found = simulate_estimate(slow, draw_relation(slow, rng), straight, 202.0, rng)
        true, estimated = found.T_station1_sensor, found.T_station1_estimated
        error = invert(invert(true[0]) @ true[200]) @ (invert(estimated[0]) @ estimated[200])
        errors_m.append(np.linalg.norm(error[:3, 3]))
    assert 100.0 * np.mean(errors_m) / 400.0 == pytest.approx(percent, rel=0.25)


@pytest.mark.parametrize("model", [LIDAR, VISUAL_INERTIAL, GNSS])
def test_stated_covariance_is_that_of_the_errors(model: EstimateModel) -> None:
    """NEES over seeds at the end of a bent drive, where drift of the rotation has bent the path: as of chi-square."""

    def bend(time_s: np.ndarray) -> np.ndarray:
        at_m = np.column_stack([30.0 * np.sin(0.05 * time_s), 2.0 * time_s, 0.05 * time_s])
        return transform_from(np.eye(3), at_m)

    model = replace(model, rate_hz=2.0, dropouts_per_min=0.0)
    squares = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        relation = replace(draw_relation(model, rng), T_robot_sensor=np.eye(4))
        found = simulate_estimate(model, relation, bend, 60.0, rng)
        R = relation.T_station1_frame[:3, :3]
        error = (
            np.concatenate(
                [
                    found.T_station1_estimated[-1, :3, 3] - found.T_station1_sensor[-1, :3, 3],
                    log_so3(found.T_station1_estimated[-1, :3, :3]),
                ]
            ).reshape(2, 3)
            @ R
        )
        size = 6 if model.orientation else 3
        covariance = found.covariance[-1, :size, :size]
        squares.append(error.ravel()[:size] @ np.linalg.solve(covariance, error.ravel()[:size]) / size)
    # The mean of 100 has a sigma of at most 0.08.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.25)


def test_gravity_keeps_the_tilt() -> None:
    """A visual-inertial estimate drifts in yaw; its frame is level, and its tilt stays within a degree."""
    found = _simulated(VISUAL_INERTIAL)
    np.testing.assert_allclose(found.truth.T_station1_frame[2], [0, 0, 1, found.truth.T_station1_frame[2, 3]])
    down, true_down = found.T_station1_estimated[:, 2, :3], found.T_station1_sensor[:, 2, :3]
    assert np.abs(np.degrees(np.arccos(np.clip((down * true_down).sum(axis=1), -1, 1)))).max() < 1.0


def test_visual_inertial_has_jitter_and_dropouts() -> None:
    """Intervals scatter by the jitter of two stamps; some poses lack."""
    found = _simulated(VISUAL_INERTIAL)
    intervals_s = np.diff(found.stamp_ns) / 1e9
    assert (intervals_s > 0).all()
    assert intervals_s[intervals_s < 0.09].std() == pytest.approx(np.sqrt(2) * 1e-3, rel=0.1)
    assert 0.90 * UNTIL_S * 20 < len(found.stamp_ns) < 0.999 * UNTIL_S * 20


def test_gnss_errors() -> None:
    """Positions alone; errors of 10 mm horizontal and 20 mm vertical that last for a minute."""
    errors = np.concatenate([_errors_m(_simulated(GNSS, seed)) for seed in range(25)])
    np.testing.assert_allclose(errors.std(axis=0), [0.0104, 0.0104, 0.0202], rtol=0.15)
    found = _simulated(GNSS)
    assert found.orientation_xyzw is None
    assert np.diff(_errors_m(found), axis=0).std() < 0.5 * _errors_m(found).std()


def _errors_m(found: SimulatedEstimate) -> np.ndarray:
    return found.T_station1_estimated[:, :3, 3] - found.T_station1_sensor[:, :3, 3]


def test_divergence() -> None:
    """The position runs away from the stated time on."""
    errors = _errors_m(_simulated(replace(EXACT, diverges_at_s=200.0)))
    np.testing.assert_allclose(errors[: 20 * 199], 0.0, atol=1e-9)
    assert np.linalg.norm(errors[-1, :2]) == pytest.approx(0.5 * 0.1 * 100**2, rel=0.01)


def test_seed_decides_everything() -> None:
    """The same seed gives the same estimate, another one another."""
    one, same, other = (_simulated(LIDAR, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.position_m, same.position_m)
    assert not np.allclose(one.position_m[:100], other.position_m[:100])
