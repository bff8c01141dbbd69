"""A small stationary or moving robot seen by three stations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import cartesian_to_polar, exp_so3, invert, transform_from, transform_points
from tsgt.model import (
    Parameters,
    PipelineParameters,
    PolarMeasurement,
    PrismPosition,
    StationParameters,
    Status,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND

LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])
FRAMES = np.array(
    [
        transform_from(exp_so3(np.array([0.0, 0.0, yaw])), np.array(position))
        for yaw, position in ((0.0, (0.0, 0.0, 0.0)), (0.7, (2.0, -1.5, 0.1)), (-1.1, (-1.5, 2.5, -0.2)))
    ]
)

Motion = tuple["NDArray[np.float64]", "NDArray[np.float64]"]


def at_rest(time_s: float) -> Motion:  # noqa: ARG001 (a motion is a function of time)
    """Rotation and position of a stationary robot."""
    return exp_so3(np.array([0.02, -0.01, 0.6])), np.array([30.0, 20.0, -1.0])


def driving(time_s: float) -> Motion:
    """Rotation and position of a robot that drives a curve."""
    yaw = 0.3 * time_s
    return exp_so3(np.array([0.0, 0.0, yaw])), np.array([30.0 + np.sin(yaw), 20.0 - np.cos(yaw), -1.0])


@dataclass(frozen=True)
class Scene:
    """Exact measurements of a moving layout of prisms."""

    parameters: Parameters
    motion: Callable[[float], Motion] = at_rest

    def measure(
        self, station: int, time_s: float, *, delay_s: float = 0.1, status: Status = Status.OK, prism: int = 0
    ) -> PolarMeasurement:
        """Measure a prism (the station's own by default) at a time after the start."""
        parameters = self.parameters.stations[station - 1]
        prism = prism or parameters.prism
        rotation, position = self.motion(time_s)
        in_world = rotation @ LAYOUT[prism - 1] + position
        in_station = transform_points(invert(np.array(parameters.T_station1_station)), in_world)
        horizontal, zenith, distance = cartesian_to_polar(in_station)
        measured_ns = START + round(time_s * SECOND)
        return PolarMeasurement(
            station=station,
            prism=prism,
            sequence=0,
            stamp_ns=measured_ns + parameters.latency_ns,
            received_ns=measured_ns + round(delay_s * SECOND),
            horizontal_angle_rad=float(horizontal),
            zenith_angle_rad=float(zenith),
            slope_distance_m=float(distance) - parameters.prism_constant_m,
            status=status,
            host_time_ns=measured_ns,
        )

    def moving(self, motion: Callable[[float], Motion]) -> Scene:
        """Return the scene with another motion."""
        return replace(self, motion=motion)

    def with_limits(self, **limits: float | str | tuple[int, ...]) -> Scene:
        """Return the scene with other pipeline parameters."""
        pipeline = replace(self.parameters.pipeline, **limits)  # type: ignore[arg-type]
        return replace(self, parameters=replace(self.parameters, pipeline=pipeline))


def with_origin(parameters: Parameters, origin_m: NDArray[np.float64]) -> Parameters:
    """Return parameters with the robot frame's origin moved to a point, (3,) in the old robot frame."""
    prisms = tuple(
        replace(prism, position_m=tuple((np.array(prism.position_m) - origin_m).tolist()))
        for prism in parameters.prisms
    )
    return replace(parameters, prisms=prisms)


def stationary_scene() -> Scene:
    """Three stations around the origin, each with its own yaw, and a stationary robot."""
    return Scene(
        Parameters(
            stations=tuple(
                StationParameters(
                    station=number,
                    prism=number,
                    T_station1_station=tuple(map(tuple, FRAMES[number - 1].tolist())),  # type: ignore[arg-type]
                    prism_constant_m=0.01,
                )
                for number in (1, 2, 3)
            ),
            prisms=tuple(
                PrismPosition(prism=number, position_m=tuple(LAYOUT[number - 1].tolist()))
                for number in (1, 2, 3)
            ),
            pipeline=PipelineParameters(estimator="linear"),
        )
    )
