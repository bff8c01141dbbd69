"""Observability of a calibration from motion: directions of the set-up that the motion left uncertain. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.polar import cartesian_to_polar

if TYPE_CHECKING:
    from tsgt.geometry.motion_calibration.calibration import MotionCalibration
    from tsgt.geometry.rigid import FloatArray

TRANSLATION_LIMIT_M = 0.005
ROTATION_LIMIT_RAD = 0.0005
LATENCY_LIMIT_S = 0.005
PRISM_LIMIT_M = 0.005
"""One-sigma limits beyond which a parameter counts as unobservable; the limit is half the prior's sigma if that is smaller."""

MIN_COMPONENT_SHARE = 0.2  # Of a direction's largest; smaller components are not described


def unobservable_directions(calibration: MotionCalibration) -> list[str]:
    """Directions whose uncertainty exceeds the limits, largest first: eigenvectors of the scaled covariance.

    In words: all components of a direction, which change together, by one sigma each.
    """
    parameters = calibration.parameters
    limits = np.full(parameters.count, np.inf)
    limits[parameters.translations] = TRANSLATION_LIMIT_M
    limits[parameters.rotations] = ROTATION_LIMIT_RAD
    limits[parameters.latencies] = LATENCY_LIMIT_S
    limits[parameters.prisms] = PRISM_LIMIT_M
    free = np.flatnonzero(np.isfinite(limits) & (calibration.prior_sigmas > 0))
    scale = np.minimum(limits, 0.5 * calibration.prior_sigmas)[free]
    values, vectors = np.linalg.eigh(calibration.covariance[np.ix_(free, free)] / np.outer(scale, scale))
    directions = []
    for value, free_vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value <= 1.0:
            break
        vector, sigma = np.zeros((2, parameters.count))
        vector[free], sigma[free] = free_vector, np.sqrt(value) * scale * free_vector
        directions.append(_describe(calibration, vector, sigma))
    return directions


def _describe(calibration: MotionCalibration, vector: FloatArray, sigma: FloatArray) -> str:
    """Describe a direction; ``vector`` in units of the limits, ``sigma`` the same in m, rad and s."""
    parameters = calibration.parameters
    # The sign of a direction is arbitrary: make the largest component positive.
    sigma = sigma * (1.0 if vector[np.argmax(np.abs(vector))] >= 0 else -1.0)
    components: list[tuple[float, str]] = []
    for i, station in enumerate(parameters.stations):
        name = f"station {station + 1}"
        shift, turn, late = parameters.translations[i], parameters.rotations[i], parameters.latencies[i]
        if vector[shift].any():
            text = f"{name} shifts by {1e3 * np.linalg.norm(sigma[shift]):.2g} mm {_direction(sigma[shift])}"
            components.append((float(np.linalg.norm(vector[shift])), text))
        if vector[turn].any():
            size_mrad = 1e3 * np.linalg.norm(sigma[turn])
            text = f"{name} turns by {size_mrad:.2g} mrad about {_direction(sigma[turn])}"
            components.append((float(np.linalg.norm(vector[turn])), text))
        if vector[late]:
            components.append((abs(vector[late]), f"{name} is late by {1e3 * sigma[late]:.2g} ms"))
    for prism, at in enumerate(parameters.prisms):
        if vector[at].any():
            x, y, z = 1e3 * sigma[at]
            text = f"prism {prism + 1} moves on the robot by ({x:.2g}, {y:.2g}, {z:.2g}) mm"
            components.append((float(np.linalg.norm(vector[at])), text))
    smallest = MIN_COMPONENT_SHARE * max(weight for weight, _ in components)
    described = sorted((part for part in components if part[0] >= smallest), key=lambda part: -part[0])
    return ", ".join(text for _, text in described)


def _direction(direction: FloatArray) -> str:
    horizontal_rad, zenith_rad, _ = cartesian_to_polar(direction)
    elevation_deg = 90.0 - float(np.degrees(zenith_rad))
    if abs(elevation_deg) > 80.0:
        return "up" if elevation_deg > 0 else "down"
    return f"bearing {float(np.degrees(horizontal_rad)):.0f}, elevation {elevation_deg:.0f} degrees"
