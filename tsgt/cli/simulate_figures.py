"""Figures of a simulated run: what was measured and delivered, how well it was timed, how good the poses were."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.inter_prism import inter_prism
from tsgt.analysis.metrics import inner_part, pose_errors
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.master.tracks import build_tracks

if TYPE_CHECKING:
    from tsgt.simulation.scenario import Run
    from tsgt.simulation.witness import StationWitness


@dataclass(frozen=True, slots=True)
class StationFigures:
    """What became of one station's measurements.

    Attributes
    ----------
    measured
        How many the client read from its instrument before the end of the run.
    delivered
        How many different ones of them reached the pipeline, up to the end of the drain.
    duplicates
        How many the pipeline was handed again.
    rate_hz
        Different measurements that reached the pipeline per second, from the end of the initial synchronisation of
        all stations to the end of the run; NaN where that never ended.
    time_error_us
        Percentiles 50, 99 and 100 of the absolute error of their time stamps, in us; NaN without any.
    """

    measured: int
    delivered: int
    duplicates: int
    rate_hz: float
    time_error_us: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class EstimatorFigures:
    """How good an estimator's poses were, against the truth and against the prism layout; NaN without poses."""

    poses: int
    valid_poses: int
    position_rms_mm: float
    orientation_rms_deg: float
    inter_prism_mean_mm: float


def station_figures(run: Run) -> dict[int, StationFigures]:
    """Count and time what came from each station."""
    synchronised_ns = _synchronised_ns(run)
    return {
        number: _station_figures(run, witness, synchronised_ns) for number, witness in run.witnesses.items()
    }


def _synchronised_ns(run: Run) -> int | None:
    """Return when the last station had been synchronised for the first time; None if that never was."""
    first_ns: dict[int, int] = {}
    for session in run.sessions:
        for clock in session.clocks:
            first_ns.setdefault(clock.station, clock.stamp_ns)
    return max(first_ns.values()) if first_ns.keys() >= run.witnesses.keys() else None


def _station_figures(run: Run, witness: StationWitness, synchronised_ns: int | None) -> StationFigures:
    duplicates, errors_ns = 0, []
    received_ns: dict[int, int] = {}
    end_ns = run.end_ns - run.start_ns
    for session in run.sessions:
        seen: set[int] = set()
        for measurement in session.measurements:
            true_ns = witness.stamps_ns.get(measurement.host_time_ns)
            if measurement.station != witness.station or true_ns is None or true_ns > end_ns:
                continue
            duplicates += measurement.host_time_ns in seen
            seen.add(measurement.host_time_ns)
            if measurement.host_time_ns not in received_ns:
                received_ns[measurement.host_time_ns] = measurement.received_ns
                errors_ns.append(abs(measurement.stamp_ns - run.start_ns - true_ns))
    rate_hz = math.nan
    if synchronised_ns is not None and synchronised_ns < run.end_ns:
        counted = sum(synchronised_ns <= at_ns <= run.end_ns for at_ns in received_ns.values())
        rate_hz = counted / ((run.end_ns - synchronised_ns) / 1e9)
    p50, p99, most = np.percentile(errors_ns, [50, 99, 100]) / 1e3 if errors_ns else [math.nan] * 3
    return StationFigures(
        measured=sum(true_ns <= end_ns for true_ns in witness.stamps_ns.values()),
        delivered=len(received_ns),
        duplicates=duplicates,
        rate_hz=rate_hz,
        time_error_us=(float(p50), float(p99), float(most)),
    )


def estimator_figures(run: Run) -> EstimatorFigures:
    """Compare the poses of the stream with the truth, and the measured prisms with their layout."""
    poses = [session.valid_poses() for session in run.sessions]
    stamps_ns = np.concatenate([p.stamp_ns for p in poses])
    counts = inner_part(stamps_ns, run.start_ns, run.end_ns)
    rotation = rotation_from_quaternion(np.concatenate([p.orientation_xyzw for p in poses])[counts])
    errors = pose_errors(
        transform_from(rotation, np.concatenate([p.position_m for p in poses])[counts]),
        run.world.pose_at((stamps_ns[counts] - run.start_ns) / 1e9),
        run.world.prisms_m.mean(axis=0),
    )
    return EstimatorFigures(
        poses=sum(session.poses for session in run.sessions),
        valid_poses=len(stamps_ns),
        position_rms_mm=errors.position_rms_mm,
        orientation_rms_deg=errors.orientation_rms_deg,
        inter_prism_mean_mm=_inter_prism_mean_mm(run),
    )


def _inter_prism_mean_mm(run: Run) -> float:
    """Return the mean over all pairs of how far their interpolated distances are from those of the layout."""
    measurements = [measurement for session in run.sessions for measurement in session.measurements]
    tracks = build_tracks(run.parameters, measurements)
    if not all(len(track) for track in tracks.values()):
        return math.nan
    pairs = inter_prism(run.parameters, tracks).dynamic
    return float(np.mean([pair.summary().mean_abs_error for pair in pairs]))


def figures(run: Run) -> dict[str, Any]:
    """Put the figures under the keys that others rely on."""
    estimator = estimator_figures(run)
    return {
        "stations": {
            number: {
                "measured": station.measured,
                "delivered": station.delivered,
                "duplicates": station.duplicates,
                "rate_hz": station.rate_hz,
                "time_error_us": dict(zip(("p50", "p99", "max"), station.time_error_us, strict=True)),
            }
            for number, station in station_figures(run).items()
        },
        "estimators": {
            run.parameters.pipeline.estimator: {
                "poses": estimator.poses,
                "valid_poses": estimator.valid_poses,
                "position_rms_mm": estimator.position_rms_mm,
                "orientation_rms_deg": estimator.orientation_rms_deg,
                "inter_prism_mean_mm": estimator.inter_prism_mean_mm,
            }
        },
        "airtime_fraction": run.airtime_s / run.duration_s,
        "sim_seconds": run.duration_s,
    }
