"""Measurement factors: residuals and Jacobians of polar prism measurements. Sans-I/O.

The measurement model is ``h(T_1k^-1 T_1R(t) p)`` at the time t of the measurement. The range residual lies along the line of
sight; the two angle residuals are expressed as lengths across it at the measured distance (horizontally, and in the plane
of the zenith angle), so that neither the circle's zero nor the vertical is singular.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import IDENTITY, FloatArray, cross, dot, exp_and_right_jacobian, matvec, skew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.trajectory.states import States


@dataclass(frozen=True, slots=True)
class Observations:
    """M prism measurements, in the order of time."""

    time_s: FloatArray  # (M,) from the trajectory's time origin, corrected for the station's latency
    time_sigma_s: FloatArray  # (M,)
    # (M, 3) measured prism in the station frame, prism constant and atmospheric correction applied
    points_m: FloatArray
    # (M, 3) along the line of sight, horizontally across it, and across it in the plane of the zenith angle
    sigmas_m: FloatArray
    polar: NDArray[np.bool_]  # (M,) range and angles were measured; otherwise Cartesian coordinates
    station: NDArray[np.intp]  # (M,) row of ``frames``
    prism: NDArray[np.intp]  # (M,) row of ``layout``
    frames: FloatArray  # (S, 4, 4) ``T_station1_station``
    layout: FloatArray  # (P, 3) prisms in m, in the axes of the robot, from the reference point of the states

    def __len__(self) -> int:
        return len(self.time_s)

    def select(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Observations:
        """Return the measurements of some rows."""
        names = (name for name in Observations.__slots__ if name not in ("frames", "layout"))
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def in_world(self) -> FloatArray:
        """(M, 3) measured points in frame ``station1`` in m."""
        frames = self.frames[self.station]
        return matvec(frames[:, :3, :3], self.points_m) + frames[:, :3, 3]


@dataclass(frozen=True, slots=True)
class LinearisedMeasurements:
    """Residuals and Jacobians of M measurements."""

    # (M, 3) predicted minus measured: along the line of sight, horizontally and vertically across it
    residuals_m: FloatArray
    jacobian: FloatArray  # (M, 3, 18) by the error of the knot's state
    by_point: FloatArray  # (M, 3, 3) by the prism's position in frame ``station1``
    point_m: FloatArray  # (M, 3) predicted position of the prism at the time of the measurement
    velocity_mps: FloatArray  # (M, 3)
    rotation: FloatArray  # (M, 3, 3) of the robot at that time

    def covariance(self, observations: Observations) -> FloatArray:
        """(M, 3, 3) covariance of the residuals in m^2: instrument noise plus time noise times the prism's velocity."""
        by_time = matvec(self.by_point, self.velocity_mps) * observations.time_sigma_s[:, None]
        covariance: FloatArray = by_time[:, :, None] * by_time[:, None, :]
        for axis in range(3):
            covariance[:, axis, axis] += observations.sigmas_m[:, axis] ** 2
        return covariance

    def whitened(self, observations: Observations) -> FloatArray:
        """Whitened Jacobians and residuals, (M, 3, 19), the residuals last: the covariance is diagonal plus rank one."""
        sigmas_m = observations.sigmas_m
        by_time = matvec(self.by_point, self.velocity_mps) * (observations.time_sigma_s[:, None] / sigmas_m)
        root = np.sqrt(1.0 + dot(by_time, by_time))
        whitened = np.empty((len(by_time), 3, 19))
        np.divide(self.jacobian, sigmas_m[:, :, None], out=whitened[:, :, :18])
        np.divide(self.residuals_m, sigmas_m, out=whitened[:, :, 18])
        whitened -= (by_time / (root * (root + 1.0))[:, None])[:, :, None] * (by_time[:, None] @ whitened)
        return whitened


def linearise(
    observations: Observations, knots: States, knot_index: NDArray[np.intp]
) -> LinearisedMeasurements:
    """Residuals and exact Jacobians of measurements at a trajectory.

    Each measurement is attached to knot ``knot_index``, (M,); a constant acceleration propagates from there to its time.
    docs/explanation/continuous-trajectory.md derives the Jacobians.
    """
    delta_s = (observations.time_s - knots.time_s[knot_index])[:, None]
    lever_arm = observations.layout[observations.prism]
    states = knots.select(knot_index)
    if not delta_s.any():
        return _linearise_at_knots(observations, states, lever_arm)
    half_delta_s2 = 0.5 * delta_s**2
    delta_R, J_r, rotation, point, velocity = _propagated(states, delta_s, lever_arm)
    residuals, by_point = _residuals_by_point(observations, point)
    jacobian = np.empty((len(observations), 3, 18))
    by_rotation = -by_point @ rotation @ skew(lever_arm)
    by_delta_rotation = by_rotation @ J_r
    jacobian[:, :, 0:3] = by_point
    jacobian[:, :, 3:6] = by_rotation @ delta_R.swapaxes(1, 2)
    jacobian[:, :, 6:9] = by_point * delta_s[:, None]
    jacobian[:, :, 9:12] = by_delta_rotation * delta_s[:, None]
    jacobian[:, :, 12:15] = by_point * half_delta_s2[:, None]
    jacobian[:, :, 15:18] = by_delta_rotation * half_delta_s2[:, None]
    return LinearisedMeasurements(residuals, jacobian, by_point, point, velocity, rotation)


def squared_distances_at(
    observations: Observations, knots: States, knot_index: NDArray[np.intp]
) -> FloatArray:
    """(M,) squared Mahalanobis distances of measurements from a trajectory, without the Jacobians of :func:`linearise`."""
    delta_s = (observations.time_s - knots.time_s[knot_index])[:, None]
    lever_arm = observations.layout[observations.prism]
    *_, point, velocity = _propagated(knots.select(knot_index), delta_s, lever_arm)
    residuals_m, by_point = _residuals_by_point(observations, point)
    sigmas_m = observations.sigmas_m
    by_time = matvec(by_point, velocity) * (observations.time_sigma_s[:, None] / sigmas_m)
    residuals = residuals_m / sigmas_m
    # The covariance is diagonal plus rank one.
    along = dot(by_time, residuals)
    distances: FloatArray = dot(residuals, residuals) - along**2 / (1.0 + dot(by_time, by_time))
    return distances


def _propagated(
    states: States, delta_s: FloatArray, lever_arm: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Rotation since M states, (M, 3, 3), its right Jacobian, rotation then, and position and velocity of prisms, (M, 3)."""
    half_delta_s2 = 0.5 * delta_s**2
    delta_R, J_r = exp_and_right_jacobian(
        states.angular_velocity * delta_s + states.angular_acceleration * half_delta_s2
    )
    rotation = states.rotation @ delta_R
    point = (
        states.position
        + states.velocity * delta_s
        + states.acceleration * half_delta_s2
        + matvec(rotation, lever_arm)
    )
    angular_velocity = states.angular_velocity + states.angular_acceleration * delta_s
    velocity = (
        states.velocity + states.acceleration * delta_s + matvec(rotation, cross(angular_velocity, lever_arm))
    )
    return delta_R, J_r, rotation, point, velocity


def _linearise_at_knots(
    observations: Observations, states: States, lever_arm: FloatArray
) -> LinearisedMeasurements:
    """Linearise measurements at exactly the times of their states: the same to the last bit, with half of the numpy calls."""
    rotation = states.rotation
    point = states.position + matvec(rotation, lever_arm)
    velocity = states.velocity + matvec(rotation, cross(states.angular_velocity, lever_arm))
    residuals, by_point = _residuals_by_point(observations, point)
    jacobian = np.zeros((len(observations), 3, 18))
    jacobian[:, :, 0:3] = by_point
    jacobian[:, :, 3:6] = -by_point @ rotation @ skew(lever_arm)
    return LinearisedMeasurements(residuals, jacobian, by_point, point, velocity, rotation)


def _residuals_by_point(observations: Observations, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of predicted points in frame ``station1``, (M, 3), and their Jacobians by the points, (M, 3, 3)."""
    frames = observations.frames[observations.station]
    to_station = frames[:, :3, :3].swapaxes(1, 2)
    predicted = matvec(to_station, point - frames[:, :3, 3])
    measured = observations.points_m
    residuals = predicted - measured
    all_polar = bool(observations.polar.all())
    by_predicted = (
        np.empty((len(point), 3, 3)) if all_polar else np.repeat(IDENTITY[None], len(point), axis=0)
    )
    polar = slice(None) if all_polar else observations.polar
    if all_polar or observations.polar.any():
        axes, measured_m = line_of_sight_axes(measured[polar])
        line_of_sight_m = predicted[polar]
        distance_m = np.sqrt(dot(line_of_sight_m, line_of_sight_m))
        safe_distance_m = np.where(distance_m > 0, distance_m, 1.0)
        direction = line_of_sight_m / safe_distance_m[:, None]
        residuals[polar, 0] = distance_m - measured_m
        residuals[polar, 1:] = measured_m[:, None] * matvec(axes, direction)[:, 1:]
        scale = (measured_m / safe_distance_m)[:, None, None]
        transverse = axes[:, 1:] - (axes[:, 1:] @ direction[:, :, None]) * direction[:, None, :]
        by_predicted[polar, 0] = direction
        by_predicted[polar, 1:] = scale * transverse
    return residuals, by_predicted @ to_station


def line_of_sight_axes(points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors of the lines of sight to points, (M, 3), as rows of (M, 3, 3), and the distances, (M,).

    In the station frame: along, and across in the directions of growing horizontal angle and of growing zenith angle.
    """
    distance_m = np.sqrt(dot(points_m, points_m))
    # A corrected distance of zero has no direction: any unit vector avoids NaN.
    nonzero = distance_m[:, None] > 0
    along = np.where(nonzero, points_m, [1.0, 0.0, 0.0]) / np.where(nonzero, distance_m[:, None], 1.0)
    horizontal = np.hypot(along[:, 0], along[:, 1])
    vertical = horizontal == 0
    safe = horizontal + vertical
    cosine, sine = along[:, 0] / safe + vertical, along[:, 1] / safe
    axes = np.zeros((len(along), 3, 3))
    axes[:, 0] = along
    # Horizontal angles grow clockwise, seen from above.
    axes[:, 1, 0], axes[:, 1, 1] = sine, -cosine
    axes[:, 2, 0], axes[:, 2, 1], axes[:, 2, 2] = along[:, 2] * cosine, along[:, 2] * sine, -horizontal
    return axes, distance_m


def time_order(held: Observations, new: Observations) -> NDArray[np.intp]:
    """Sorting index of both, concatenated, by time, then prism, then station."""
    keys = [(getattr(held, name), getattr(new, name)) for name in ("station", "prism", "time_s")]
    return np.lexsort([np.concatenate(pair) for pair in keys])


def merge_observations(held: Observations | None, new: Observations) -> Observations:
    """Merge measurements of the same frames and layout in the order of time."""
    if held is None:
        return new
    names = [name for name in Observations.__slots__ if name not in ("frames", "layout")]
    order = time_order(held, new)
    return replace(
        held, **{name: np.concatenate([getattr(held, name), getattr(new, name)])[order] for name in names}
    )
