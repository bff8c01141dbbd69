"""Where to begin the search for a trajectory: the prisms' tracks as straight lines, the layout fitted to them. Pure."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.knots import Knots, turn_between
from tsgt.geometry.pose import poses_from_prisms
from tsgt.geometry.rigid import exp_so3

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.prism_factors import Observations
    from tsgt.geometry.rigid import FloatArray

_LONG = 3.0
"""So many times what is usual between two measurements of a prism is long."""


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
    layout = observations.layout[seen]
    tracks = np.empty((len(time_s), len(seen), 3))
    followed = np.empty((len(time_s), len(seen)), np.bool_)
    for column, prism in enumerate(seen):
        rows = observations.prism == prism
        for axis in range(3):
            tracks[:, column, axis] = np.interp(time_s, observations.time_s[rows], points[rows, axis])
        followed[:, column] = _followed(observations.time_s[rows], time_s)
    poses = poses_from_prisms(layout, tracks)
    # A line over a long time without a prism bends the triangle: no pose to begin with, if there are others.
    good = np.flatnonzero(~poses.degenerate & followed.all(axis=1))
    if not len(good):
        good = np.flatnonzero(~poses.degenerate)
    if not len(good):
        raise GeometryError(
            "the measured prisms lie in a line or at one place: which station tracks which prism?"
        )
    rotation = _turning(time_s, time_s[good], poses.rotation[good])
    # Where some prisms are followed, the robot is where they are.
    share = np.where(followed.any(axis=1, keepdims=True), followed, 1.0)[..., None]
    position = (share * (tracks - layout @ np.swapaxes(rotation, 1, 2))).sum(axis=1) / share.sum(axis=1)
    still = np.zeros_like(position)
    velocity = np.gradient(position, time_s, axis=0) if len(time_s) > 1 else still
    return Knots(time_s, position, rotation, velocity, still, still, still)


def _followed(measured_s: FloatArray, time_s: FloatArray) -> NDArray[np.bool_]:
    """Whether the measurements before and after some instants are about as far apart as is usual."""
    at = np.isin(time_s, measured_s)
    if len(measured_s) < 2:
        return at
    steps_s = np.diff(measured_s)
    after = np.searchsorted(measured_s, time_s)
    inside = (after > 0) & (after < len(measured_s))
    return at | (inside & (steps_s[np.clip(after, 1, len(steps_s)) - 1] <= _LONG * np.median(steps_s)))


def _turning(time_s: FloatArray, good_s: FloatArray, rotation: FloatArray) -> FloatArray:
    """Carry good rotations over to all instants: turning on as before and after; at the ends they stay."""
    if len(good_s) < 2:
        return np.broadcast_to(rotation[0], (len(time_s), 3, 3)).copy()
    zero = np.zeros((len(good_s), 3))
    good = Knots(good_s, zero, rotation, zero, zero, zero, zero)
    earlier, later, step_s = (
        good.select(slice(None, -1)),
        good.select(slice(1, None)),
        np.diff(good_s)[:, None],
    )
    rates = turn_between(earlier, later) / step_s
    # Each turn in the light of those before and after it.
    before, after = np.concatenate([rates[:1], rates[:-1]]), np.concatenate([rates[1:], rates[-1:]])
    turns = turn_between(replace(earlier, angular_velocity=before), replace(later, angular_velocity=after))
    which = np.clip(np.searchsorted(good_s, time_s, side="right") - 1, 0, len(turns) - 1)
    since_s = (np.clip(time_s, good_s[0], good_s[-1]) - good_s[which])[:, None]
    carried: FloatArray = rotation[which] @ exp_so3(since_s / step_s[which] * turns[which])
    return carried
