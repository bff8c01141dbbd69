"""Where to begin the search for a trajectory: the prisms' tracks as straight lines, the layout fitted to them. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.knots import Knots
from tsgt.geometry.pose import poses_from_prisms

if TYPE_CHECKING:
    from tsgt.geometry.prism_factors import Observations
    from tsgt.geometry.rigid import FloatArray


def first_guess(observations: Observations, time_s: FloatArray) -> Knots:
    """Guess states at some instants.

    Parameters
    ----------
    observations
        In the order of time, at least one of each of three prisms.
    time_s
        (K,) instants of the knots, increasing.

    Returns
    -------
    Knots
        Poses good to what straight lines between measurements are good for; velocities from their differences.

    Raises
    ------
    GeometryError
        Fewer than three prisms were measured, or their tracks coincide everywhere.
    """
    points = observations.in_world()
    seen = [prism for prism in range(len(observations.layout)) if np.any(observations.prism == prism)]
    if len(seen) < 3:
        raise GeometryError(
            f"a trajectory needs measurements of 3 prisms to begin with, {len(seen)} have been measured"
        )
    tracks = np.empty((len(time_s), len(seen), 3))
    for column, prism in enumerate(seen):
        rows = observations.prism == prism
        for axis in range(3):
            tracks[:, column, axis] = np.interp(time_s, observations.time_s[rows], points[rows, axis])
    poses = poses_from_prisms(observations.layout[seen], tracks)
    good = np.flatnonzero(~poses.degenerate)
    if not len(good):
        raise GeometryError(
            "the measured prisms lie in a line or at one place: which station tracks which prism?"
        )
    # A degenerate one takes the pose of the good one before it.
    use = good[np.clip(np.searchsorted(good, np.arange(len(time_s)), side="right") - 1, 0, None)]
    position, rotation = poses.translation_m[use], poses.rotation[use]
    zero = np.zeros((len(time_s), 3))
    velocity = np.gradient(position, time_s, axis=0) if len(time_s) > 1 else zero
    return Knots(time_s, position, rotation, velocity, zero, zero, zero)
