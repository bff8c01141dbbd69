"""Poses and measurements as blocks of narrow lines, in degrees and millimetres."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import click

from tsgt.cli.render import clock_time, yaw_pitch_roll_deg

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.cli.live.status_text import Block
    from tsgt.model import PolarMeasurement
    from tsgt.recording import PoseRecord


def pose_block(pose: PoseRecord) -> Block:
    """Return a pose in lines of at most 40 characters."""
    series = pose.kind if pose.delay_s is None else f"{pose.kind} {pose.delay_s:g} s"
    validity = pose.reason.replace("_", " ").upper() or "INVALID"
    if pose.valid:
        validity = "DEGRADED" if pose.degraded_by else "VALID"
    lines = [click.style(f"{series.upper()}  {validity}", bold=True, reverse=not pose.valid)]
    fit = "" if pose.residual_m is None else f"  fit {1e3 * pose.residual_m:.1f} mm"
    lines.append(f"  {clock_time(pose.stamp_ns)}{fit}")
    if pose.position_m is not None and pose.orientation_xyzw is not None:
        x, y, z = pose.position_m
        yaw, pitch, roll = yaw_pitch_roll_deg(pose.orientation_xyzw)
        lines.append(f"  x {x:.3f}  y {y:.3f}  z {z:.3f} m")
        lines.append(f"  yaw {yaw:.1f}  pitch {pitch:.1f}  roll {roll:.1f} deg")
    if pose.covariance is not None:
        position_m, rotation_rad = worst_sigmas(pose.covariance)
        lines.append(f"  sigma {1e3 * position_m:.1f} mm  {math.degrees(rotation_rad):.3f} deg")
    ages = (
        f"{share.id}: {'-' if share.age_s is None else format(share.age_s, '.1f')}" for share in pose.stations
    )
    lines.append(f"  age in s  {'  '.join(ages)}"[:40])
    return lines


def measurement_block(measurement: PolarMeasurement) -> Block:
    """Return a measurement in lines of at most 40 characters."""
    distance = (
        "no distance" if measurement.slope_distance_m is None else f"{measurement.slope_distance_m:.4f} m"
    )
    headline = f"STATION {measurement.station}  prism {measurement.prism}  {measurement.status}"
    horizontal_deg = math.degrees(measurement.horizontal_angle_rad)
    zenith_deg = math.degrees(measurement.zenith_angle_rad)
    return [
        click.style(headline, bold=True, reverse=not measurement.status.usable),
        f"  {clock_time(measurement.stamp_ns)}  {distance}",
        f"  hz {horizontal_deg:.4f}  v {zenith_deg:.4f} deg",
    ]


def worst_sigmas(covariance: Sequence[float]) -> tuple[float, float]:
    """Return the sigmas of position in m and rotation in rad of a (6x6) covariance, in their least certain directions."""
    position, rotation = (
        [[covariance[6 * (first + row) + first + column] for column in range(3)] for row in range(3)]
        for first in (0, 3)
    )
    return _largest_sigma(position), _largest_sigma(rotation)


def _largest_sigma(matrix: Sequence[Sequence[float]]) -> float:
    """Return the square root of the largest eigenvalue of a symmetric (3, 3) matrix.

    In closed form (O. K. Smith, Eigenvalues of a symmetric 3x3 matrix, 1961), so that numpy need not be loaded.
    """
    # Squares of absurdly large values would overflow.
    scale = max(abs(value) for row in matrix for value in row) or 1.0
    (a, d, e), (_, b, f), (_, _, c) = ([value / scale for value in row] for row in matrix)
    mean = (a + b + c) / 3
    spread = math.sqrt(
        ((a - mean) ** 2 + (b - mean) ** 2 + (c - mean) ** 2 + 2 * (d * d + e * e + f * f)) / 6
    )
    if spread == 0:
        return math.sqrt(max(mean * scale, 0.0))
    a, b, c, d, e, f = (
        (a - mean) / spread,
        (b - mean) / spread,
        (c - mean) / spread,
        d / spread,
        e / spread,
        f / spread,
    )
    half_determinant = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2
    angle = math.acos(max(-1.0, min(1.0, half_determinant))) / 3
    return math.sqrt(max((mean + 2 * spread * math.cos(angle)) * scale, 0.0))
