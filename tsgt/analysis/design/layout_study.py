"""How well a pose is known, before anybody drives: prisms on the robot, stations around it, noise of the instruments.

A robot stands, each station measures its prism once, and the pose that fits these measurements best has a covariance
that follows from geometry and noise alone, to first order. Nothing needs to be drawn or driven. What moving adds
(measurements at different times) and what all measurements share (station frames, prism constants) is not in it.
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

MAX_POINT_DISTANCE_M = 10_000.0
"""No point of a robot is further from its prisms."""

HEADING_COUNT = 8
"""So many headings of the robot at each place, evenly around the circle."""


@dataclass(frozen=True, slots=True)
class Station:
    """A station where it stands.

    Attributes
    ----------
    position_m
        In the world in m, shape (3,).
    noise
        Of one measurement.
    slot
        Which prism it tracks: its index in a layout.
    """

    position_m: FloatArray
    noise: InstrumentNoise
    slot: int

    def __post_init__(self) -> None:
        """Refuse instruments whose measurements would outweigh everything."""
        along, across = max(self.noise.range_sigma_m, self.noise.range_sigma_ppm), self.noise.angle_sigma_rad
        if self.noise.pointing_sigma_m == 0 and (along == 0 or across == 0):
            raise GeometryError(
                "a station measures without noise along or across its line of sight: give its instrument some"
            )


@dataclass(frozen=True, slots=True)
class RobotPoses:
    """N poses in which a level robot stands.

    Attributes
    ----------
    rotation
        ``R_world_robot``, shape (N, 3, 3).
    position_m
        The robot's origin in the world in m, shape (N, 3).
    """

    rotation: FloatArray
    position_m: FloatArray

    @classmethod
    def at(cls, places_m: ArrayLike, headings_rad: ArrayLike | None = None) -> RobotPoses:
        """Stand at each of the places (M, 3) with each of the headings: N = M x headings, place by place."""
        places = np.asarray(places_m, dtype=np.float64)
        if headings_rad is None:
            headings_rad = np.arange(HEADING_COUNT) * (2 * math.pi / HEADING_COUNT)
        turns = np.zeros((np.size(headings_rad), 3))
        turns[:, 2] = headings_rad
        return cls(
            rotation=np.tile(exp_so3(turns), (len(places), 1, 1)),
            position_m=np.repeat(places, len(turns), axis=0),
        )


@dataclass(frozen=True, slots=True)
class PoseAccuracy:
    """How well poses are known; root mean squares over the stances of one sigma.

    Attributes
    ----------
    position_m
        Of the length of the position error in m.
    position_axes_m
        Along x, y, z of the robot in m, shape (3,).
    rotation_rad
        Of the angle of the rotation error in rad.
    rotation_axes_rad
        About x, y, z of the robot in rad, shape (3,).
    worst_position_m, worst_rotation_rad
        The same lengths in the worst of the stances.
    """

    position_m: float
    position_axes_m: FloatArray
    rotation_rad: float
    rotation_axes_rad: FloatArray
    worst_position_m: float
    worst_rotation_rad: float

    @classmethod
    def of(cls, covariance: FloatArray) -> PoseAccuracy:
        """Sum up the covariances (N, 6, 6) of :func:`pose_covariances`."""
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
    """Covariance of the pose from one measurement by each station, all of them weighed by their noise.

    Parameters
    ----------
    layout
        The P >= 3 prisms in the robot frame in m, shape (P, 3).
    stations
        Who measures; several may track one prism, and each prism needs one at least.
    stances
        Where the robot stands.
    point_m
        The point of the robot whose position counts, in the robot frame in m, shape (3,).

    Returns
    -------
    FloatArray
        Shape (N, 6, 6), in the axes of the robot: position of the point in m, small rotation in rad.

    Raises
    ------
    GeometryError
        A layout from which no pose follows, a prism that nobody tracks, or a point that is none of the robot.
    """
    check_layout(layout)
    untracked = set(range(len(layout))) - {station.slot for station in stations}
    if untracked:
        raise GeometryError(
            f"the layout has {len(layout)} prisms for {len(stations)} stations: each prism needs a station of its own"
        )
    away_m = float(np.linalg.norm(point_m - layout.mean(axis=0)))
    if away_m > MAX_POINT_DISTANCE_M:
        raise GeometryError(f"the point is {away_m:g} m from the prisms; give one of the robot, in its frame")
    information = sum(
        prism_information(layout[slot : slot + 1], slot, stations, robot_poses, point_m)[0]
        for slot in range(len(layout))
    )
    covariance: FloatArray = np.linalg.inv(information)
    return covariance


def prism_information(
    places_m: FloatArray,
    slot: int,
    stations: tuple[Station, ...],
    robot_poses: RobotPoses,
    point_m: FloatArray,
) -> FloatArray:
    """Tell what the measurements of one prism say of the pose, for several places where it could sit.

    Parameters
    ----------
    places_m
        In the robot frame in m, shape (M, 3).
    slot
        Which prism it is.
    stations, stances, point_m
        As for :func:`pose_covariances`.

    Returns
    -------
    FloatArray
        Information matrices, shape (M, N, 6, 6), in the order and axes of :func:`pose_covariances`.
    """
    in_world = rotate(robot_poses.rotation, places_m[:, None]) + robot_poses.position_m
    weight = np.zeros((*in_world.shape, 3))
    for station in stations:
        if station.slot != slot:
            continue
        noise = measurement_covariance(*cartesian_to_polar(in_world - station.position_m), station.noise)
        weight += np.linalg.inv(noise)
    to_robot = np.swapaxes(robot_poses.rotation, 1, 2)
    weight = to_robot @ weight @ robot_poses.rotation
    # The prism moves with the point and about it: d = [I, -skew(arm)] (translation, rotation).
    jacobian = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(places_m), 3, 3)), -skew(places_m - point_m)], axis=-1
    )[:, None]
    information: FloatArray = np.swapaxes(jacobian, -1, -2) @ weight @ jacobian
    return information


def station_arrangements(
    stations: tuple[Station, ...], centre_m: FloatArray, distance_m: float
) -> dict[str, tuple[Station, ...]]:
    """Move stations to a distance from the robot: all to one side of it, or evenly around it.

    Parameters
    ----------
    stations
        Where they stand now; the direction of the first one is kept, and so are all heights.
    centre_m
        Where the robot stands in the world in m, shape (3,).
    distance_m
        Horizontal distance in m.

    Returns
    -------
    dict
        The stations ``together`` and ``around``.
    """
    away = stations[0].position_m - centre_m
    bearing = math.atan2(away[1], away[0])
    step = 2 * math.pi / len(stations)
    found = {}
    for name, turn in (("together", 0.0), ("around", step)):
        found[name] = tuple(
            Station(
                position_m=np.array(
                    [
                        centre_m[0] + distance_m * math.cos(bearing + i * turn),
                        centre_m[1] + distance_m * math.sin(bearing + i * turn),
                        station.position_m[2],
                    ]
                ),
                noise=station.noise,
                slot=station.slot,
            )
            for i, station in enumerate(stations)
        )
    return found
