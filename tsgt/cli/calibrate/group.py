"""The group ``tsgt calibrate``, with the commands that solve from files: ``targets`` and ``prisms``."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.calibration import solve_prisms, solve_stations, target_residuals
from tsgt.analysis.formats import read_prism_file, read_target_file, write_prism_layout, write_station_frames
from tsgt.cli.calibrate.check import check
from tsgt.cli.calibrate.collect import collect
from tsgt.cli.calibrate.motion import motion
from tsgt.cli.options import OutputFile, constant_m, constant_option, json_option, path_type
from tsgt.cli.output import CHECK_FAILED, numbers, print_json, print_table, refuse_overwrite
from tsgt.geometry import cartesian_to_polar

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from tsgt.geometry import FloatArray
    from tsgt.geometry.calibration import FrameCalibration, WeakAxis

TARGET_CONSTANT = "--target-constant-mm"
PRISM_CONSTANT = "--prism-constant-mm"

file_argument = click.argument("file", type=path_type)
target_constant_option = constant_option(
    TARGET_CONSTANT,
    "Constant added to the distances of targets, required if a line of FILE has no constant_mm.",
)
output_option = click.option("--output", type=OutputFile(".toml"), help="Set-up file to write (.toml).")


@click.group()
def calibrate() -> None:
    """Solve station frames, prism layout and latencies."""


calibrate.add_command(collect)
calibrate.add_command(check)
calibrate.add_command(motion)


@calibrate.command()
@file_argument
@target_constant_option
@click.option(
    "--weights",
    type=click.Choice(["model", "none"]),
    default="model",
    help="Weight targets by the noise of both instruments, or equally (the paper's method).",
)
@click.option("--levelled", is_flag=True, help="Solve heading and position only: all stations are levelled.")
@output_option
@json_option
def targets(
    *,
    file: Path,
    target_constant_mm: float | None,
    weights: str,
    levelled: bool,
    output: Path | None,
    as_json: bool,
) -> int:
    """Solve station frames from common targets.

    FILE is a CSV of targets or the authors' marker file. Exit code 3: the targets are inconsistent and the bad one
    cannot be identified (nothing is written), a frame is weakly determined, or --levelled stations are not level.
    """
    refuse_overwrite([file], output)
    measured = read_target_file(file)
    sights = (sight for seen in measured.measurements.values() for each in seen.values() for sight in each)
    frames = solve_stations(
        measured,
        target_constant_m=constant_m(TARGET_CONSTANT, target_constant_mm, sights, file),
        weighted=weights == "model",
        levelled=levelled,
    )
    if as_json:
        stations = {
            station: {"T_station1_station": frame.T.tolist(), **_frame_json(frame)}
            for station, frame in frames.items()
        }
        print_json({"stations": stations})
    else:
        for station, frame in frames.items():
            _print_frame(f"station {station}", "target", frame)
            x, y, z, roll, pitch, yaw = 1e3 * np.sqrt(np.diag(frame.covariance))
            click.echo(
                f"one sigma: x {x:.2f}, y {y:.2f}, z {z:.2f} mm, "
                f"rotation about x {roll:.3f}, y {pitch:.3f}, z {yaw:.3f} mrad\n"
            )
    for sentence in measured.skipped:
        click.echo(f"note: {sentence}", err=True)
    for station, frame in frames.items():
        _warn(f"station {station}", "target", frame)
    if output is not None and _may_write(output, frames.values()):
        options = f"{_given(TARGET_CONSTANT, target_constant_mm)} --weights {weights}{' --levelled' if levelled else ''}"
        write_station_frames(
            output,
            {1: np.eye(4)} | {station: frame.T for station, frame in frames.items()},
            {station: frame.rms_m for station, frame in frames.items()},
            comment=f"written by tsgt calibrate targets {file}{options}",
            targets={station: target_residuals(frame) for station, frame in frames.items()},
        )
    return _exit_code(frames.values())


@calibrate.command()
@file_argument
@target_constant_option
@constant_option(
    PRISM_CONSTANT,
    "Constant added to the distances of prisms, required if a line of FILE has no constant_mm.",
)
@output_option
@json_option
def prisms(
    *,
    file: Path,
    target_constant_mm: float | None,
    prism_constant_mm: float | None,
    output: Path | None,
    as_json: bool,
) -> int:
    """Solve the prism layout from measurements of one station.

    FILE is a CSV with the prisms and at least three body points whose positions in the robot frame are known from CAD.
    Exit code 3: the body points are inconsistent and the bad one cannot be identified (nothing is written), or the
    robot frame is weakly determined.
    """
    refuse_overwrite([file], output)
    measured = read_prism_file(file)
    bodies, sights = (
        itertools.chain.from_iterable(each.values()) for each in (measured.body, measured.prisms)
    )
    solved = solve_prisms(
        measured,
        target_constant_m=constant_m(TARGET_CONSTANT, target_constant_mm, bodies, file),
        prism_constant_m=constant_m(PRISM_CONSTANT, prism_constant_mm, sights, file),
    )
    positions = {
        int(name): point for name, point in zip(solved.prisms.names, solved.prisms.points_m, strict=True)
    }
    sigmas = {
        int(name): np.sqrt(np.diag(covariance))
        for name, covariance in zip(solved.prisms.names, solved.prisms.covariances_m2, strict=True)
    }
    distances_mm = {
        f"{a}-{b}": 1e3 * float(np.linalg.norm(positions[a] - positions[b]))
        for a, b in itertools.combinations(positions, 2)
    }
    if as_json:
        print_json(
            {
                "prisms": {prism: position.tolist() for prism, position in positions.items()},
                "distances_mm": distances_mm,
                "prism_sigma_mm": {prism: (1e3 * sigma).tolist() for prism, sigma in sigmas.items()},
                **_frame_json(solved.body),
            }
        )
    else:
        _print_prisms(positions, sigmas, distances_mm)
        _print_frame("robot frame", "body point", solved.body)
    _warn("robot frame", "body point", solved.body)
    if output is not None and _may_write(output, [solved.body]):
        options = _given(TARGET_CONSTANT, target_constant_mm) + _given(PRISM_CONSTANT, prism_constant_mm)
        write_prism_layout(
            output, positions, sigmas, comment=f"written by tsgt calibrate prisms {file}{options}"
        )
    return _exit_code([solved.body])


def _given(option: str, constant_mm: float | None) -> str:
    return "" if constant_mm is None else f" {option} {constant_mm:g}"


def _frame_json(frame: FrameCalibration) -> dict[str, Any]:
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


def _print_frame(title: str, point: str, frame: FrameCalibration) -> None:
    click.echo(
        f"{title}: {len(frame.used)} {point}s used, rms {1e3 * frame.rms_m:.2f} mm, max {1e3 * frame.max_m:.2f} mm"
    )
    rows = [
        [str(name), *numbers(1e3 * residual, 1e3 * held_out)]
        for name, residual, held_out in zip(frame.used, frame.residuals_m, frame.leave_one_out_m, strict=True)
    ]
    rows += [[str(bad.name), "rejected", f"{1e3 * bad.prediction_error_m:.2f}"] for bad in frame.rejected]
    print_table([point, "residual mm", "leave-one-out mm"], rows)


def _print_prisms(
    positions: Mapping[int, FloatArray], sigmas: Mapping[int, FloatArray], distances_mm: Mapping[str, float]
) -> None:
    rows = [
        [str(prism), *numbers(*position, digits=4), *numbers(*(1e3 * sigmas[prism]))]
        for prism, position in positions.items()
    ]
    print_table(["prism", "x m", "y m", "z m", "sigma x mm", "y mm", "z mm"], rows)
    click.echo()
    if distances_mm:
        print_table(["pair", "distance mm"], [[pair, f"{mm:.2f}"] for pair, mm in distances_mm.items()])
        click.echo()


def _warn(title: str, point: str, frame: FrameCalibration) -> None:
    """Print the problems of a frame to stderr, one line each."""
    for bad in frame.rejected:
        click.echo(
            f"note: {title}: {point} {bad.name} rejected: it lies {1e3 * bad.prediction_error_m:.1f} mm from its position predicted "
            "by the others; measure it again",
            err=True,
        )
    if not frame.consistent:
        click.echo(
            f"check failed: {title}: the {point}s are inconsistent (rms {1e3 * frame.rms_m:.1f} mm) and the bad one cannot "
            "be identified; measure more, or check constants and levelling",
            err=True,
        )
    for weak in frame.weak:
        bearing, elevation = _bearing_and_elevation_deg(weak)
        click.echo(
            f"check failed: {title}: weakly determined: rotation of {1e3 * weak.sigma_rad:.2g} mrad (one sigma) about the "
            f"direction with bearing {bearing:.1f} and elevation {elevation:.1f} degrees; add {point}s far off the line "
            "in that direction",
            err=True,
        )
    if frame.tilt_rad is not None:
        click.echo(
            f"check failed: {title}: not level with station 1, the {point}s show {1e3 * frame.tilt_rad:.2f} mrad between "
            "the vertical axes; solve without --levelled, or level both and measure again",
            err=True,
        )


def _may_write(output: Path, frames: Iterable[FrameCalibration]) -> bool:
    if all(frame.consistent for frame in frames):
        return True
    click.echo(f"note: {output} is not written, as a frame above is inconsistent", err=True)
    return False


def _exit_code(frames: Iterable[FrameCalibration]) -> int:
    ok = all(frame.consistent and not frame.weak and frame.tilt_rad is None for frame in frames)
    return 0 if ok else CHECK_FAILED
