"""First-order accuracy of a pose: prisms on the robot, stations around it, instrument noise. Sans-I/O.

Each station measures its prism once while the robot is stationary; the covariance of the weighted least-squares pose
follows from geometry and noise. Not included: errors due to motion (measurements at different times) and errors that all
measurements share (station frames, prism constants).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry import cartesian_to_polar, check_layout, exp_so3, measurement_covariance, rotate, skew

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from tsgt.geometry import FloatArray
    from tsgt.model import InstrumentNoise

MAX_POINT_DISTANCE_M = 10_000.0  # Upper limit of the distance between the evaluated point and the prisms
HEADING_COUNT = 8  # Number of headings of the robot at each place, evenly around the circle


@dataclass(frozen=True, slots=True)
class Station:
    """A station at ``position_m`` in the world, (3,), with single-measurement noise and its prism's index in the layout."""

    position_m: FloatArray
    noise: InstrumentNoise
    prism_index: int

    def __post_init__(self) -> None:
        """Reject noise-free instruments, whose weight would be infinite."""
        along, across = max(self.noise.range_sigma_m, self.noise.range_sigma_ppm), self.noise.angle_sigma_rad
        if self.noise.pointing_sigma_m == 0 and (along == 0 or across == 0):
            raise GeometryError(
                "a station has no noise along or across its line of sight: give its instrument some"
            )


@dataclass(frozen=True, slots=True)
class RobotPoses:
    """N poses of a level robot: ``R_world_robot``, (N, 3, 3), and the robot's origin in the world, (N, 3)."""

    rotation: FloatArray
    position_m: FloatArray

    @classmethod
    def at(cls, places_m: ArrayLike, headings_rad: ArrayLike | None = None) -> RobotPoses:
        """Combine each place, (M, 3), with each heading: N = M x headings, place by place."""
        places = np.asarray(places_m, dtype=np.float64)
        if headings_rad is None:
            headings_rad = np.arange(HEADING_COUNT) * (2 * math.pi / HEADING_COUNT)
        rotation_vectors = np.zeros((np.size(headings_rad), 3))
        rotation_vectors[:, 2] = headings_rad
        return cls(
            rotation=np.tile(exp_so3(rotation_vectors), (len(places), 1, 1)),
            position_m=np.repeat(places, len(rotation_vectors), axis=0),
        )


@dataclass(frozen=True, slots=True)
class PoseAccuracy:
    """Root mean squares over N robot poses of one sigma: norm of the position error, angle of the rotation error.

    ``axes``: along and about x, y, z of the robot, (3,). ``worst``: norm and angle at the worst of the robot poses.
    """

    position_m: float
    position_axes_m: FloatArray
    rotation_rad: float
    rotation_axes_rad: FloatArray
    worst_position_m: float
    worst_rotation_rad: float

    @classmethod
    def of(cls, covariance: FloatArray) -> PoseAccuracy:
        """Summarise the covariances (N, 6, 6) of :func:`pose_covariances`."""
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        position, rotation = variances[:, :3], variances[:, 3:]
        return cls(
            position_m=math.sqrt(position.sum(axis=1).mean()),
            position_axes_m=np.sqrt(position.mean(axis=0)),
            rotation_rad=math.sqrt(rotation.sum(axis=1).mean()),
            rotation_axes_rad=np.sqrt(rotation.mean(axis=0)),
            worst_position_m=math.sqrt(position.sum(axis=1).max()),
            worst_rotation_rad=math.sqrt(rotation.sum(axis=1).max()),
        )


def pose_covariances(
    layout: FloatArray, stations: tuple[Station, ...], robot_poses: RobotPoses, point_m: FloatArray
) -> FloatArray:
    """Return (N, 6, 6) of the pose from one measurement by each station: position of the point (m), rotation vector (rad).

    Axes of the robot. ``layout``: P >= 3 prisms, (P, 3), and ``point_m``: the evaluated point, (3,), in the robot frame in
    m. Raises GeometryError if the layout determines no pose, a prism has no station, or the point is far from the robot.
    """
    check_layout(layout)
    untracked = set(range(len(layout))) - {station.prism_index for station in stations}
    if untracked:
        raise GeometryError(
            f"the layout has {len(layout)} prisms for {len(stations)} stations: each prism needs a station of its own"
        )
    distance_m = float(np.linalg.norm(point_m - layout.mean(axis=0)))
    if distance_m > MAX_POINT_DISTANCE_M:
        raise GeometryError(
            f"the point is {distance_m:g} m from the prisms; give one of the robot, in its frame"
        )
    information = sum(
        prism_information(layout[prism_index : prism_index + 1], prism_index, stations, robot_poses, point_m)[
            0
        ]
        for prism_index in range(len(layout))
    )
    covariance: FloatArray = np.linalg.inv(information)
    return covariance


def prism_information(
    places_m: FloatArray,
    prism_index: int,
    stations: tuple[Station, ...],
    robot_poses: RobotPoses,
    point_m: FloatArray,
) -> FloatArray:
    """Return the Fisher information (M, N, 6, 6) about the pose in one prism's measurements, at M candidate places of it.

    ``places_m``: (M, 3) in the robot frame. All else is as for :func:`pose_covariances`.
    """
    in_world = rotate(robot_poses.rotation, places_m[:, None]) + robot_poses.position_m
    weight = np.zeros((*in_world.shape, 3))
    for station in stations:
        if station.prism_index != prism_index:
            continue
        noise = measurement_covariance(*cartesian_to_polar(in_world - station.position_m), station.noise)
        weight += np.linalg.inv(noise)
    to_robot = np.swapaxes(robot_poses.rotation, 1, 2)
    weight = to_robot @ weight @ robot_poses.rotation
    # Displacement of the prism: [I, -skew(lever arm)] (translation, rotation).
    jacobian = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(places_m), 3, 3)), -skew(places_m - point_m)], axis=-1
    )[:, None]
    information: FloatArray = np.swapaxes(jacobian, -1, -2) @ weight @ jacobian
    return information


def station_arrangements(
    stations: tuple[Station, ...], centre_m: FloatArray, distance_m: float
) -> dict[str, tuple[Station, ...]]:
    """Move stations to a horizontal distance from the robot: all to one side (``together``), or evenly around it (``around``).

    The direction of the first station and the heights of all are kept.
    """
    offset = stations[0].position_m - centre_m
    bearing = math.atan2(offset[1], offset[0])
    arrangements = {}
    for name, step in (("together", 0.0), ("around", 2 * math.pi / len(stations))):
        arrangements[name] = tuple(
            Station(
                position_m=np.array(
                    [
                        centre_m[0] + distance_m * math.cos(bearing + i * step),
                        centre_m[1] + distance_m * math.sin(bearing + i * step),
                        station.position_m[2],
                    ]
                ),
                noise=station.noise,
                prism_index=station.prism_index,
            )
            for i, station in enumerate(stations)
        )
    return arrangements
