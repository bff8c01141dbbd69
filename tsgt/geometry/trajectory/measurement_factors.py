"""What a total station says of a robot's trajectory: its range and two angles to a prism as residuals. Pure.

A prism's measurement is compared with where the robot's motion puts the prism at the time of the measurement:
``h(T_1k^-1 T_1R(t) p)``. The range's residual stands along the line of sight; those of the two angles stand across it, as
lengths at the measured distance (horizontally, and in the plane of the zenith angle), so that neither the circle's zero
nor the direction straight up is a special case.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rigid import IDENTITY, FloatArray, cross, dot, exp_and_right_jacobian, matvec, skew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.trajectory.states import States


@dataclass(frozen=True, slots=True)
class Observations:
    """M measurements of prisms, in the order of time.

    Attributes
    ----------
    time_s
        (M,) when they were made, in s from the trajectory's origin of time, the station's latency taken off.
    time_sigma_s
        (M,) one sigma of it.
    points_m
        (M, 3) measured prism in the frame of its station, constants applied.
    sigmas_m
        (M, 3) one sigma along the line of sight, and across it: horizontally, and in the plane of the zenith angle.
    polar
        (M,) angles and a range; otherwise the three coordinates themselves were measured.
    station, prism
        (M,) rows of ``frames`` and ``layout`` that they belong to.
    frames
        (S, 4, 4) ``T_station1_station``.
    layout
        (P, 3) prisms in m, along the axes of the robot, from the point whose motion is looked for.
    """

    time_s: FloatArray
    time_sigma_s: FloatArray
    points_m: FloatArray
    sigmas_m: FloatArray
    polar: NDArray[np.bool_]
    station: NDArray[np.intp]
    prism: NDArray[np.intp]
    frames: FloatArray
    layout: FloatArray

    def __len__(self) -> int:
        return len(self.time_s)

    def select(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Observations:
        """Return some of them."""
        return Observations(
            self.time_s[rows],
            self.time_sigma_s[rows],
            self.points_m[rows],
            self.sigmas_m[rows],
            self.polar[rows],
            self.station[rows],
            self.prism[rows],
            self.frames,
            self.layout,
        )

    def in_world(self) -> FloatArray:
        """(M, 3) measured points in frame ``station1``, in m."""
        frames = self.frames[self.station]
        return matvec(frames[:, :3, :3], self.points_m) + frames[:, :3, 3]


@dataclass(frozen=True, slots=True)
class LinearisedMeasurements:
    """Residuals of M measurements and how they change with the trajectory.

    Attributes
    ----------
    residuals_m
        (M, 3) predicted less measured: along the line of sight, horizontally and vertically across it.
    jacobian
        (M, 3, 18) by the error of the knot's state, in the order of :class:`~tsgt.geometry.trajectory.states.States`.
    by_point
        (M, 3, 3) by the prism's position in frame ``station1``.
    point_m, velocity_mps
        (M, 3) where the trajectory puts the prism at the time of the measurement, and how fast it is there.
    rotation
        (M, 3, 3) of the robot at that time.
    """

    residuals_m: FloatArray
    jacobian: FloatArray
    by_point: FloatArray
    point_m: FloatArray
    velocity_mps: FloatArray
    rotation: FloatArray

    def covariance(self, observations: Observations) -> FloatArray:
        """(M, 3, 3) covariance of the residuals in m^2: the instrument's noise, and uncertain times on a moving prism."""
        moved = matvec(self.by_point, self.velocity_mps) * observations.time_sigma_s[:, None]
        covariance: FloatArray = moved[:, :, None] * moved[:, None, :]
        for axis in range(3):
            covariance[:, axis, axis] += observations.sigmas_m[:, axis] ** 2
        return covariance

    def whitened(self, observations: Observations) -> FloatArray:
        """Residuals and their derivatives in sigmas, (M, 3, 19), the residuals last.

        The covariance is a diagonal one plus the outer product of one vector, whose inverse root has a closed form.
        """
        deviation_m = observations.sigmas_m
        along = matvec(self.by_point, self.velocity_mps) * (observations.time_sigma_s[:, None] / deviation_m)
        root = np.sqrt(1.0 + dot(along, along))
        found = np.empty((len(along), 3, 19))
        np.divide(self.jacobian, deviation_m[:, :, None], out=found[:, :, :18])
        np.divide(self.residuals_m, deviation_m, out=found[:, :, 18])
        found -= (along / (root * (root + 1.0))[:, None])[:, :, None] * (along[:, None] @ found)
        return found


def linearise(observations: Observations, knots: States, at: NDArray[np.intp]) -> LinearisedMeasurements:
    """Compare measurements with a trajectory.

    Parameters
    ----------
    observations
        M measurements.
    knots
        The trajectory.
    at
        (M,) which knot each measurement is near; from there the robot's velocity and acceleration carry to its time.

    Returns
    -------
    Linearised
        Exact derivatives; see ``docs/explanation/continuous-trajectory.md``.
    """
    delta_s = (observations.time_s - knots.time_s[at])[:, None]
    half = 0.5 * delta_s**2
    arm = observations.layout[observations.prism]
    near = knots.select(at)
    turned, by_turned = exp_and_right_jacobian(
        near.angular_velocity * delta_s + near.angular_acceleration * half
    )
    rotation = near.rotation @ turned
    point = near.position + near.velocity * delta_s + near.acceleration * half + matvec(rotation, arm)
    rate = near.angular_velocity + near.angular_acceleration * delta_s
    velocity = near.velocity + near.acceleration * delta_s + matvec(rotation, cross(rate, arm))
    residuals, by_point = _compared(observations, point)
    jacobian = np.empty((len(observations), 3, 18))
    by_rotation_then = -by_point @ rotation @ skew(arm)
    by_turn = by_rotation_then @ by_turned
    jacobian[:, :, 0:3] = by_point
    jacobian[:, :, 3:6] = by_rotation_then @ np.swapaxes(turned, 1, 2)
    jacobian[:, :, 6:9] = by_point * delta_s[:, None]
    jacobian[:, :, 9:12] = by_turn * delta_s[:, None]
    jacobian[:, :, 12:15] = by_point * half[:, None]
    jacobian[:, :, 15:18] = by_turn * half[:, None]
    return LinearisedMeasurements(residuals, jacobian, by_point, point, velocity, rotation)


def _compared(observations: Observations, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of predicted points in frame ``station1``, (M, 3), and their derivatives by these, (M, 3, 3)."""
    frames = observations.frames[observations.station]
    to_station = np.swapaxes(frames[:, :3, :3], 1, 2)
    predicted = matvec(to_station, point - frames[:, :3, 3])
    measured = observations.points_m
    residuals = predicted - measured
    by_predicted = np.repeat(IDENTITY[None], len(point), axis=0)
    polar = slice(None) if observations.polar.all() else observations.polar
    if observations.polar.any():
        axes, measured_m = line_of_sight_axes(measured[polar])
        seen = predicted[polar]
        distance_m = np.sqrt(dot(seen, seen))
        away_m = np.where(distance_m > 0, distance_m, 1.0)
        direction = seen / away_m[:, None]
        residuals[polar, 0] = distance_m - measured_m
        residuals[polar, 1:] = measured_m[:, None] * matvec(axes, direction)[:, 1:]
        shrink = (measured_m / away_m)[:, None, None]
        away = axes[:, 1:] - (axes[:, 1:] @ direction[:, :, None]) * direction[:, None, :]
        by_predicted[polar, 0] = direction
        by_predicted[polar, 1:] = shrink * away
    return residuals, by_predicted @ to_station


def line_of_sight_axes(points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Give unit vectors along and across the lines of sight to points in the station frame.

    Parameters
    ----------
    points_m
        (M, 3).

    Returns
    -------
    axes : FloatArray
        (M, 3, 3) rows: along, horizontally across (growing horizontal angle), across with growing zenith angle.
    distance_m : FloatArray
        (M,).
    """
    distance_m = np.sqrt(dot(points_m, points_m))
    # A distance that the prism constant makes zero has no direction; any will do, but the numbers must stay numbers.
    there = distance_m[:, None] > 0
    along = np.where(there, points_m, [1.0, 0.0, 0.0]) / np.where(there, distance_m[:, None], 1.0)
    flat = np.hypot(along[:, 0], along[:, 1])
    upright = flat == 0
    safe = flat + upright
    cosine, sine = along[:, 0] / safe + upright, along[:, 1] / safe
    axes = np.zeros((len(along), 3, 3))
    axes[:, 0] = along
    # Horizontal angles grow clockwise, seen from above.
    axes[:, 1, 0], axes[:, 1, 1] = sine, -cosine
    axes[:, 2, 0], axes[:, 2, 1], axes[:, 2, 2] = along[:, 2] * cosine, along[:, 2] * sine, -flat
    return axes, distance_m
