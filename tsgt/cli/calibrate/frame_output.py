"""A frame on the command line: options, residuals as text and JSON, weak axes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.cli.options import OutputFile, constant_option, path_type
from tsgt.cli.output import numbers, print_table
from tsgt.geometry import cartesian_to_polar

if TYPE_CHECKING:
    from tsgt.geometry.target_calibration import FrameCalibration, WeakAxis

TARGET_CONSTANT = "--target-constant-mm"

file_argument = click.argument("file", type=path_type)
target_constant_option = constant_option(
    TARGET_CONSTANT,
    "Constant added to the distances of targets, required if a line of FILE has no constant_mm.",
)
output_option = click.option("--output", type=OutputFile(".toml"), help="Set-up file to write (.toml).")


def given(option: str, value: float | None) -> str:
    """Return an option as it was given."""
    return "" if value is None else f" {option} {value:g}"


def frame_json(frame: FrameCalibration) -> dict[str, Any]:
    """Return residuals, sigmas and findings for ``--json``."""
    sigmas = np.sqrt(np.diag(frame.covariance))
    return {
        "rms_mm": 1e3 * frame.rms_m,
        "max_mm": 1e3 * frame.max_m,
        "residuals_mm": dict(zip(frame.used, (1e3 * frame.residuals_m).tolist(), strict=True)),
        "leave_one_out_mm": dict(zip(frame.used, (1e3 * frame.leave_one_out_m).tolist(), strict=True)),
        "used": list(frame.used),
        "rejected": [point.name for point in frame.rejected],
        "rejected_miss_mm": {point.name: 1e3 * point.prediction_error_m for point in frame.rejected},
        "consistent": frame.consistent,
        "sigma_mm": (1e3 * sigmas[:3]).tolist(),
        "sigma_mrad": (1e3 * sigmas[3:]).tolist(),
        "weak": [_weak_json(weak) for weak in frame.weak],
        "tilt_mrad": None if frame.tilt_rad is None else 1e3 * frame.tilt_rad,
    }


def _weak_json(weak: WeakAxis) -> dict[str, Any]:
    bearing_deg, elevation_deg = _bearing_and_elevation_deg(weak)
    return {
        "axis": list(weak.axis),
        "bearing_deg": bearing_deg,
        "elevation_deg": elevation_deg,
        "sigma_mrad": 1e3 * weak.sigma_rad,
    }


def _bearing_and_elevation_deg(weak: WeakAxis) -> tuple[float, float]:
    """Return the bearing, clockwise as the horizontal circle, and the elevation from the horizon."""
    horizontal_rad, zenith_rad, _ = cartesian_to_polar(weak.axis)
    return float(np.degrees(horizontal_rad)), float(90 - np.degrees(zenith_rad))


def print_frame(title: str, point: str, frame: FrameCalibration) -> None:
    """Print the residuals of all points."""
    click.echo(
        f"{title}: {len(frame.used)} {point}s used, rms {1e3 * frame.rms_m:.2f} mm, max {1e3 * frame.max_m:.2f} mm"
    )
    rows = [
        [str(name), *numbers(1e3 * residual, 1e3 * held_out)]
        for name, residual, held_out in zip(frame.used, frame.residuals_m, frame.leave_one_out_m, strict=True)
    ]
    rows += [[str(bad.name), "rejected", f"{1e3 * bad.prediction_error_m:.2f}"] for bad in frame.rejected]
    print_table([point, "residual mm", "leave-one-out mm"], rows)


def weak_text(title: str, point: str, weak: WeakAxis, limit_mrad: float) -> str:
    """Return the sentence on a weak axis."""
    bearing, elevation = _bearing_and_elevation_deg(weak)
    return (
        f"{title}: weakly determined: rotation of {1e3 * weak.sigma_rad:.2g} mrad (one sigma, limit {limit_mrad:g}) about the "
        f"direction with bearing {bearing:.1f} and elevation {elevation:.1f} degrees; add {point}s far off the line "
        "in that direction"
    )
