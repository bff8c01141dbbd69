"""What a calibration from motion could not tell: directions in the set-up that the motion left uncertain, in words. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.calibration.motion_parameters import about_axes, deformation_modes
from tsgt.geometry.polar import cartesian_to_polar

if TYPE_CHECKING:
    from tsgt.geometry.calibration.motion import MotionCalibration
    from tsgt.geometry.rigid import FloatArray

SHIFT_LIMIT_M = 0.005
TURN_LIMIT_RAD = 0.0005
LATENCY_LIMIT_S = 0.005
PRISM_LIMIT_M = 0.005
"""One sigma from which something counts as not determined; so does what the motion did not halve."""

SHARE = 0.2
"""Parts of a direction below this share of its largest are not worth a word."""


@dataclass(frozen=True, slots=True)
class UnobservableDirection:
    """A direction in the set-up that the motion left uncertain.

    Attributes
    ----------
    sentence
        Everything in it that changes together, by one sigma each, in words.
    excess
        How many times its uncertainty is above the limit.
    """

    description: str
    excess: float


def unobservable_directions(calibration: MotionCalibration) -> list[UnobservableDirection]:
    """Name what was not determined, the worst first; empty if everything was."""
    unknowns = calibration.unknowns
    limits = np.empty(len(unknowns.sigmas))
    limits[unknowns.translations] = SHIFT_LIMIT_M
    limits[unknowns.rotations] = TURN_LIMIT_RAD
    limits[unknowns.latencies] = LATENCY_LIMIT_S
    limits[unknowns.prisms] = PRISM_LIMIT_M
    limits = np.minimum(limits, 0.5 * unknowns.sigmas)
    values, vectors = np.linalg.eigh(calibration.covariance / np.outer(limits, limits))
    found = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value <= 1.0:
            break
        excess = float(np.sqrt(value))
        found.append(UnobservableDirection(_sentence(calibration, vector, excess * limits * vector), excess))
    return found


def _sentence(calibration: MotionCalibration, vector: FloatArray, sigma: FloatArray) -> str:
    """Put a direction into words; ``vector`` in units of the limits, ``sigma`` the same in m, rad and s."""
    unknowns = calibration.unknowns
    # A direction has no sign of its own: the largest part is told as positive.
    sigma = sigma * (1.0 if vector[np.argmax(np.abs(vector))] >= 0 else -1.0)
    parts: list[tuple[float, str]] = []
    for place, station in enumerate(unknowns.stations):
        if len(unknowns.translations):
            shift, turn = sigma[unknowns.translations[place]], sigma[unknowns.rotations[place]]
            parts.append(
                (
                    float(np.linalg.norm(vector[unknowns.translations[place]])),
                    f"station {station + 1} shifts by {1e3 * np.linalg.norm(shift):.2g} mm {_towards(shift)}",
                )
            )
            parts.append(
                (
                    float(np.linalg.norm(vector[unknowns.rotations[place]])),
                    f"station {station + 1} turns by {1e3 * np.linalg.norm(turn):.2g} mrad about {_towards(about_axes(turn))}",
                )
            )
        if len(unknowns.latencies):
            late = unknowns.latencies[place]
            parts.append((abs(vector[late]), f"station {station + 1} is late by {1e3 * sigma[late]:.2g} ms"))
    if len(unknowns.prisms):
        moved = (deformation_modes(calibration.setup.layout) @ sigma[unknowns.prisms]).reshape(-1, 3)
        weight = float(np.linalg.norm(vector[unknowns.prisms]))
        lengths = np.linalg.norm(moved, axis=1)
        for prism, length in enumerate(lengths):
            x, y, z = 1e3 * moved[prism]
            parts.append(
                (
                    weight * float(length / lengths.max()),
                    f"prism {prism + 1} moves on the robot by ({x:.2g}, {y:.2g}, {z:.2g}) mm",
                )
            )
    largest = max(weight for weight, _ in parts)
    told = sorted((part for part in parts if part[0] >= SHARE * largest), key=lambda part: -part[0])
    return ", ".join(text for _, text in told)


def _towards(direction: FloatArray) -> str:
    horizontal_rad, zenith_rad, _ = cartesian_to_polar(direction)
    elevation_deg = 90.0 - float(np.degrees(zenith_rad))
    if abs(elevation_deg) > 80.0:
        return "up" if elevation_deg > 0 else "down"
    return f"bearing {float(np.degrees(horizontal_rad)):.0f}, elevation {elevation_deg:.0f} degrees"
