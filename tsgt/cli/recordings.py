"""Recordings on the command line: options, reading with replaced parameters, writing, and summaries of poses."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import click
import numpy as np

import tsgt
from tsgt.analysis.inertial_smoothing import DISPLACEMENT_REMEDY
from tsgt.analysis.motion_plausibility import unfit_for_live
from tsgt.analysis.processing import has_raw_angles, with_estimator
from tsgt.analysis.refinement import Refine
from tsgt.cli.options import path_type, resolved_point
from tsgt.cli.output import report_problem
from tsgt.clock import SystemClock
from tsgt.errors import InputFileError
from tsgt.model import OdometryParameters
from tsgt.recording import (
    RecordingHeader,
    encode_line,
    load_recording,
    read_imu_samples,
    read_odometry,
    write_atomically,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from tsgt.analysis.evaluation import Reference
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.smoothing import SmoothedPoses
    from tsgt.config import StationCalibration
    from tsgt.estimation import PoseBatch
    from tsgt.model import MotionPrior, Parameters, ReferencePoint
    from tsgt.recording import Recording

R = TypeVar("R")

estimator_option = click.option(
    "--estimator",
    type=click.Choice(["linear", "continuous"]),
    help="Linear interpolation between measurements, or one smooth trajectory.  [default: as recorded]",
)
frames_option = click.option(
    "--frames", type=path_type, help="Station frames (set-up file) that replace the recorded ones."
)
prisms_option = click.option(
    "--prisms", type=path_type, help="Prism layout (set-up file) that replaces the recorded one."
)

refine_option = click.option(
    "--refine",
    type=click.Choice(get_args(Refine)),
    default="auto",
    show_default=True,
    help="Refine station frames, latencies and instrument errors within the continuous trajectory where the "
    "measurements disagree with the set-up; prisms: the prism positions as well.",
)


def write_recording(path: Path, *, source: str, parameters: Parameters, records: Iterable[object]) -> None:
    """Write header, parameters and records in this order; nothing is written if that fails."""
    header = RecordingHeader(
        software=f"tsgt {tsgt.__version__}", created_ns=SystemClock().realtime_ns(), source=source
    )
    with write_atomically(path) as file:
        for record in itertools.chain([header, parameters], records):
            file.write(encode_line(record) + b"\n")


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write text; nothing is written if that fails."""
    with write_atomically(path) as file:
        file.writelines(line.encode() for line in lines)


def imu_options(command: Callable[..., R]) -> Callable[..., R]:
    """Add the options of the robot's IMU, which a command gets as its argument ``imu``."""

    @click.option("--no-imu", "left_out", is_flag=True, help="Do not use the IMU of the recording.")
    @click.option(
        "--imu",
        "samples",
        type=path_type,
        help="Samples of the robot's IMU (tsgt import imu), instead of the recorded ones.",
    )
    @click.option(
        "--imu-setup",
        "setup",
        type=path_type,
        help="Mounting, latency and gyro matrix of the IMU (tsgt calibrate imu) that replace the recorded ones.",
    )
    @click.option(
        "--wheel-odometry",
        "wheels",
        type=path_type,
        help="Wheel odometry (tsgt import odometry) that is used with the IMU, instead of the recorded one.",
    )
    @functools.wraps(command)
    def with_options(
        *, left_out: bool, samples: Path | None, setup: Path | None, wheels: Path | None, **others: Any
    ) -> R:
        if left_out and (samples is not None or setup is not None):
            raise click.UsageError(f"--no-imu and --imu{'' if samples else '-setup'} exclude each other")
        if left_out and wheels is not None:
            raise click.UsageError(
                "--no-imu and --wheel-odometry exclude each other: wheels are used with an IMU"
            )
        options = ImuOptions(left_out=left_out, samples=samples, setup=setup, odometry=wheels)
        return command(imu=options, **others)

    return with_options


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ImuOptions:
    """How the robot's IMU is used; the default is what the recording has."""

    left_out: bool = False
    samples: Path | None = None  # instead of those of the recording
    setup: Path | None = None
    odometry: Path | None = None  # instead of that of the recording

    def applied(self, recording: Recording, path: Path, *, keep_going: bool) -> Recording:
        """Return the recording with these samples and parameters."""
        parameters = recording.parameters
        if self.left_out:
            parameters = dataclasses.replace(parameters, imu=None)
        if self.setup is not None:
            from tsgt.analysis.setup_replacement import with_imu_mounting
            from tsgt.config import load_imu_mounting

            parameters = with_imu_mounting(parameters, load_imu_mounting(self.setup), path=self.setup)
        if self.odometry is not None:
            parameters = dataclasses.replace(parameters, odometry=parameters.odometry or OdometryParameters())
            driven = read_odometry(self.odometry, keep_going=keep_going, on_problem=report_problem)
            recording = dataclasses.replace(recording, odometry=list(driven))
        if self.samples is None:
            return dataclasses.replace(recording, parameters=parameters)
        if parameters.imu is None:
            raise click.UsageError(
                f"{path} has no parameters of an IMU; give --imu-setup, a file of tsgt calibrate imu"
            )
        samples = read_imu_samples(self.samples, keep_going=keep_going, on_problem=report_problem)
        return dataclasses.replace(recording, parameters=parameters, imu_samples=list(samples))


def load(
    path: Path,
    *,
    keep_going: bool,
    estimator: Estimator | None = None,
    rate_hz: float | None = None,
    frames: Path | None = None,
    prisms: Path | None = None,
    point: ReferencePoint | str | None = None,
    imu: ImuOptions | None = None,
) -> Recording:
    """Read a recording, without the samples of its IMU unless ``imu`` is given, and replace the parameters that are given."""
    own_samples = imu is not None and not imu.left_out and imu.samples is None
    recording = load_recording(
        path, imu=own_samples, whole=frames is not None, keep_going=keep_going, on_problem=report_problem
    )
    if frames is None or prisms is None:
        recording = calibrated(recording, path)
    recorded = recording.parameters
    if imu is not None:
        recording = imu.applied(recording, path, keep_going=keep_going)
    parameters = recording.parameters
    if rate_hz is not None:
        pipeline = dataclasses.replace(parameters.pipeline, period_ns=round(1e9 / rate_hz))
        parameters = dataclasses.replace(parameters, pipeline=pipeline)
    if frames is not None:
        if not has_raw_angles(recording.measurements):
            raise click.UsageError(
                f"{path} holds points in the frame of station 1, no raw measurements: --frames has no effect"
            )
        from tsgt.analysis.setup_replacement import with_calibration
        from tsgt.config import load_station_calibration

        calibration = load_station_calibration(frames)
        _note_kept_corrections(parameters, calibration, frames)
        parameters = with_calibration(parameters, calibration, path=frames)
    if prisms is not None:
        from tsgt.analysis.setup_replacement import with_layout
        from tsgt.config import load_prism_layout

        parameters = with_layout(parameters, load_prism_layout(prisms), path=prisms)
    point = _recorded_name(recorded) if point is None else point
    parameters = dataclasses.replace(
        parameters, no_poses=None, reference_point=resolved_point(point, parameters)
    )
    recording = dataclasses.replace(recording, parameters=parameters)
    return recording if estimator is None else with_estimator(recording, estimator)


def _recorded_name(recorded: Parameters) -> ReferencePoint | str:
    """Return the recorded reference point, by its name where it moves with the set-up: the prisms' centroid and the IMU."""
    from tsgt.estimation import centroid_point

    point = recorded.reference_point
    moving = [centroid_point(recorded)] if recorded.prisms else []
    moving += [] if recorded.imu is None else [recorded.imu.point]
    return point.name if point in moving else point


def _note_kept_corrections(parameters: Parameters, calibration: StationCalibration, path: Path) -> None:
    """Say that recorded latencies and distance scales stay: those of an earlier calibration may be among them."""
    kept = []
    for station in parameters.stations:
        new = calibration.stations.get(station.station)
        if new is not None and new.latency_ns is None and station.latency_ns:
            kept.append(f"latency {station.latency_ns / 1e6:g} ms of station {station.station}")
        if new is not None and new.range_scale_ppm is None and station.atmospheric_ppm:
            kept.append(f"distance scale {station.atmospheric_ppm:g} ppm of station {station.station}")
    if kept:
        click.echo(
            f"note: {path} does not state these, so they stay as recorded: {', '.join(kept)}", err=True
        )


def calibrated(recording: Recording, path: Path) -> Recording:
    """Return the recording, with a note if a part is left out or its runs differ; raises InputFileError if it has no calibration."""
    if recording.left_out:
        click.echo(
            f"note: {path}: {recording.left_out} measurements before the set-up was replaced are left out",
            err=True,
        )
    if recording.set_ups_differ:
        click.echo(
            f"note: {path}: its runs were recorded with different set-ups; the last one is used for all of them",
            err=True,
        )
    if recording.parameters.no_poses is not None:
        raise InputFileError(
            f"{recording.parameters.no_poses}; `tsgt process` and `tsgt evaluate` take --frames and --prisms",
            path=path,
        )
    return recording


def load_reference(
    path: Path | None, point: ReferencePoint | str | None, parameters: Parameters
) -> Reference | None:
    """Read a reference trajectory, of the point that is given or else of that which the file states."""
    if path is None:
        return None
    from tsgt.analysis.evaluation import read_tum

    reference = read_tum(path)
    if point is None:
        return reference
    point = resolved_point(point, parameters, option="--reference-point")
    return dataclasses.replace(reference, reference_point=point)


def pose_counts(poses: PoseBatch) -> dict[str, Any]:
    """Return the numbers of poses for ``--json``."""
    return {
        "poses": len(poses),
        "valid_poses": int(np.count_nonzero(poses.valid)),
        "invalid": poses.invalid_counts(),
    }


def pose_summary(poses: PoseBatch) -> str:
    """Return the numbers of poses as text."""
    counts = pose_counts(poses)
    invalid = "".join(f", {reason} {count}" for reason, count in counts["invalid"].items())
    return f"{counts['valid_poses']} of {counts['poses']} poses valid{invalid}"


def duration_s(poses: PoseBatch) -> float:
    """Return the time from the first to the last epoch in s."""
    return int(poses.stamp_ns[-1] - poses.stamp_ns[0]) / 1e9


def motion_keys(found: SmoothedPoses) -> dict[str, Any]:
    """Return motion prior and noise scales for ``--json``."""
    from tsgt.analysis.evaluation import noise_scales_by_axis

    motion = found.motion
    return {
        "motion": dataclasses.asdict(motion.prior),
        "noise_scale": motion.noise_scale,
        "noise_scales": noise_scales_by_axis(found.observations, motion.noise_scales, found.sources),
        "motion_tuned": motion.tuned,
        "motion_unfit_for_live": unfit_for_live(found),
    }


def imu_text(found: SmoothedPoses) -> str | None:
    """Return in words how the IMU was used; None without one."""
    if found.imu is None:
        return f"IMU: not used: {found.imu_problem}" if found.imu_problem else None
    used = found.imu
    numbers = ", ".join(map(str, used.stations))
    text = f"IMU: used with {'station' if len(used.stations) == 1 else 'stations'} {numbers}, {len(used.samples)} samples"
    if used.odometry_samples:
        text += f", wheel odometry of {used.odometry_samples} samples"
    for reason, words in (
        ("gap", "without samples"),
        ("contradiction", "in contradiction to the measurements"),
        ("unproven", "around a few measurements of one prism alone, which may be the wrong one"),
    ):
        seconds = sum(each.end_s - each.start_s for each in used.unused if each.reason == reason)
        text += f"; {seconds:.1f} s {words}" if seconds else ""
    if np.isfinite(used.displaced_from_s):
        text += f"; from {used.displaced_from_s:.1f} s on a knock may have displaced it, because of a shock or of missing samples: {DISPLACEMENT_REMEDY}"
    if np.isfinite(used.moved_from_s):
        text += f"; from {used.moved_from_s:.1f} s on measurements contradict it: {used.moved_remedy}"
    return text


def motion_text(found: SmoothedPoses, configured: MotionPrior) -> str:
    """Return motion prior and noise scale as they are written in a master's configuration; ``configured``: as recorded."""
    motion = found.motion
    if found.imu is not None and not motion.tuned:
        return f"Noise scale {motion.noise_scale:.3g}, estimated with the IMU; there is no motion prior"
    origin = "tuned to the measurements" if motion.tuned else "as recorded: too few measurements to tune it"
    lines = [
        f"Motion prior, {origin}:",
        "  [pipeline]",
        f"  noise_scale = {motion.noise_scale:.3g}",
        *_motion_lines(motion.prior),
    ]
    reasons = unfit_for_live(found)
    if reasons:
        lines += [f"Not for live use: {'; '.join(reasons)}. Keep", *_motion_lines(configured)]
    return "\n".join(lines)


def _motion_lines(prior: MotionPrior) -> list[str]:
    values = {
        key: "[" + ", ".join(f"{v:.3g}" for v in value) + "]" if isinstance(value, tuple) else f"{value:.3g}"
        for key, value in dataclasses.asdict(prior).items()
    }
    return ["  [pipeline.motion]", *(f"  {key} = {value}" for key, value in values.items())]
