"""Pose errors of a simulated mission: of both estimators after processing, and of the live stream.

Positions are compared at the reference point and at the prisms' centroid.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from tsgt.analysis.evaluation import (
    LivePoseErrors,
    LivePoses,
    PoseErrorStatistics,
    inter_prism,
    interior_mask,
)
from tsgt.analysis.processing import Estimator, process, with_estimator
from tsgt.errors import DegenerateGeometryError, RecordingError
from tsgt.estimation import PoseBatch, build_tracks, centroid_at_point, sigma_limits_of
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.recording import Recording, RecordingHeader, read_imu_samples

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.model import ImuSamples, Measurement
    from tsgt.simulation.mission import MissionResult


PREDICTED_WITH_IMU = "predicted_with_imu"


@dataclass(frozen=True, slots=True)
class EstimatorFigures:
    """Numbers of poses, and the errors of the valid ones against the truth."""

    poses: int
    valid_poses: int
    against_truth: PoseErrorStatistics


def pose_keys(run: MissionResult) -> dict[str, Any]:
    """Return all figures for ``--json``."""
    inter_prism_mean_mm = _inter_prism_mean_mm(run)
    live = {series: found.keys() for series, found in live_figures(run).items()}
    return {
        "reference_point": dataclasses.asdict(run.parameters.reference_point),
        "estimators": {
            name: {**_keys(found), "inter_prism_mean_mm": inter_prism_mean_mm}
            for name, found in estimator_figures(run).items()
        },
        "live": live,
        "nees": {series: found["nees"] for series, found in live.items()},
    }


def estimator_figures(run: MissionResult) -> dict[Estimator, EstimatorFigures]:
    """Process all delivered measurements with each estimator, and compare the poses with the truth."""
    measurements = _measurements(run)
    recording = Recording(
        header=RecordingHeader(software="", created_ns=run.start_ns, source="simulate"),
        parameters=run.parameters,
        measurements=measurements,
        end_ns=max((m.received_ns for m in measurements), default=None),
        imu_samples=_imu_samples(run),
    )
    return {name: _processed_figures(run, with_estimator(recording, name)) for name in get_args(Estimator)}


def _measurements(run: MissionResult) -> list[Measurement]:
    """Return all measurements on one clock, without steps of the master's clock between its sessions."""
    found: list[Measurement] = []
    for session in run.master_logs:
        later_ns = run.start_ns - session.unix_at_zero_ns
        found += [
            replace(m, stamp_ns=m.stamp_ns + later_ns, received_ns=m.received_ns + later_ns)
            if later_ns
            else m
            for m in session.measurements
        ]
    return found


def _imu_samples(run: MissionResult) -> list[ImuSamples]:
    """Return the recorded samples of the IMU on one clock, as the measurements."""
    found: list[ImuSamples] = []
    for session in run.master_logs:
        path = session.recording()
        if run.parameters.imu is None or path is None:
            continue
        later_ns = run.start_ns - session.unix_at_zero_ns
        found += [
            replace(
                each,
                received_ns=each.received_ns + later_ns,
                stamp_ns=tuple(stamp_ns + later_ns for stamp_ns in each.stamp_ns),
            )
            # The line that a power cut tore is not of interest here.
            for each in read_imu_samples(path, keep_going=True)
        ]
    return found


def _processed_figures(run: MissionResult, recording: Recording) -> EstimatorFigures:
    try:
        poses = process(recording, path=Path("the run's recording"))
    except (RecordingError, DegenerateGeometryError):
        # No valid pose, for example with fewer than three stations and without an IMU.
        poses = PoseBatch.blank(np.empty(0, np.int64), ())
    valid = poses.valid
    return _pose_figures(
        run,
        len(poses),
        poses.stamp_ns[valid],
        poses.position_m[valid],
        poses.orientation_xyzw[valid],
        poses.covariance[valid],
    )


def live_figures(run: MissionResult) -> dict[str, LivePoses]:
    """Compare the streamed poses with the truth, by series; of predicted ones also those that rest on the IMU.

    Those of a master with another reference point, by a fault, are left out.
    """
    point = run.parameters.reference_point
    sessions = [log for log in run.master_logs if run.in_force(log).parameters.reference_point == point]
    counts: Counter[str] = Counter()
    for session in sessions:
        counts.update(session.pose_counts)
        if session.predicted_with_imu:
            counts[PREDICTED_WITH_IMU] += session.predicted_with_imu
    streamed = [session.valid_poses() for session in sessions]
    found = {}
    for series, count in sorted(counts.items()):
        if series == PREDICTED_WITH_IMU:
            some = [poses.select((poses.series == "predicted") & poses.with_imu) for poses in streamed]
        else:
            some = [poses.select(poses.series == series) for poses in streamed]
        stamp_ns = np.concatenate(
            [
                poses.stamp_ns + run.start_ns - session.unix_at_zero_ns
                for session, poses in zip(sessions, some, strict=True)
            ]
        )
        age_name = "newest_age_s" if series.startswith("predicted") else "sent_age_s"
        names = ("position_m", "orientation_xyzw", "covariance", age_name)
        position_m, orientation_xyzw, covariance, age_s = (
            np.concatenate([getattr(poses, name) for poses in some]) for name in names
        )
        inner = interior_mask(stamp_ns, run.start_ns, run.end_ns)
        errors = LivePoseErrors.of(
            transform_from(rotation_from_quaternion(orientation_xyzw[inner]), position_m[inner]),
            covariance[inner],
            age_s[inner],
            run.true_poses((stamp_ns[inner] - run.start_ns) / 1e9),
            centroid_at_point(run.parameters),
        )
        limits = sigma_limits_of(series, run.parameters.pipeline)
        found[series] = LivePoses(count, len(stamp_ns), age_s, errors.statistics(*limits))
    return found


def _pose_figures(
    run: MissionResult,
    count: int,
    stamp_ns: NDArray[np.int64],
    position_m: NDArray[np.float64],
    orientation_xyzw: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> EstimatorFigures:
    inner = interior_mask(stamp_ns, run.start_ns, run.end_ns)
    return EstimatorFigures(
        poses=count,
        valid_poses=len(stamp_ns),
        against_truth=PoseErrorStatistics.of(
            transform_from(rotation_from_quaternion(orientation_xyzw[inner]), position_m[inner]),
            covariance[inner],
            run.true_poses((stamp_ns[inner] - run.start_ns) / 1e9),
            centroid_at_point(run.parameters),
        ),
    )


def _inter_prism_mean_mm(run: MissionResult) -> float:
    """Return the mean absolute error of the interpolated distances over all pairs."""
    tracks = build_tracks(run.parameters, _measurements(run))
    if len(tracks) < 2 or not all(len(track) for track in tracks.values()):
        return math.nan
    pairs = inter_prism(run.parameters, tracks).dynamic
    return float(np.mean([pair.statistics().mean_abs_error for pair in pairs]))


def _keys(found: EstimatorFigures) -> dict[str, Any]:
    truth = found.against_truth
    return {
        "poses": found.poses,
        "valid_poses": found.valid_poses,
        "position_rms_mm": truth.position_rms_mm,
        "orientation_rms_deg": truth.orientation_rms_deg,
        "centroid": dataclasses.asdict(truth.centroid),
        "nees": dataclasses.asdict(truth.nees),
    }
