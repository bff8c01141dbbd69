"""Initial guess of a trajectory: prism tracks interpolated linearly, the layout registered to them. Sans-I/O."""

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

_MAX_GAP_FACTOR = 3.0  # Longest gap of a track that counts as tracked, relative to the median interval


def initial_guess(observations: Observations, time_s: FloatArray) -> States:
    """Return initial states at knot times, (K,): poses from linear interpolation, velocities from their differences.

    Raises GeometryError: fewer than three prisms were measured, or their tracks coincide or are collinear everywhere.
    """
    return PrismTracks.of(observations).guess(time_s)


@dataclass(frozen=True, slots=True)
class PrismTracks:
    """Tracks of the measured prisms, prepared once for the initial guesses of many segments."""

    layout: FloatArray  # (P, 3) positions of the measured prisms in the robot frame in m
    tracks: tuple[_Track, ...]

    @classmethod
    def of(cls, observations: Observations) -> PrismTracks:
        """Divide measurements by prism; raises as :func:`initial_guess`."""
        points = observations.in_world()
        measured = [prism for prism in range(len(observations.layout)) if np.any(observations.prism == prism)]
        if len(measured) < 3:
            raise GeometryError(
                f"a trajectory needs measurements of 3 prisms, {len(measured)} have been measured"
            )
        each = (observations.prism == prism for prism in measured)
        return cls(
            observations.layout[measured],
            tuple(_Track.of(observations.time_s[rows], points[rows]) for rows in each),
        )

    def guess(self, time_s: FloatArray) -> States:
        """Return initial states as from :func:`initial_guess`, in a time nearly independent of the recording's length."""
        tracks = np.stack([track.at(time_s) for track in self.tracks], axis=1)
        tracked = np.stack([track.tracked(time_s) for track in self.tracks], axis=1)
        poses = poses_from_prisms(self.layout, tracks)
        # Interpolation across an outage distorts the triangle: use other poses if there are any.
        valid = np.flatnonzero(~poses.degenerate & tracked.all(axis=1))
        if not len(valid):
            valid = np.flatnonzero(~poses.degenerate)
        if not len(valid):
            raise GeometryError(
                "the measured prisms lie in a line or at one place: check which station tracks which prism"
            )
        rotation = _interpolate_rotation(time_s, time_s[valid], poses.rotation[valid])
        # The tracked prisms, if any, determine the position.
        weights = np.where(tracked.any(axis=1, keepdims=True), tracked, 1.0)[..., None]
        reference_points = tracks - self.layout @ rotation.swapaxes(1, 2)
        position = (weights * reference_points).sum(axis=1) / weights.sum(axis=1)
        zero = np.zeros_like(position)
        velocity = np.gradient(position, time_s, axis=0) if len(time_s) > 1 else zero
        return States(time_s, position, rotation, velocity, zero, zero, zero)


@dataclass(frozen=True, slots=True)
class _Track:
    """Track of one prism: times, increasing, coordinates, (3, N), and the longest gap that counts as tracked."""

    measured_s: FloatArray
    coordinates_m: FloatArray
    max_gap_s: float

    @classmethod
    def of(cls, measured_s: FloatArray, points_m: FloatArray) -> _Track:
        max_gap_s = _MAX_GAP_FACTOR * float(np.median(np.diff(measured_s))) if len(measured_s) > 1 else 0.0
        return cls(measured_s, np.ascontiguousarray(points_m.T), max_gap_s)

    def at(self, time_s: FloatArray) -> FloatArray:
        """(K, 3) linearly interpolated points."""
        return np.stack([np.interp(time_s, self.measured_s, each) for each in self.coordinates_m], axis=1)

    def tracked(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether the measurements before and after times, (K,), are at most the longest gap apart."""
        last = len(self.measured_s) - 1
        after = np.searchsorted(self.measured_s, time_s)
        index = np.minimum(after, last)
        step_s = self.measured_s[index] - self.measured_s[np.maximum(index - 1, 0)]
        inside = (after > 0) & (after <= last) & (step_s <= self.max_gap_s)
        tracked: NDArray[np.bool_] = inside | (self.measured_s[index] == time_s)
        return tracked


def _interpolate_rotation(time_s: FloatArray, valid_s: FloatArray, rotation: FloatArray) -> FloatArray:
    """Interpolate valid rotations to all times at constant angular velocity; constant beyond the ends."""
    if len(valid_s) < 2:
        return np.broadcast_to(rotation[0], (len(time_s), 3, 3)).copy()
    zero = np.zeros((len(valid_s), 3))
    states = States(valid_s, zero, rotation, zero, zero, zero, zero)
    earlier, later, step_s = (
        states.select(slice(None, -1)),
        states.select(slice(1, None)),
        np.diff(valid_s)[:, None],
    )
    rates = rotation_between(earlier, later) / step_s
    # Resolve each rotation's ambiguity by the angular velocities before and after it.
    before, after = np.concatenate([rates[:1], rates[:-1]]), np.concatenate([rates[1:], rates[-1:]])
    rotvecs = rotation_between(
        replace(earlier, angular_velocity=before), replace(later, angular_velocity=after)
    )
    interval = np.clip(np.searchsorted(valid_s, time_s, side="right") - 1, 0, len(rotvecs) - 1)
    since_s = (np.clip(time_s, valid_s[0], valid_s[-1]) - valid_s[interval])[:, None]
    interpolated: FloatArray = rotation[interval] @ exp_so3(since_s / step_s[interval] * rotvecs[interval])
    return interpolated
