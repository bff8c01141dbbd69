"""All numbers of a report, as ``--json`` prints them. Sans-I/O."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.evaluation import binned, gridded, held_out_keys, noise_scales_by_axis
from tsgt.analysis.inertial_smoothing import imu_keys
from tsgt.analysis.motion_plausibility import unfit_for_live
from tsgt.analysis.refinement import refinement_keys
from tsgt.analysis.report.findings import position_sigma_mm, rotation_sigma_deg
from tsgt.analysis.report.page import nan_median
from tsgt.analysis.report.sections.calibration import calibration_numbers
from tsgt.analysis.report.sections.diagnosis import diagnosis_numbers
from tsgt.analysis.report.sections.imu import imu_numbers
from tsgt.analysis.report.verdicts import bound_and_speed, verdicts
from tsgt.estimation import Kind, centroid_point, poses_at

if TYPE_CHECKING:
    from tsgt.analysis.evaluation import Bins, Grid, InterPrismDistances
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.report.findings import Difference, Findings, PoseNoise
    from tsgt.analysis.report.motion import DistanceErrorSeries
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray
    from tsgt.model import Parameters


def report_numbers(findings: Findings) -> dict[str, Any]:
    """Return all numbers; those of ``tsgt evaluate`` without a report have the same names."""
    f = findings
    poses = f.poses
    bound_ms, fast_mps = bound_and_speed(f)
    found: dict[str, Any] = {
        "verdicts": [{"level": v.level.value, "text": v.text, "repair": v.repair} for v in verdicts(f)],
        "estimator": None if poses is None else Kind(poses.kind[0]).estimator,
        "reference_point": dataclasses.asdict(f.recording.parameters.reference_point),
        "start_ns": f.start_ns,
        "measured_s": f.duration_s,
        "duration_s": math.nan if poses is None else int(poses.stamp_ns[-1] - poses.stamp_ns[0]) / 1e9,
        "poses": 0 if poses is None else len(poses),
        "valid_poses": 0 if poses is None else int(np.count_nonzero(poses.valid)),
        "invalid": {} if poses is None else poses.invalid_counts(),
        "by_estimator": {
            name: pose_numbers(each, f.recording.parameters) for name, each in f.poses_by_estimator.items()
        },
        "protocol": f.log.protocol,
        "authenticated": f.log.authenticated,
        "events": [{"stamp_ns": stamp_ns, "message": message} for stamp_ns, message in f.log.events],
        "stations": {number: _station(f, number) for number in f.station_statistics},
        "bound_median_ms": bound_ms,
        "speed_p95_mps": fast_mps,
        "problems": f.problems,
        "calibration": calibration_numbers(f.recording),
    }
    if f.inter_prism is not None:
        found |= _distances(f.inter_prism)
    if f.distance_errors is not None:
        found["errors_by_motion_mm"] = _by_motion(f.distance_errors)
    if f.diagnosis is not None:
        found |= diagnosis_numbers(f.diagnosis)
    if f.live is not None:
        found["live"] = f.live.keys()
    if f.held_out is not None:
        found |= held_out_keys(f.held_out)
    if f.difference is not None and len(f.difference.stamp_ns):
        found["estimators_apart"] = difference_numbers(f.difference)
    if f.continuous is not None:
        motion = f.continuous.motion
        found |= refinement_keys(f.continuous.refinement, f.continuous.parameters)
        found |= {
            "motion": dataclasses.asdict(motion.prior),
            "noise_scale": motion.noise_scale,
            "noise_scales": noise_scales_by_axis(
                f.continuous.fit.observations, motion.noise_scales, f.continuous.sources
            ),
            "motion_tuned": motion.tuned,
            "motion_unfit_for_live": unfit_for_live(f.continuous),
            "residuals": {
                station: {axis: dataclasses.asdict(each) for axis, each in axes.items()}
                for station, axes in f.residuals.items()
            },
            "outliers": [dataclasses.asdict(outlier) for outlier in f.outliers],
        }
        found |= imu_keys(f.continuous.imu, f.continuous.imu_problem)
        if f.continuous.imu is not None:
            found["imu_quality"] = imu_numbers(f)
    if f.reference_errors:
        found["estimators"] = {name: _compared(f, name) for name in f.reference_errors}
        found |= found["estimators"].get(f.recording.parameters.pipeline.estimator, {})
    if f.pose_noise is not None:
        found["perturbation"] = perturbation_numbers(f.pose_noise)
    return found


def _compared(f: Findings, name: Estimator) -> dict[str, Any]:
    """Return the errors of one estimator against the reference."""
    found = {
        **dataclasses.asdict(f.reference_errors[name]),
        **f.error_details[name].keys(),
        "stationary": dataclasses.asdict(f.stationary_errors[name]),
    }
    aligned = f.aligned_errors.get(name)
    return found if aligned is None else {**found, "aligned": dataclasses.asdict(aligned)}


def median_and_p95(values: FloatArray) -> dict[str, float]:
    """Return median and 95th percentile of the finite values; NaN without any."""
    known = values[np.isfinite(values)]
    if not len(known):
        return {"median": math.nan, "p95": math.nan}
    return {"median": float(np.median(known)), "p95": float(np.percentile(known, 95))}


def difference_numbers(difference: Difference) -> dict[str, Any]:
    """Summarise the difference of the two estimators' poses, at the reference point and at the prisms' centroid."""
    return {
        "epochs": len(difference.stamp_ns),
        "position_mm": median_and_p95(1e3 * difference.position_m),
        "centroid": {"position_mm": median_and_p95(1e3 * difference.centroid_m)},
        "rotation_deg": median_and_p95(np.degrees(difference.rotation_rad)),
    }


def pose_numbers(poses: PoseBatch, parameters: Parameters) -> dict[str, Any]:
    """Count an estimator's poses, and summarise the stated sigmas of the valid ones, at their point and at the centroid.

    ``common``: of the part of the covariance that all poses share; NaN if unknown.
    """
    valid = poses.select(poses.valid)
    at_centroid = poses_at(valid, centroid_point(parameters))
    return {
        "poses": len(poses),
        "valid_poses": len(valid),
        "invalid": poses.invalid_counts(),
        **_sigmas(valid.covariance),
        "common": _sigmas(valid.covariance_common),
        "centroid": {"position_sigma_mm": _sigmas(at_centroid.covariance)["position_sigma_mm"]},
    }


def _sigmas(covariance: FloatArray) -> dict[str, dict[str, float]]:
    return {
        "position_sigma_mm": median_and_p95(position_sigma_mm(covariance)),
        "rotation_sigma_deg": median_and_p95(rotation_sigma_deg(covariance)),
    }


def _station(f: Findings, station: int) -> dict[str, Any]:
    series = f.log.radio.get(station)
    quality = (None, None, None) if series is None else (series.rssi_dbm, series.snr_db, series.loss)
    names = ("rssi_median_dbm", "snr_median_db", "loss_median")
    found = dataclasses.asdict(f.station_statistics[station])
    return {**found, **{name: nan_median(values) for name, values in zip(names, quality, strict=True)}}


def _distances(found: InterPrismDistances) -> dict[str, Any]:
    return {
        "inter_prism_mm": {pair.name: dataclasses.asdict(pair.statistics()) for pair in found.dynamic},
        "inter_prism_static_mm": {pair.name: dataclasses.asdict(pair.statistics()) for pair in found.static},
        "epochs": found.epochs,
        "invalid_epochs": found.invalid_epochs,
        "still_s": found.stationary_s,
        "still_intervals": len(found.stationary_ns),
    }


def _by_motion(ride: DistanceErrorSeries) -> dict[str, Any]:
    errors_m, motion = np.array(list(ride.error_m.values())), ride.motion
    turning = motion.angular_rate_radps
    found = {
        "speed_mps": binned(errors_m, motion.speed_mps),
        "acceleration_mps2": binned(errors_m, motion.acceleration_mps2),
        "angular_rate_radps": binned(errors_m, turning),
    }
    grids = {
        "speed_and_angular_rate": gridded(errors_m, motion.speed_mps, turning),
        "acceleration_and_angular_rate": gridded(errors_m, motion.acceleration_mps2, turning),
    }
    return {name: _in_mm(each) for name, each in (*found.items(), *grids.items()) if each is not None}


def _in_mm(sorted_errors: Bins | Grid) -> dict[str, Any]:
    in_mm = ("median", "mean", "p95")
    return {
        name: (1e3 * values if name in in_mm else values).tolist()
        for name, values in dataclasses.asdict(sorted_errors).items()
    }


def perturbation_numbers(found: PoseNoise) -> dict[str, Any]:
    """Return the pose errors that noise of the measured size causes, at the prisms' centroid."""
    noise = found.as_measured
    return {
        "inter_prism_mean_mm": 1e3 * noise.inter_prism_mean_m,
        "noise_mm": 1e3 * noise.noise_m,
        "position_std_mm": (1e3 * noise.position_std_m).tolist(),
        "rotation_std_deg": np.degrees(noise.euler_std_rad).tolist(),
        "position_norm_mean_mm": 1e3 * noise.position_norm_mean_m,
        "rotation_norm_mean_rad": noise.rotation_norm_mean_rad,
        "rotation_norm_mean_deg": math.degrees(noise.rotation_norm_mean_rad),
    }
