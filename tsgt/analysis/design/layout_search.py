"""Optimal prism layout within an envelope: exchange algorithm on a grid, then local refinement. Sans-I/O.

The objective has many local optima (corners of the envelope). Exchange algorithms of optimal design (Fedorov 1972) handle
this: from a random start each prism in turn moves to the best candidate of a grid until none improves; the best of several
starts is refined in ever smaller steps. All candidates of a grid are evaluated at once.
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
_SWEEPS = 20  # Upper limit of sweeps; more would only repeat rounding errors
_FINEST_M = 0.002
_OTHER_WEIGHT = 0.01  # Of the other criterion, 1 rad equal to 1 m: breaks ties with the mirror image
_GAIN = 1e-9  # Minimal relative improvement of a move

# Diffuse prior: negligible against measurements, but keeps the variance finite for prisms in a line.
_PRIOR_INFORMATION = 1e-6


@dataclass(frozen=True, slots=True)
class LayoutProblem:
    """The optimisation problem.

    Attributes
    ----------
    envelope_m : Minimum and maximum x, y, z in the robot frame, (2, 3).
    count : Number of prisms.
    min_separation_m : Between any two prisms.
    criterion : Whether the rotation or the position of the point is to be most accurate.
    stations, robot_poses, point_m : As for :func:`tsgt.analysis.design.layout_study.pose_covariances`.
    """

    envelope_m: FloatArray
    count: int
    min_separation_m: float
    criterion: Criterion
    stations: tuple[Station, ...]
    robot_poses: RobotPoses
    point_m: FloatArray

    def information(self, places_m: FloatArray, prism_index: int) -> FloatArray:
        """Return the information about the pose for a prism at each of M places, (M, N, 6, 6)."""
        return prism_information(places_m, prism_index, self.stations, self.robot_poses, self.point_m)

    def variance(self, information: FloatArray) -> FloatArray:
        """Return the objective for information matrices (..., N, 6, 6): the summed variance, mean over the robot poses, (...)."""
        covariance = np.linalg.inv(information + _PRIOR_INFORMATION * np.eye(6))
        variances = np.diagonal(covariance, axis1=-2, axis2=-1).mean(axis=-2)
        position, rotation = variances[..., :3].sum(axis=-1), variances[..., 3:].sum(axis=-1)
        chosen, other = (rotation, position) if self.criterion == "rotation" else (position, rotation)
        objective: FloatArray = chosen + _OTHER_WEIGHT * other
        return objective


def optimal_layout(
    problem: LayoutProblem, random: np.random.Generator, *, on_progress: Callable[[float], None] | None = None
) -> FloatArray:
    """Find the prism positions, (count, 3) in the robot frame in m, that minimise the variance of the pose.

    ``on_progress`` gets the completed fraction, 0 to 1. Raises GeometryError if the envelope is too small for the
    separation.
    """
    axes = [np.unique(np.linspace(low, high, _GRID)) for low, high in zip(*problem.envelope_m, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    information = [problem.information(grid, prism_index) for prism_index in range(problem.count)]
    best: tuple[float, FloatArray] | None = None
    for start in range(_STARTS):
        chosen = _start(grid, problem, random)
        if chosen is not None:
            variance, layout = _exchange(
                grid[chosen], problem, lambda prism_index, _: (grid, information[prism_index])
            )
            if best is None or variance < best[0]:
                best = variance, layout
        if on_progress is not None:
            on_progress((start + 1) / _STARTS)
    if best is None:
        raise GeometryError(
            f"the envelope has no room for {problem.count} prisms at least {problem.min_separation_m * 1e3:g} mm apart"
        )
    return _refined(best[1], problem)


def _start(grid: FloatArray, problem: LayoutProblem, random: np.random.Generator) -> list[int] | None:
    """Choose random places with the minimal separation; None if the remaining prisms do not fit."""
    chosen: list[int] = []
    for place in random.permutation(len(grid)):
        if _apart(grid[place][None], grid[chosen], problem)[0]:
            chosen.append(int(place))
            if len(chosen) == problem.count:
                return chosen
    return None


def _refined(layout: FloatArray, problem: LayoutProblem) -> FloatArray:
    """Improve a layout in steps that halve, starting with half the grid spacing."""
    least, greatest = problem.envelope_m
    offsets = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    step_m = (greatest - least) / (_GRID - 1) / 2

    def neighbours(prism_index: int, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        places = np.clip(place + offsets * step_m, least, greatest)
        return places, problem.information(places, prism_index)

    while step_m.max() > _FINEST_M:
        _, layout = _exchange(layout, problem, neighbours)
        step_m = step_m / 2
    return layout


def _exchange(
    layout: FloatArray,
    problem: LayoutProblem,
    candidates: Callable[[int, FloatArray], tuple[FloatArray, FloatArray]],
) -> tuple[float, FloatArray]:
    """Move each prism in turn to its best candidate, from places (M, 3) and information (M, N, 6, 6), until none improves."""
    layout = layout.copy()
    information = [problem.information(layout[i][None], i)[0] for i in range(problem.count)]
    variance = float(problem.variance(sum(information, start=np.zeros_like(information[0]))))
    for _ in range(_SWEEPS):
        before = variance
        for prism_index in range(problem.count):
            places, candidate_information = candidates(prism_index, layout[prism_index])
            others = [i for i in range(problem.count) if i != prism_index]
            rest = sum((information[i] for i in others), start=np.zeros_like(information[0]))
            objective = np.where(
                _apart(places, layout[others], problem),
                problem.variance(rest + candidate_information),
                np.inf,
            )
            best = int(np.argmin(objective))
            if objective[best] < variance * (1 - _GAIN):
                variance = float(objective[best])
                layout[prism_index], information[prism_index] = places[best], candidate_information[best]
        if variance == before:
            break
    return variance, layout


def _apart(places: FloatArray, others: FloatArray, problem: LayoutProblem) -> np.ndarray:
    """Return which places (M, 3) keep the minimal separation from all others (K, 3); (M,)."""
    distances = np.linalg.norm(places[:, None] - others, axis=-1)
    # The grid spacing may equal the minimal separation up to rounding.
    separated: np.ndarray = (distances >= problem.min_separation_m * (1 - 1e-9)).all(axis=1)
    return separated
