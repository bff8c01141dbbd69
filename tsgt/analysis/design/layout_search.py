"""The best places for prisms within an envelope: exchange on a grid, then refinement.

Where one prism should sit depends on where the others sit, and the search has many local optima (corners of the
envelope). Exchange algorithms of optimal design (Fedorov 1972) do well here: from a random start each prism in turn
goes to the best place of a grid, until none wants to move; the best of several starts is refined in ever smaller
steps. All places of a grid are judged at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from tsgt.analysis.design.layout_study import prism_information
from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.analysis.design.layout_study import RobotPoses, Station
    from tsgt.geometry import FloatArray

Criterion = Literal["rotation", "position"]

_GRID = 5
_STARTS = 8
_SWEEPS = 20
"""A search that has not settled by then goes round in circles of rounding."""
_FINEST_M = 0.002
_OTHER_WEIGHT = 0.01
"""What the criterion that was not asked for counts, 1 rad as much as 1 m: of a layout and its mirror image, equally
good by one, the better by the other is taken."""
_GAIN = 1e-9
"""A move that improves by less than this part is not worth being made."""

# So little that no measurement notices, and enough that prisms in a line give large variances instead of none.
_FAINT_INFORMATION = 1e-6


@dataclass(frozen=True, slots=True)
class LayoutProblem:
    """What is to be found.

    Attributes
    ----------
    envelope_m
        Least and greatest x, y, z in the robot frame in m, shape (2, 3).
    count
        How many prisms.
    least_distance_m
        No two of them closer than this.
    criterion
        What is to be known best: the rotation, or the position of the point.
    stations, stances, point_m
        As for :func:`tsgt.analysis.design.layout_study.pose_covariances`.
    """

    envelope_m: FloatArray
    count: int
    min_separation_m: float
    criterion: Criterion
    stations: tuple[Station, ...]
    robot_poses: RobotPoses
    point_m: FloatArray

    def information(self, places_m: FloatArray, slot: int) -> FloatArray:
        """Tell what a prism at each of the places (M, 3) says of the pose; shape (M, N, 6, 6)."""
        return prism_information(places_m, slot, self.stations, self.robot_poses, self.point_m)

    def variance(self, information: FloatArray) -> FloatArray:
        """Judge information matrices (..., N, 6, 6) by the mean over the stances of the summed variance, shape (...)."""
        covariance = np.linalg.inv(information + _FAINT_INFORMATION * np.eye(6))
        variances = np.diagonal(covariance, axis1=-2, axis2=-1).mean(axis=-2)
        position, rotation = variances[..., :3].sum(axis=-1), variances[..., 3:].sum(axis=-1)
        wanted, other = (rotation, position) if self.criterion == "rotation" else (position, rotation)
        judged: FloatArray = wanted + _OTHER_WEIGHT * other
        return judged


def optimal_layout(
    task: LayoutProblem, random: np.random.Generator, *, on_progress: Callable[[float], None] | None = None
) -> FloatArray:
    """Find the places in the envelope from which the pose is known best.

    Parameters
    ----------
    task
        What is to be found.
    random
        Source of the starts.
    on_progress
        Told the share that is done.

    Returns
    -------
    FloatArray
        Places of the prisms in the robot frame in m, shape (count, 3).

    Raises
    ------
    GeometryError
        The envelope is too small to keep the prisms apart.
    """
    least, greatest = task.envelope_m
    axes = [np.unique(np.linspace(low, high, _GRID)) for low, high in zip(least, greatest, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    told = [task.information(grid, slot) for slot in range(task.count)]
    found: tuple[float, FloatArray] | None = None
    for start in range(_STARTS):
        chosen = _start(grid, task, random)
        if chosen is not None:
            variance, layout = _exchange(grid[chosen], task, lambda slot, _: (grid, told[slot]))
            if found is None or variance < found[0]:
                found = variance, layout
        if on_progress is not None:
            on_progress((start + 1) / _STARTS)
    if found is None:
        raise GeometryError(
            f"the envelope has no room for {task.count} prisms at least {task.min_separation_m * 1e3:g} mm apart"
        )
    return _refined(found[1], task)


def _start(grid: FloatArray, task: LayoutProblem, random: np.random.Generator) -> list[int] | None:
    """Choose places far enough apart; None where chance led into a corner without room for the rest."""
    chosen: list[int] = []
    for place in random.permutation(len(grid)):
        if _apart(grid[place][None], grid[chosen], task)[0]:
            chosen.append(int(place))
            if len(chosen) == task.count:
                return chosen
    return None


def _refined(layout: FloatArray, task: LayoutProblem) -> FloatArray:
    """Improve a layout in steps that halve, beginning with half the grid's."""
    least, greatest = task.envelope_m
    around = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    step_m = (greatest - least) / (_GRID - 1) / 2

    def neighbours(slot: int, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        places = np.clip(place + around * step_m, least, greatest)
        return places, task.information(places, slot)

    while step_m.max() > _FINEST_M:
        _, layout = _exchange(layout, task, neighbours)
        step_m = step_m / 2
    return layout


def _exchange(
    layout: FloatArray,
    task: LayoutProblem,
    offers: Callable[[int, FloatArray], tuple[FloatArray, FloatArray]],
) -> tuple[float, FloatArray]:
    """Let each prism in turn take the best of the places offered to it, until none moves.

    ``offers`` gives, for a slot and its present place, places (M, 3) and what they tell (M, N, 6, 6).
    """
    layout = layout.copy()
    told = [task.information(layout[slot][None], slot)[0] for slot in range(task.count)]
    variance = float(task.variance(sum(told, start=np.zeros_like(told[0]))))
    for _ in range(_SWEEPS):
        before = variance
        for slot in range(task.count):
            places, tell = offers(slot, layout[slot])
            others = [i for i in range(task.count) if i != slot]
            rest = sum((told[i] for i in others), start=np.zeros_like(told[0]))
            judged = np.where(_apart(places, layout[others], task), task.variance(rest + tell), np.inf)
            best = int(np.argmin(judged))
            if judged[best] < variance * (1 - _GAIN):
                variance = float(judged[best])
                layout[slot], told[slot] = places[best], tell[best]
        if variance == before:
            break
    return variance, layout


def _apart(places: FloatArray, others: FloatArray, task: LayoutProblem) -> np.ndarray:
    """Which of the places (M, 3) are far enough from all others (K, 3); shape (M,)."""
    distances = np.linalg.norm(places[:, None] - others, axis=-1)
    # A grid may offer exactly the distance, give or take a rounding.
    clear: np.ndarray = (distances >= task.min_separation_m * (1 - 1e-9)).all(axis=1)
    return clear
