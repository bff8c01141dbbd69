"""Options of the IMU and of the refinement that would have no effect are refused: the result would pass for another."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.refinement import Refine
    from tsgt.cli.recordings import ImuOptions
    from tsgt.recording import Recording


def refuse_unused_wheels(recording: Recording, path: Path, imu: ImuOptions) -> None:
    """Raise UsageError for wheel odometry of a recording without an IMU, and InputFileError for a file without any, or of another time."""
    if imu.odometry is None:
        return
    if recording.parameters.imu is None:
        raise click.UsageError(
            f"{path} has no parameters of an IMU, and wheel odometry is used with one only; give --imu and --imu-setup, "
            "or omit --wheel-odometry"
        )
    if not recording.odometry:
        raise InputFileError(
            "contains no wheel odometry; give a file of tsgt import odometry", path=imu.odometry
        )
    stamps_ns = [m.stamp_ns for m in recording.measurements]
    first_ns, last_ns = min(stamps_ns, default=0), max(stamps_ns, default=0)
    driven_ns = (stamp_ns for each in recording.odometry for stamp_ns in each.stamp_ns)
    if stamps_ns and not any(first_ns <= stamp_ns <= last_ns for stamp_ns in driven_ns):
        raise InputFileError(
            "the samples of the wheel odometry do not overlap with the measurements in time; give those of this drive, or correct "
            "their clock: tsgt import odometry --offset-ms",
            path=imu.odometry,
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
