"""What a surveyor writes down when he measures targets and prisms by hand: the files of `tsgt calibrate targets` and `prisms`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import ScenarioConfig, level_frame
from tsgt.geometry import cartesian_to_polar, invert, transform_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

SCENARIO = ScenarioConfig()
"""Of the far ends, but for the robot's motion."""

TARGETS_M = (
    (40.0, -20.0, 3.0),
    (95.0, 20.0, -2.0),
    (80.0, 80.0, 4.0),
    (20.0, 70.0, -3.0),
    (-30.0, 25.0, 2.0),
    (5.0, -40.0, 0.0),
)
BODY_M = {
    "front_left": (0.62, 0.31, 0.42),
    "front_right": (0.62, -0.31, 0.42),
    "rear_left": (-0.55, 0.31, 0.42),
    "rear_right": (-0.55, -0.31, 0.42),
    "mast": (-0.2, 0.0, 1.05),
}
WORKSHOP_M = np.array((6.0, 3.0, -1.2))
"""Where the robot stands while its prisms are measured, parallel to the frame of station 1."""

ANGLE_SIGMA_RAD, DISTANCE_SIGMA_M = 5e-6, 0.5e-3
PRISM_CONSTANT_M = 0.010


def targets(seed: int = 1) -> str:
    """Return a target file; constant of the targets: 0."""
    rng = np.random.default_rng(seed)
    lines = ["station,target,horizontal_angle_rad,zenith_angle_rad,slope_distance_m"]
    for station in SCENARIO.stations:
        seen = transform_points(invert(np.array(level_frame(station))), np.array(TARGETS_M))
        lines += [f"{station.station},{n},{_reading(point, rng)}" for n, point in enumerate(seen, 1)]
    return "\n".join(lines) + "\n"


def prisms(seed: int = 2) -> str:
    """Return a file of prisms and body points that station 1 measured; constants: 10 mm and 0."""
    rng = np.random.default_rng(seed)
    lines = ["point,kind,horizontal_angle_rad,zenith_angle_rad,slope_distance_m,x_m,y_m,z_m"]
    for name, place in BODY_M.items():
        lines.append(f"{name},body,{_reading(WORKSHOP_M + place, rng)},{','.join(map(str, place))}")
    for prism in SCENARIO.prisms:
        reading = _reading(WORKSHOP_M + prism.position_m, rng, PRISM_CONSTANT_M)
        lines.append(f"{prism.prism},prism,{reading},,,")
    return "\n".join(lines) + "\n"


def _reading(point_m: NDArray[np.float64], rng: np.random.Generator, constant_m: float = 0.0) -> str:
    horizontal_rad, zenith_rad, distance_m = cartesian_to_polar(point_m)
    angles = rng.normal((horizontal_rad, zenith_rad), ANGLE_SIGMA_RAD)
    return f"{angles[0] % (2 * np.pi):.7f},{angles[1]:.7f},{rng.normal(distance_m, DISTANCE_SIGMA_M) - constant_m:.4f}"
