"""Options of the IMU and of the refinement that would have no effect are refused: the result would pass for another."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.refinement import Refine
    from tsgt.cli.recordings import ImuOptions
    from tsgt.recording import Recording


def refuse_unused_wheels(recording: Recording, path: Path, imu: ImuOptions) -> None:
    """Raise UsageError for wheel odometry of a recording without an IMU."""
    if imu.odometry is not None and recording.parameters.imu is None:
        raise click.UsageError(
            f"{path} has no parameters of an IMU, and wheel odometry is used with one only; give --imu and --imu-setup, "
            "or omit --wheel-odometry"
        )


def refuse_unused_by_linear(
    recording: Recording, path: Path, imu: ImuOptions, refine: Refine = "auto"
) -> None:
    """Raise UsageError for what the estimator ``linear`` does not use; ``--no-imu`` and ``--refine off`` say the same as it."""
    if recording.parameters.pipeline.estimator != "linear":
        return
    given = {
        "--refine prisms": refine == "prisms",
        "--imu": imu.samples is not None,
        "--imu-setup": imu.setup is not None,
        "--wheel-odometry": imu.odometry is not None,
    }
    unused = [option for option, is_given in given.items() if is_given]
    if unused:
        raise click.UsageError(
            f"the estimator linear, which is chosen here or recorded in {path}, does not use {' and '.join(unused)}; "
            "the estimator continuous does"
        )
