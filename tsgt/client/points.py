"""The point that a raw measurement means, with the corrections and the frame of the record ``setup``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsgt.client.records import Measurement, Setup, Vector3

USABLE = ("ok", "low_accuracy")

MIN_SINE = 0.01
"""Sine of the zenith angle below which the collimation error is not corrected, as in the master."""


def measured_point(measurement: Measurement, setup: Setup) -> Vector3 | None:
    """Return the prism's position in the frame of the poses, in m; None where the measurement gives none.

    With instrument errors, prism constant, atmospheric correction and the station's frame; `tsgt.geometry.polar` has the
    same for arrays and needs numpy, which a reader of the stream does without.
    """
    station = next((each for each in setup.stations if each.id == measurement.station), None)
    slope_m = measurement.slope_distance_m
    if station is None or slope_m is None or measurement.status not in USABLE:
        return None
    sine = math.sin(measurement.zenith_angle_rad)
    horizontal = measurement.horizontal_angle_rad
    if abs(sine) >= MIN_SINE:
        horizontal += station.collimation_rad / sine
    zenith = measurement.zenith_angle_rad - station.vertical_index_rad
    distance_m = slope_m * (1 + station.atmospheric_ppm * 1e-6) + station.prism_constant_m
    level_m = distance_m * math.sin(zenith)
    vx, vy, vz = (
        level_m * math.cos(horizontal),
        -level_m * math.sin(horizontal),
        distance_m * math.cos(zenith),
    )
    x, y, z, w = station.orientation_xyzw
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    px, py, pz = station.position_m
    return (
        px + vx + w * tx + y * tz - z * ty,
        py + vy + w * ty + z * tx - x * tz,
        pz + vz + w * tz + x * ty - y * tx,
    )
