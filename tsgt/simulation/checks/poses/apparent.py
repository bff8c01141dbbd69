"""Poses of the robot as its stations show it: after a station has moved, the frames in force place its prism elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry import align_many, invert, transform_from, transform_points
from tsgt.geometry.alignment import spread_m
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.simulation.mission import MasterLog, MissionResult

AROUND_S = 3.0
"""Measurements within this time of a pose may enter it: the lag of the final poses, and outage and transport limits."""


class ApparentPoses(NamedTuple):
    """What measurements without noise show at N instants, by the frames in force; the truth while no station has moved.

    Attributes
    ----------
    T_station1_robot
        Rigid fits to the apparent prisms, (N, 4, 4).
    misfit_m
        Root mean square distances of the apparent prisms from the fits, (N,).
    step_m
        By how much the apparent prism that moves most changes within :data:`AROUND_S`, for the robot where it is, (N,).
    """

    T_station1_robot: NDArray[np.float64]
    misfit_m: NDArray[np.float64]
    step_m: NDArray[np.float64]


def apparent_poses(
    result: MissionResult, master_log: MasterLog, times_s: NDArray[np.float64]
) -> ApparentPoses:
    """Return what the stations of a master show at instants in s from the start. Fewer than three prisms: the true poses.

    A mission in which no station moves costs nothing.
    """
    truth, zeros = result.world.pose_at(times_s), np.zeros(len(times_s))
    if not has_moves(result, master_log):
        return ApparentPoses(truth, zeros, zeros)
    prisms_m = _apparent_prisms(result, master_log, truth, times_s)
    before_m, after_m = (
        _apparent_prisms(result, master_log, truth, times_s + by_s) for by_s in (-AROUND_S, AROUND_S)
    )
    step_m = np.linalg.norm(after_m - before_m, axis=2).max(axis=1)
    if len(result.parameters.prisms) < MIN_PRISMS:
        return ApparentPoses(
            truth, np.linalg.norm(prisms_m - _true_prisms(result, truth), axis=2).max(axis=1), step_m
        )
    fit = align_many([prism.position_m for prism in result.parameters.prisms], prisms_m)
    misfit_m = np.sqrt(np.mean(np.sum(fit.residuals_m**2, axis=2), axis=1))
    return ApparentPoses(transform_from(fit.rotation, fit.translation_m), misfit_m, step_m)


def has_moves(result: MissionResult, master_log: MasterLog) -> bool:
    """Whether a station moves in a mission, so that frames in force differ from the true ones at times."""
    return bool(result.moves) or (
        master_log.parameters is not None and master_log.parameters.stations != result.parameters.stations
    )


def misfit_tolerances(result: MissionResult, apparent: ApparentPoses) -> NDArray[np.float64]:
    """Return by how much poses may differ from the apparent ones beyond their covariance: in m at the centroid and in rad, (N, 2).

    An estimator need not weight the prisms alike, so a misfit moves it, and turns it about the shorter side of the layout. Around
    a step it has measurements from before and after it.
    """
    layout_m = np.array([prism.position_m for prism in result.parameters.prisms])
    lever_m = spread_m(layout_m)[1] if len(layout_m) >= MIN_PRISMS else 1.0
    untold_m = apparent.misfit_m + apparent.step_m
    return np.stack([untold_m, untold_m / lever_m], axis=1)


def _true_prisms(result: MissionResult, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    positions_m = np.array([prism.position_m for prism in result.parameters.prisms])
    return transform_points(poses[:, None], positions_m)


def _apparent_prisms(
    result: MissionResult,
    master_log: MasterLog,
    poses: NDArray[np.float64],
    times_s: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return where the prisms of a robot in these poses appear from the stations as they stand at these instants: (N, P, 3)."""
    parameters = master_log.parameters or result.parameters
    in_force = {each.station: np.array(each.T_station1_station) for each in parameters.stations}
    station_of = {each.prism: each.station for each in reversed(parameters.stations)}
    true_m = _true_prisms(result, poses)
    for column, prism in enumerate(result.parameters.prisms):
        station = station_of[prism.prism]
        at_start = next(e.T_station1_station for e in result.parameters.stations if e.station == station)
        moves = [move for move in result.moves if move.station == station]
        frames = np.array([at_start, *(move.T_station1_station for move in moves)])
        row = np.searchsorted([move.from_s for move in moves], times_s, side="right")
        true_m[:, column] = transform_points(in_force[station] @ invert(frames)[row], true_m[:, column])
    return true_m
