"""Detection of rest from measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.drives.prior_motion import as_cartesian
from harness.drives.slow_motion import braking, creeping, measure_along

from tsgt.geometry.rest import MARGIN_S, find_rest

UNTIL_S = 30.0


def resting_s(found: list) -> float:  # type: ignore[type-arg]
    """Total duration of intervals."""
    return float(sum(each.end_s - each.start_s for each in found))


@pytest.mark.parametrize("stations", [(0, 1, 2), (0, 2), (1,)])
def test_rest_is_found_with_stations_out(stations: tuple[int, ...]) -> None:
    """One interval, but for the margins and the first and last measurement."""
    observations = measure_along(creeping(0.0), until_s=UNTIL_S, seed=1, stations=stations)
    (found,) = find_rest(observations)
    assert found.start_s < 0.4 + MARGIN_S
    assert found.end_s > UNTIL_S - 0.8 - MARGIN_S


@pytest.mark.parametrize("speed_mps", [0.005, 0.01, 0.02])
def test_creep_is_no_rest(speed_mps: float) -> None:
    """A robot that creeps is not at rest, in a direction that is measured badly and also with one station."""
    for seed in range(5):
        for stations in ((0, 1, 2), (1,)):
            observations = measure_along(creeping(speed_mps), until_s=UNTIL_S, seed=seed, stations=stations)
            assert find_rest(observations) == []


@pytest.mark.parametrize("vibration_m", [0.0, 0.001, 0.003])
def test_vibration_is_estimated(vibration_m: float) -> None:
    """A vibrating robot is at rest, and its vibration is known to half a millimetre."""
    observations = measure_along(creeping(0.0), until_s=UNTIL_S, seed=2, vibration_m=vibration_m)
    (found,) = find_rest(observations)
    assert found.vibration_m == pytest.approx(vibration_m, abs=5e-4)


def test_rest_starts_after_the_robot_has_stopped() -> None:
    """Neither before, nor more than a second later."""
    for seed in range(5):
        observations = measure_along(braking(0.5, 8.0, 2.0), until_s=UNTIL_S, seed=seed)
        (found,) = find_rest(observations)
        assert 9.9 < found.start_s < 11.5


def test_rest_ends_before_the_robot_starts() -> None:
    """The same motion backwards: the displacement at the end of the interval is below half a millimetre."""
    for seed in range(5):
        observations = measure_along(
            lambda time_s: -braking(0.5, 8.0, 2.0)(20.0 - time_s), until_s=20.0, seed=seed
        )
        (found,) = find_rest(observations)
        assert found.end_s > 8.5
        assert 0.125 * max(found.end_s - 10.0, 0.0) ** 2 < 5e-4


def test_wrong_frames_do_not_hide_rest() -> None:
    """A station frame that is off by a decimetre displaces a prism, and displaces it always."""
    observations = measure_along(creeping(0.0), until_s=UNTIL_S, seed=3)
    frames = observations.frames.copy()
    frames[1, :3, 3] += 0.1
    (found,) = find_rest(replace(observations, frames=frames))
    assert resting_s([found]) > UNTIL_S - 2.0


def test_outlier_does_not_end_rest() -> None:
    """A single reflection is no motion."""
    observations = measure_along(creeping(0.0), until_s=UNTIL_S, seed=4)
    observations.points_m[100] *= 1.001
    (found,) = find_rest(observations)
    assert resting_s([found]) > UNTIL_S - 2.0
    assert found.vibration_m < 5e-4


def test_rest_does_not_span_a_gap() -> None:
    """Without any measurement for two seconds the robot may have moved."""
    observations = measure_along(creeping(0.0), until_s=UNTIL_S, seed=5)
    seen = (observations.time_s < 14.0) | (observations.time_s > 16.0)
    found = find_rest(observations.select(seen))
    assert [round(each.start_s) < 14 for each in found] == [True, False]
    assert found[0].end_s < 14.0 < 16.0 < found[1].start_s


def test_points_are_searched_as_polar_measurements_are() -> None:
    """Cartesian points, on the other side of the circle's zero too."""
    observations = measure_along(creeping(0.0), until_s=UNTIL_S, seed=6)
    (found,) = find_rest(as_cartesian(observations))
    assert resting_s([found]) > UNTIL_S - 2.0
    half_turn = np.diag([-1.0, -1.0, 1.0])
    turned = replace(observations, points_m=observations.points_m @ half_turn)
    assert resting_s(find_rest(turned)) > UNTIL_S - 2.0
