"""Rotation of an IMU, propagated by its gyro while there is no trajectory. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.inertial.preintegration import preintegrate
from tsgt.geometry.rigid import exp_so3

if TYPE_CHECKING:
    from tsgt.geometry.inertial.anchor import InertialAnchor
    from tsgt.geometry.inertial.preintegration import ContiguousSamples
    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import ImuNoise

ROTATION_MEMORY_S = 300.0
"""How long an initialisation must agree with the rotation from before: if that was wrong itself, no initialisation would be right."""

_ROTATION_AND_BIAS = [3, 4, 5, 9, 10, 11]  # Of the gyro, in the error of a state


class KnownRotation(NamedTuple):
    """Rotation of the IMU and bias of its gyro at a time; valid until ``until_s``."""

    time_s: float
    rotation: FloatArray  # (3, 3) of the IMU
    gyro_bias: FloatArray  # (3,)
    covariance: FloatArray  # (6, 6) of both
    until_s: float

    @classmethod
    def of(cls, anchor: InertialAnchor) -> KnownRotation:
        """Return those that an anchor tells."""
        point, mean = anchor.linearisation_point, anchor.mean[_ROTATION_AND_BIAS]
        time_s = float(point.time_s[0])
        return cls(
            time_s,
            point.rotation[0] @ exp_so3(mean[:3]),
            point.gyro_bias[0] + mean[3:],
            np.asarray(
                np.linalg.inv(anchor.information)[np.ix_(_ROTATION_AND_BIAS, _ROTATION_AND_BIAS)], np.float64
            ),
            time_s + ROTATION_MEMORY_S,
        )

    def propagated(self, samples: ContiguousSamples, time_s: float, noise: ImuNoise) -> KnownRotation:
        """Return them at a later time, by integration of samples."""
        ends = np.array([self.time_s]), np.array([time_s])
        found = preintegrate(samples, *ends, self.gyro_bias, np.zeros(3))
        jacobian, added = np.eye(6), np.zeros((6, 6))
        jacobian[:3, :3], jacobian[:3, 3:] = found.rotation[0].T, found.by_gyro_bias[0, 3:6]
        added[:3, :3] = found.covariance[0, 3:6, 3:6]
        added[3:, 3:] = noise.gyro_bias_walk**2 * (time_s - self.time_s) * np.eye(3)
        return self._replace(
            time_s=time_s,
            rotation=self.rotation @ found.rotation[0],
            covariance=jacobian @ self.covariance @ jacobian.T + added,
        )
