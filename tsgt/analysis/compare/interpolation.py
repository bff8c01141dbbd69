"""The reference between its poses: cubic splines over its valid stretches, with velocity and angular velocity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from tsgt.geometry import quaternion_from_rotation, rotation_from_quaternion

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.trajectories import ReferencePoses
    from tsgt.geometry import FloatArray

MAX_GAP_NS = 210_000_000
"""Poses at 5 Hz, the stamps rounded. At 20 Hz cubic splines are off by micrometres, over this gap by less than 1 mm at 1 m/s^2
that changes within 0.5 s."""


@dataclass(frozen=True, slots=True)
class ReferenceMotion:
    """Poses and motion of the reference's point at N instants; zero where they are not known."""

    known: NDArray[np.bool_]  # (N,)
    rotation: FloatArray  # (N, 3, 3) R_station1_point
    position_m: FloatArray  # (N, 3)
    velocity_mps: FloatArray  # (N, 3) along the axes of station1
    angular_velocity_radps: FloatArray  # (N, 3) about the axes of station1

    @property
    def transform(self) -> FloatArray:
        """``T_station1_point``, (N, 4, 4)."""
        T = np.zeros((len(self.position_m), 4, 4))
        T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = self.rotation, self.position_m, 1.0
        return T


class ReferenceTrajectory:
    """Interpolates a reference between valid poses that are close to each other, and nowhere else.

    Positions and quaternions are cubic splines (the quaternions normalised afterwards): twice continuously differentiable.
    """

    def __init__(self, reference: ReferencePoses) -> None:
        rows = np.flatnonzero(reference.valid)
        self.reference = reference
        self.start_ns = int(reference.stamp_ns[rows[0]]) if len(rows) else 0
        self.end_ns = int(reference.stamp_ns[rows[-1]]) if len(rows) else 0
        self._rows = rows
        self._stamp_ns = reference.stamp_ns[rows]
        # An invalid pose between two valid ones splits them, however close they are.
        apart = (np.diff(rows) > 1) | (np.diff(self._stamp_ns) > MAX_GAP_NS)
        self._joined = ~apart  # (V - 1,) the interval between neighbouring valid poses is covered
        self._coefficients = self._fit(np.split(np.arange(len(rows)), np.flatnonzero(apart) + 1))

    def _fit(self, stretches: list[NDArray[np.intp]]) -> FloatArray:
        """(4, V - 1, 7) polynomials of position and quaternion per interval, highest power first."""
        T = self.reference.T_station1_point[self._rows]
        time_s = self.seconds(self._stamp_ns)
        values = np.concatenate([T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3])], axis=1)
        coefficients = np.zeros((4, max(len(self._rows) - 1, 0), 7))
        for stretch in stretches:
            if len(stretch) < 2:
                continue
            own = values[stretch]
            # q and -q are one rotation: neighbours in a spline have the same sign.
            turns = np.einsum("ij,ij->i", own[1:, 3:], own[:-1, 3:])
            own[1:, 3:] *= np.cumprod(np.where(turns < 0, -1.0, 1.0))[:, None]
            spline = CubicSpline(time_s[stretch], own)
            coefficients[:, stretch[0] : stretch[-1]] = spline.c
        return coefficients

    def seconds(self, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Return instants in s from the first valid pose."""
        return (stamp_ns - self.start_ns) / 1e9

    def covers(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) whether the reference is known at these instants."""
        if len(self._rows) < 2:
            return np.zeros(len(stamp_ns), dtype=np.bool_)
        inside = (stamp_ns >= self.start_ns) & (stamp_ns <= self.end_ns)
        return inside & self._joined[self._interval(stamp_ns)]

    def _interval(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.intp]:
        found = np.searchsorted(self._stamp_ns, stamp_ns, side="right") - 1
        # The last pose of a stretch belongs to the interval that ends there.
        found = np.clip(found, 0, len(self._rows) - 2)
        at_pose = (stamp_ns == self._stamp_ns[found]) & ~self._joined[found] & (found > 0)
        interval: NDArray[np.intp] = found - at_pose
        return interval

    def motion_at(self, stamp_ns: NDArray[np.int64]) -> ReferenceMotion:
        """Return the motion at N instants, anywhere."""
        known = self.covers(stamp_ns)
        n = len(stamp_ns)
        motion = ReferenceMotion(
            known=known,
            rotation=np.zeros((n, 3, 3)),
            position_m=np.zeros((n, 3)),
            velocity_mps=np.zeros((n, 3)),
            angular_velocity_radps=np.zeros((n, 3)),
        )
        if not known.any():
            return motion
        interval = self._interval(stamp_ns[known])
        since_s = ((stamp_ns[known] - self._stamp_ns[interval]) / 1e9)[:, None]
        c3, c2, c1, c0 = self._coefficients[:, interval]
        value = ((c3 * since_s + c2) * since_s + c1) * since_s + c0
        rate = (3.0 * c3 * since_s + 2.0 * c2) * since_s + c1
        length = np.sqrt((value[:, 3:] ** 2).sum(axis=1, keepdims=True))
        q, q_rate = value[:, 3:] / length, rate[:, 3:] / length
        vector, scalar = q[:, :3], q[:, 3:]
        motion.rotation[known] = rotation_from_quaternion(q)
        motion.position_m[known] = value[:, :3]
        motion.velocity_mps[known] = rate[:, :3]
        # Twice the vector part of q_rate times the conjugate of q: the change of length has none.
        motion.angular_velocity_radps[known] = 2.0 * (
            scalar * q_rate[:, :3] - q_rate[:, 3:] * vector - np.cross(q_rate[:, :3], vector)
        )
        return motion

    def covariance_at(self, covariance: FloatArray, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Interpolate the reference's covariances, (N, 6, 6), linearly at K covered instants: (K, 6, 6)."""
        interval = self._interval(stamp_ns)
        step_ns = self._stamp_ns[interval + 1] - self._stamp_ns[interval]
        share = ((stamp_ns - self._stamp_ns[interval]) / step_ns)[:, None, None]
        before, after = covariance[self._rows[interval]], covariance[self._rows[interval + 1]]
        return np.asarray((1.0 - share) * before + share * after)
