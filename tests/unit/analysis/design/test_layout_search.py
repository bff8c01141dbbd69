"""The optimal layout within an envelope."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pytest

from tsgt.analysis.design import Criterion, LayoutProblem, RobotPoses, Station, optimal_layout
from tsgt.errors import GeometryError
from tsgt.model import ARCSECOND_RAD, InstrumentNoise

NOISE = InstrumentNoise(
    range_sigma_m=0.002, range_sigma_ppm=0.0, angle_sigma_rad=ARCSECOND_RAD, pointing_sigma_m=0.001
)
PLACES = [(0.0, 0.0, 0.0), (2.0, -1.5, 0.1), (-1.5, 2.5, -0.2), (3.0, 1.0, 0.0)]
BOX = ((-0.5, -0.4, 0.8), (0.5, 0.4, 1.6))


def _task(
    envelope_m: object, *, count: int = 3, criterion: Criterion = "rotation", min_separation_m: float = 0.3
) -> LayoutProblem:
    return LayoutProblem(
        envelope_m=np.array(envelope_m, dtype=np.float64),
        count=count,
        min_separation_m=min_separation_m,
        criterion=criterion,
        stations=tuple(Station(np.array(place), NOISE, i) for i, place in enumerate(PLACES[:count])),
        robot_poses=RobotPoses.at([[60.0, 45.0, -1.0]]),
        point_m=np.zeros(3),
    )


def _variance(task: LayoutProblem, layout: np.ndarray) -> float:
    information = [
        task.information(layout[prism_index][None], prism_index)[0] for prism_index in range(task.count)
    ]
    return float(task.variance(np.sum(information, axis=0)))


@pytest.mark.parametrize("criterion", ["rotation", "position"])
def test_no_layout_of_a_coarse_grid_is_better(criterion: Criterion) -> None:
    """All 2925 triples of 27 places, tried one by one, are not better than the result of the search."""
    task = _task(BOX, criterion=criterion)
    least, greatest = task.envelope_m
    grid = np.array(list(product(*zip(least, (least + greatest) / 2, greatest, strict=True))))
    information = [task.information(grid, prism_index) for prism_index in range(3)]
    best = min(
        float(task.variance(information[0][a] + information[1][b] + information[2][c]))
        for a, b, c in combinations(range(27), 3)
    )
    found = optimal_layout(task, np.random.default_rng(0))
    # The stations stand a little apart, so that it matters by a hair who tracks which prism.
    assert _variance(task, found) <= best * 1.001
    assert (found >= least).all()
    assert (found <= greatest).all()


def test_result_is_a_local_optimum() -> None:
    """Within the envelope: 300 random shifts of 20 mm give no improvement."""
    task = _task(BOX, criterion="position")
    found = optimal_layout(task, np.random.default_rng(0))
    random = np.random.default_rng(1)
    reached = _variance(task, found)
    for _ in range(300):
        moved = np.clip(found + random.uniform(-0.02, 0.02, found.shape), *task.envelope_m)
        assert _variance(task, moved) >= reached * (1 - 1e-3)


def test_minimal_separation_is_kept() -> None:
    """A fourth prism would share a corner with another one if it were allowed to."""
    found = optimal_layout(_task(BOX, count=4, min_separation_m=0.6), np.random.default_rng(0))
    for a, b in combinations(found, 2):
        assert np.linalg.norm(a - b) >= 0.6 * (1 - 1e-6)


def test_flat_envelope() -> None:
    """Prisms on a plate, all at one height."""
    found = optimal_layout(_task(((-0.5, -0.5, 1.0), (0.5, 0.5, 1.0))), np.random.default_rng(0))
    np.testing.assert_array_equal(found[:, 2], 1.0)


def test_same_seed_gives_the_same_layout() -> None:
    """Randomness comes from the generator alone."""
    one, two = (optimal_layout(_task(BOX), np.random.default_rng(5)) for _ in "ab")
    np.testing.assert_array_equal(one, two)


def test_too_small_envelope_is_rejected() -> None:
    """Three prisms 300 mm apart do not fit into a cube of 100 mm."""
    with pytest.raises(GeometryError, match="no room for 3 prisms at least 300 mm apart"):
        optimal_layout(_task(((0, 0, 1.0), (0.1, 0.1, 1.1))), np.random.default_rng(0))


def test_progress_is_reported() -> None:
    """Start by start, to the end."""
    information: list[float] = []
    optimal_layout(_task(BOX), np.random.default_rng(0), on_progress=information.append)
    assert information == sorted(information)
    assert information[-1] == 1.0
