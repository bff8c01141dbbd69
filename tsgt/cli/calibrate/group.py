"""The group ``tsgt calibrate``, with the command that solves a prism layout from a file."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import click
import numpy as np

from tsgt.analysis.calibration import layout_covariance, solve_prisms
from tsgt.analysis.formats import read_prism_file, write_prism_layout
from tsgt.cli.calibrate.apply import apply_option, apply_setup, output_of, write_setup
from tsgt.cli.calibrate.check import check
from tsgt.cli.calibrate.collect import collect
from tsgt.cli.calibrate.frame_output import (
    TARGET_CONSTANT,
    file_argument,
    frame_json,
    given,
    output_option,
    print_frame,
    target_constant_option,
    weak_text,
)
from tsgt.cli.calibrate.imu import imu
from tsgt.cli.calibrate.motion import motion
from tsgt.cli.calibrate.targets import targets
from tsgt.cli.options import constant_m, constant_option, json_option
from tsgt.cli.output import CHECK_FAILED, numbers, print_json, print_table, refuse_overwrite
from tsgt.geometry.target_calibration import WEAK_BODY_RAD

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from tsgt.geometry import FloatArray
    from tsgt.geometry.target_calibration import FrameCalibration

PRISM_CONSTANT = "--prism-constant-mm"


@click.group()
def calibrate() -> None:
    """Calibrate station frames, prism layout, latencies and IMU."""


calibrate.add_command(collect)
calibrate.add_command(check)
calibrate.add_command(imu)
calibrate.add_command(motion)
calibrate.add_command(targets)


@calibrate.command()
@file_argument
@target_constant_option
@constant_option(
    PRISM_CONSTANT,
    "Constant added to the distances of prisms, required if a line of FILE has no constant_mm.",
)
@output_option
@apply_option
@json_option
def prisms(
    *,
    file: Path,
    target_constant_mm: float | None,
    prism_constant_mm: float | None,
    output: Path | None,
    master: Path | None,
    as_json: bool,
) -> int:
    """Solve the prism layout from measurements of one station.

    FILE is a CSV with the prisms and at least three body points whose positions in the robot frame are known from CAD.
    Exit code 3: the body points are inconsistent and the bad one cannot be identified (nothing is written), or the
    robot frame is weakly determined.
    """
    output = output_of(output, master, "prism_layout")
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
                **frame_json(solved.body),
            }
        )
    else:
        _print_prisms(positions, sigmas, distances_mm)
        print_frame("robot frame", "body point", solved.body)
    failed = _warn(solved.body)
    if output is not None and solved.body.consistent:
        options = given(TARGET_CONSTANT, target_constant_mm) + given(PRISM_CONSTANT, prism_constant_mm)

        def write(path: Path) -> None:
            write_prism_layout(
                path,
                positions,
                sigmas,
                comment=f"written by tsgt calibrate prisms {file}{options}",
                covariance=layout_covariance(solved),
            )

        write_setup(output, master, "prism_layout", write)
        click.echo(f"{output}: {len(positions)} prisms with their joint covariance written", err=True)
        if master is not None:
            click.echo(apply_setup(master), err=True)
    elif output is not None:
        click.echo(f"{output} is not written: the body points are inconsistent", err=True)
    return CHECK_FAILED if failed else 0


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


def _warn(frame: FrameCalibration) -> bool:
    """Print the problems of the robot frame to stderr, one line each; return whether a check failed."""
    for bad in frame.rejected:
        click.echo(
            f"note: robot frame: body point {bad.name} rejected: it lies {1e3 * bad.prediction_error_m:.1f} mm from its "
            "position predicted by the others; measure it again",
            err=True,
        )
    if not frame.consistent:
        click.echo(
            f"check failed: robot frame: the body points are inconsistent (rms {1e3 * frame.rms_m:.1f} mm) and the bad one "
            "cannot be identified; measure more, or check constants",
            err=True,
        )
    for weak in frame.weak:
        limit_mrad = 1e3 * WEAK_BODY_RAD
        click.echo(f"check failed: {weak_text('robot frame', 'body point', weak, limit_mrad)}", err=True)
    return not frame.consistent or bool(frame.weak)
