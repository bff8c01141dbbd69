"""Where to begin the search for a trajectory: the prisms' tracks as straight lines, the layout fitted to them. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.pose import poses_from_prisms
from tsgt.geometry.rigid import exp_so3
from tsgt.geometry.trajectory.states import States, rotation_between

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations

_LONG = 3.0
"""So many times what is usual between two measurements of a prism is long."""


def initial_guess(observations: Observations, time_s: FloatArray) -> States:
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
    return PrismTracks.of(observations).guess(time_s)


@dataclass(frozen=True, slots=True)
class PrismTracks:
    """Where the prisms were measured, made ready once for guesses at many pieces of a long drive.

    Attributes
    ----------
    layout
        (P, 3) places of those that were measured, in the robot frame, in m.
    tracks
        One for each of them.
    """

    layout: FloatArray
    tracks: tuple[_Track, ...]

    @classmethod
    def of(cls, observations: Observations) -> PrismTracks:
        """Divide measurements by prism; errors as of :func:`initial_guess`."""
        points = observations.in_world()
        seen = [prism for prism in range(len(observations.layout)) if np.any(observations.prism == prism)]
        if len(seen) < 3:
            raise GeometryError(
                f"a trajectory needs measurements of 3 prisms to begin with, {len(seen)} have been measured"
            )
        each = (observations.prism == prism for prism in seen)
        return cls(
            observations.layout[seen],
            tuple(_Track.of(observations.time_s[rows], points[rows]) for rows in each),
        )

    def guess(self, time_s: FloatArray) -> States:
        """Guess as :func:`initial_guess` does, in a time that hardly grows with what lies before and after."""
        tracks = np.stack([track.at(time_s) for track in self.tracks], axis=1)
        followed = np.stack([track.followed(time_s) for track in self.tracks], axis=1)
        poses = poses_from_prisms(self.layout, tracks)
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
        placed = tracks - self.layout @ np.swapaxes(rotation, 1, 2)
        position = (share * placed).sum(axis=1) / share.sum(axis=1)
        still = np.zeros_like(position)
        velocity = np.gradient(position, time_s, axis=0) if len(time_s) > 1 else still
        return States(time_s, position, rotation, velocity, still, still, still)


@dataclass(frozen=True, slots=True)
class _Track:
    """A prism's measurements: instants, increasing, (3, N) coordinates, and how far apart they may be."""

    measured_s: FloatArray
    coordinates_m: FloatArray
    long_s: float

    @classmethod
    def of(cls, measured_s: FloatArray, points_m: FloatArray) -> _Track:
        long_s = _LONG * float(np.median(np.diff(measured_s))) if len(measured_s) > 1 else 0.0
        return cls(measured_s, np.ascontiguousarray(points_m.T), long_s)

    def at(self, time_s: FloatArray) -> FloatArray:
        """(K, 3) points on straight lines."""
        return np.stack([np.interp(time_s, self.measured_s, each) for each in self.coordinates_m], axis=1)

    def followed(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether the measurements before and after some instants are about as far apart as is usual."""
        last = len(self.measured_s) - 1
        after = np.searchsorted(self.measured_s, time_s)
        here = np.minimum(after, last)
        step_s = self.measured_s[here] - self.measured_s[np.maximum(here - 1, 0)]
        inside = (after > 0) & (after <= last) & (step_s <= self.long_s)
        found: NDArray[np.bool_] = inside | (self.measured_s[here] == time_s)
        return found


def _turning(time_s: FloatArray, good_s: FloatArray, rotation: FloatArray) -> FloatArray:
    """Carry good rotations over to all instants: turning on as before and after; at the ends they stay."""
    if len(good_s) < 2:
        return np.broadcast_to(rotation[0], (len(time_s), 3, 3)).copy()
    zero = np.zeros((len(good_s), 3))
    good = States(good_s, zero, rotation, zero, zero, zero, zero)
    earlier, later, step_s = (
        good.select(slice(None, -1)),
        good.select(slice(1, None)),
        np.diff(good_s)[:, None],
    )
    rates = rotation_between(earlier, later) / step_s
    # Each turn in the light of those before and after it.
    before, after = np.concatenate([rates[:1], rates[:-1]]), np.concatenate([rates[1:], rates[-1:]])
    turns = rotation_between(
        replace(earlier, angular_velocity=before), replace(later, angular_velocity=after)
    )
    which = np.clip(np.searchsorted(good_s, time_s, side="right") - 1, 0, len(turns) - 1)
    since_s = (np.clip(time_s, good_s[0], good_s[-1]) - good_s[which])[:, None]
    carried: FloatArray = rotation[which] @ exp_so3(since_s / step_s[which] * turns[which])
    return carried
