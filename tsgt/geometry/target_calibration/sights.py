"""A rejected sight of a target: its displacement with covariance, and whether the target moved or the station erred."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.target_calibration.network import linearise

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.target_calibration.adjustment import NetworkCalibration
    from tsgt.geometry.target_calibration.causes import Cause
    from tsgt.model import InstrumentNoise

READINGS = ("distance", "horizontal angle", "vertical angle")
AIM, MOVED = "aim", "moved"


@dataclass(frozen=True, slots=True, eq=False)
class SightError:
    """Place of a target as one station measured it, less that on which the others agree."""

    displacement_m: FloatArray  # (3,) along, clockwise and upwards across the line of sight
    covariance_m2: FloatArray  # (3, 3), of noise, frames, instrument errors and the others' place
    elevation_rad: float  # Of the line of sight

    def probabilities(self) -> Mapping[str, float]:
        """Probability of each explanation: a reading of ``READINGS`` is wrong, ``AIM``: a point beside the target, ``MOVED``.

        The station erred as likely as the target moved, in either horizontally as likely as in any direction, and all sizes
        alike; the directions decide. A point beside the target is at its distance.
        """
        along, across, up = np.eye(3)
        level = math.cos(self.elevation_rad) * along - math.sin(self.elevation_rad) * up
        densities = {name: self._density(axis) / 8 for name, axis in zip(READINGS, np.eye(3), strict=True)}
        densities[AIM] = self._density(across, up) / 8
        densities[MOVED] = self._density(level, across) / 4 + self._density(along, across, up) / 4
        total = sum(densities.values())
        return {name: density / total for name, density in densities.items()}

    def _density(self, *axes: FloatArray) -> float:
        """Density of the displacement for directions uniform in the space of these axes, up to a factor common to all."""
        basis = np.stack(axes, axis=1)
        information = np.linalg.inv(self.covariance_m2)
        normal = basis.T @ information @ basis
        projected = basis.T @ information @ self.displacement_m
        squared = float(
            self.displacement_m @ information @ self.displacement_m
            - projected @ np.linalg.solve(normal, projected)
        )
        size_m = float(np.linalg.norm(self.displacement_m))
        # Two points, a circle, a sphere
        surface = (2.0, 2 * math.pi * size_m, 4 * math.pi * size_m**2)[len(axes) - 1]
        scale = math.sqrt((2 * math.pi) ** (len(axes) - 3) / float(np.linalg.det(normal)))
        return scale * math.exp(-squared / 2) / surface


def sight_error(calibration: NetworkCalibration, cause: Cause, noise: InstrumentNoise) -> SightError | None:
    """Return the error of a rejected sight; None if no sight of its target is left in the solution."""
    readings, linear, network = calibration.readings, calibration.linear, calibration.network
    assert cause.target is not None  # noqa: S101 (of a sight)
    of_target = linear.target == cause.target
    if not of_target.any():
        return None
    own = readings.select((readings.target == cause.target) & (readings.station == cause.station))
    sigmas_m = own.sigmas_m(noise)
    predicted = linearise(own, network, dict.fromkeys(linear.active, np.inf), noise)
    # The place follows the frames: dp = K da.
    place = linear.point_covariances_m2[cause.target]
    follows = -place @ np.einsum("nij,nia->ja", linear.B[of_target], linear.columns(linear.active)[of_target])
    by_place = np.mean(sigmas_m[:, :, None] * predicted.B, axis=0)
    by_frames = np.mean(sigmas_m[:, :, None] * predicted.columns(linear.active), axis=0) + by_place @ follows
    covariance = (
        np.diag(np.mean(sigmas_m**2, axis=0)) / len(sigmas_m)
        + by_frames @ linear.covariance @ by_frames.T
        + by_place @ place @ by_place.T
    )
    up = np.array([1.0, 1.0, -1.0])  # The third axis of the readings is downwards
    line = network.points_m[cause.target] - network.translation_m[cause.station]
    return SightError(
        displacement_m=up * np.mean(sigmas_m * predicted.y, axis=0),
        covariance_m2=calibration.scale**2 * np.outer(up, up) * covariance,
        elevation_rad=math.asin(float(line[2] / np.linalg.norm(line))),
    )
