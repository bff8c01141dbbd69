"""The command ``tsgt calibrate imu``: mounting, latency and gyro matrix of the robot's IMU from motion."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.calibration import calibrate_recorded_imu
from tsgt.analysis.formats import write_imu_mounting
from tsgt.cli.options import (
    FiniteRange,
    OutputFile,
    json_option,
    keep_going_option,
    path_type,
    recording_argument,
)
from tsgt.cli.output import CHECK_FAILED, print_json, print_table, refuse_overwrite, report_problem
from tsgt.cli.progress import progress
from tsgt.cli.recordings import calibrated
from tsgt.config import IMU_NOISE
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.geometry.inertial_calibration import setup_components
from tsgt.model import ImuParameters
from tsgt.recording import load_recording, read_imu_samples

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.calibration import CalibratedImu
    from tsgt.geometry import FloatArray


@click.command()
@recording_argument
@click.option(
    "--output", type=OutputFile(".toml"), help="File of mounting, latency and gyro matrix to write (.toml)."
)
@click.option(
    "--imu",
    "samples",
    type=path_type,
    help="Samples of the robot's IMU (tsgt import imu), instead of the recorded ones.",
)
@click.option(
    "--noise",
    type=click.Choice(list(IMU_NOISE)),
    help="Class of the IMU, for a recording of a master without it.",
)
@click.option(
    "--gravity-mps2",
    type=FiniteRange(9.7, 9.9),
    help="Gravity where the robot drove, for a recording of a master without the IMU.",
)
@keep_going_option
@json_option
def imu(
    *,
    recording: Path,
    output: Path | None,
    samples: Path | None,
    noise: str | None,
    gravity_mps2: float | None,
    keep_going: bool,
    as_json: bool,
) -> int:
    """Calibrate the robot's IMU from motion.

    Finds mounting, position, latency and gyro matrix from two to five minutes of driving curves, slopes and bumps,
    without an initial guess. What the drive leaves undetermined is named. Exit code 3: the parts of the drive
    contradict each other, or the prism measurements contradict the IMU samples; the file is not written.
    """
    refuse_overwrite([recording, samples], output)
    loaded = load_recording(recording, keep_going=keep_going, on_problem=report_problem)
    loaded = calibrated(loaded, recording)
    if noise is not None or gravity_mps2 is not None:
        if noise is None or gravity_mps2 is None:
            raise click.UsageError("give --noise and --gravity-mps2 together")
        if loaded.parameters.imu is not None:
            raise click.UsageError(
                f"{recording} already has the parameters of an IMU; omit --noise and --gravity-mps2"
            )
        unknown = ImuParameters(
            position_m=(0.0, 0.0, 0.0),
            orientation_xyzw=(0.0, 0.0, 0.0, 1.0),
            noise=IMU_NOISE[noise],
            gravity_mps2=gravity_mps2,
        )
        loaded = replace(loaded, parameters=replace(loaded.parameters, imu=unknown))
    with progress("calibrating") as on_progress:
        found = calibrate_recorded_imu(
            loaded,
            # Problems of the recording have been reported.
            read_imu_samples(samples or recording, keep_going=keep_going),
            on_progress=on_progress,
        )
    if as_json:
        print_json(_json(found))
    else:
        _print(found)
    for component in setup_components(found.calibration):
        if not component.determined:
            click.echo(f"note: {component.name}: undetermined by this drive; {component.advice}", err=True)
    failed = found.failed_checks()
    for reason in failed:
        click.echo(f"check failed: {reason}", err=True)
    if output is not None and not failed:
        write_imu_mounting(
            output,
            found.parameters,
            comment=f"written by tsgt calibrate imu {recording}",
            covariance=found.covariance,
        )
        click.echo(f"{output}: mounting of the IMU with its covariance written", err=True)
    elif output is not None:
        click.echo(f"{output} is not written", err=True)
    return CHECK_FAILED if failed else 0


def _rotation_deg(imu: ImuParameters) -> FloatArray:
    """(3,) rotation vector from the robot's axes to the IMU's, about the axes of the robot."""
    vector: FloatArray = np.degrees(log_so3(rotation_from_quaternion(np.array(imu.orientation_xyzw))))
    return vector


def _sigmas(found: CalibratedImu) -> FloatArray:
    """(7,) of position in mm, rotation in deg and latency in ms."""
    variances = np.diag(np.array(found.covariance.matrix))[:7]
    sigmas: FloatArray = np.sqrt(variances) * np.array([1e3] * 3 + [180 / np.pi] * 3 + [1e3])
    return sigmas


def _json(found: CalibratedImu) -> dict[str, Any]:
    calibration, parameters = found.calibration, found.parameters
    sigmas = _sigmas(found)
    matrix_sigma = np.sqrt(np.diag(np.array(found.covariance.matrix)))[7:].reshape(3, 3)
    return {
        "rotation_deg": _rotation_deg(parameters).tolist(),
        "rotation_deg_sigma": sigmas[3:6].tolist(),
        "orientation_xyzw": list(parameters.orientation_xyzw),
        "lever_arm_mm": [1e3 * each for each in parameters.position_m],
        "lever_arm_mm_sigma": sigmas[0:3].tolist(),
        "offset_ms": parameters.latency_ns / 1e6,
        "offset_ms_sigma": float(sigmas[6]),
        "gyro_matrix": [list(row) for row in parameters.gyro_matrix],
        "gyro_matrix_sigma": matrix_sigma.tolist(),
        "matrix_prior_sigma": calibration.matrix_sigma,
        "log_bayes_factor": calibration.log_bayes_factor,
        "observability": [
            {
                "name": each.name,
                "sigma": each.sigma,
                "prior_sigma": each.prior_sigma,
                "determined": each.determined,
            }
            for each in setup_components(calibration)
        ],
        "rate_correlation": calibration.alignment.correlation,
        "duration_s": calibration.duration_s,
        "measurements": calibration.measurements,
        "outliers": calibration.outliers,
        "noise_scale": calibration.noise_scale,
        "disagreement": calibration.birge_ratio,
        "failed": found.failed_checks(),
    }


def _print(found: CalibratedImu) -> None:
    calibration, parameters, configured = found.calibration, found.parameters, found.configured
    kind = "calibrated in the factory" if calibration.log_bayes_factor < 0 else "uncalibrated"
    click.echo(
        f"{calibration.duration_s:.0f} s, {calibration.measurements} measurements, {calibration.outliers} outliers, "
        f"noise scale {calibration.noise_scale:.2f}; sigmas scaled by {calibration.birge_ratio:.2f} (Birge ratio of parts of "
        f"the drive); gyro and accelerometer: {kind} (log Bayes factor {calibration.log_bayes_factor:+.0f})"
    )
    sigmas = _sigmas(found)
    values, before = _rotation_deg(parameters), _rotation_deg(configured)
    rows = [
        [f"rotation {axis}, deg", f"{values[i]:.3f}", f"{sigmas[3 + i]:.3f}", f"{before[i]:.3f}"]
        for i, axis in enumerate("xyz")
    ]
    rows += [
        [
            f"position {axis}, mm",
            f"{1e3 * parameters.position_m[i]:.1f}",
            f"{sigmas[i]:.1f}",
            f"{1e3 * configured.position_m[i]:.1f}",
        ]
        for i, axis in enumerate("xyz")
    ]
    latencies = [f"{each.latency_ns / 1e6:.2f}" for each in (parameters, configured)]
    rows.append(["latency, ms", latencies[0], f"{sigmas[6]:.2f}", latencies[1]])
    print_table(["robot frame", "value", "sigma", "configured"], rows)
    click.echo()
    print_table(
        ["gyro matrix", "x", "y", "z"],
        [
            [axis, *(f"{value:.5f}" for value in row)]
            for axis, row in zip("xyz", parameters.gyro_matrix, strict=True)
        ],
    )
