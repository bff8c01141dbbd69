"""Kinematics of a rigid body: pose, velocity, acceleration, angular rate and angular acceleration at N instants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import rotate

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """Motion of a body at N instants; its origin in frame ``station1``, its rotation in its own axes."""

    rotation: NDArray[np.float64]  # (N, 3, 3): takes coordinates in the axes of the body to ``station1``
    position_m: NDArray[np.float64]  # (N, 3)
    velocity_mps: NDArray[np.float64]  # (N, 3)
    acceleration_mps2: NDArray[np.float64]  # (N, 3)
    angular_rate_radps: NDArray[np.float64]  # (N, 3) against ``station1``
    angular_acceleration_radps2: NDArray[np.float64]  # (N, 3)

    def at_point(
        self,
        position_m: NDArray[np.float64],
        velocity_mps: NDArray[np.float64] | None = None,
        acceleration_mps2: NDArray[np.float64] | None = None,
    ) -> RigidMotion:
        """Return the motion of a point of the body, (3,) in its axes, or of one that moves in it, (N, 3) each; same axes."""
        rate = self.angular_rate_radps
        arm = np.broadcast_to(position_m, rate.shape)
        along = np.cross(rate, arm)
        velocity = along
        acceleration = np.cross(self.angular_acceleration_radps2, arm) + np.cross(rate, along)
        if velocity_mps is not None:
            velocity = velocity + velocity_mps
            acceleration = acceleration + 2.0 * np.cross(rate, velocity_mps)
        if acceleration_mps2 is not None:
            acceleration = acceleration + acceleration_mps2
        return RigidMotion(
            self.rotation,
            self.position_m + rotate(self.rotation, arm),
            self.velocity_mps + rotate(self.rotation, velocity),
            self.acceleration_mps2 + rotate(self.rotation, acceleration),
            rate,
            self.angular_acceleration_radps2,
        )

    def turned(
        self,
        rotation: NDArray[np.float64],
        rate_radps: NDArray[np.float64],
        acceleration_radps2: NDArray[np.float64],
    ) -> RigidMotion:
        """Return the motion of axes that turn against those of the body about the same origin.

        ``rotation`` (N, 3, 3) takes coordinates in the new axes to those of the body; its rate and angular acceleration,
        (N, 3) each, are given in the new axes.
        """
        back = np.swapaxes(rotation, 1, 2)
        rate = rotate(back, self.angular_rate_radps)
        return RigidMotion(
            self.rotation @ rotation,
            self.position_m,
            self.velocity_mps,
            self.acceleration_mps2,
            rate + rate_radps,
            rotate(back, self.angular_acceleration_radps2) - np.cross(rate_radps, rate) + acceleration_radps2,
        )


def rotation_from_euler(
    yaw: NDArray[np.float64], pitch: NDArray[np.float64], roll: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotation about z by yaw, then about the new y by pitch, then about the new x by roll: (N, 3, 3)."""
    cy, sy = np.cos(yaw), np.sin(yaw)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    rotation = np.empty((*yaw.shape, 3, 3))
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    for i, row in enumerate(rows):
        for j, column in enumerate(row):
            rotation[..., i, j] = column
    return rotation


def euler_rates(
    angles_rad: NDArray[np.float64],
    rates_radps: NDArray[np.float64],
    accelerations_radps2: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return angular rate and angular acceleration in the axes of the body, (N, 3) each.

    Angles and their first and second derivatives, (N, 3) each: yaw, pitch, roll as in :func:`rotation_from_euler`.
    Titterton and Weston, Strapdown Inertial Navigation Technology, 2nd edition, section 3.6.3, and its derivative.
    """
    _, pitch, roll = angles_rad.T
    yaw1, pitch1, roll1 = rates_radps.T
    yaw2, pitch2, roll2 = accelerations_radps2.T
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    rate = np.stack([roll1 - yaw1 * sp, pitch1 * cr + yaw1 * cp * sr, yaw1 * cp * cr - pitch1 * sr], axis=1)
    acceleration = np.stack(
        [
            roll2 - yaw2 * sp - yaw1 * pitch1 * cp,
            pitch2 * cr
            - pitch1 * roll1 * sr
            + yaw2 * cp * sr
            - yaw1 * pitch1 * sp * sr
            + yaw1 * roll1 * cp * cr,
            yaw2 * cp * cr
            - yaw1 * pitch1 * sp * cr
            - yaw1 * roll1 * cp * sr
            - pitch2 * sr
            - pitch1 * roll1 * cr,
        ],
        axis=1,
    )
    return rate, acceleration
