"""Estimator ``continuous`` over a whole recording: one smooth trajectory through all measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.refinement import refine_recorded_setup
from tsgt.analysis.validation import (
    check_prisms_measured,
    check_time_span,
    no_valid_pose_message,
    plausible_measurements,
)
from tsgt.errors import GeometryError, RecordingError
from tsgt.estimation import (
    ContinuousPoseOutput,
    MeasurementHistory,
    PoseBatch,
    build_observations,
    measured_at_ns,
    noise_scales,
    setup_jacobian,
    usable,
    with_setup,
)
from tsgt.geometry import check_layout
from tsgt.geometry.batch import NOISE_FLOOR_SHARE, fit_trajectory, overall_scale, tune, with_noise_floor

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from tsgt.analysis.refinement import Refine
    from tsgt.geometry import FloatArray
    from tsgt.geometry.batch import TrajectoryFit
    from tsgt.geometry.motion_calibration import RefinedSetup
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import Measurement, MotionPrior, Parameters, PipelineParameters
    from tsgt.recording import Recording

# Bounds the memory of intermediate results, which should fit into the CPU cache.
_EPOCHS_PER_CHUNK = 1024

_POSE_DIM = 6


@dataclass(frozen=True, slots=True)
class MotionModel:
    """Process noise and factors on the stated sigmas: ``tuned`` to the measurements; if too few, those of the recording."""

    prior: MotionPrior
    noise_scales: FloatArray  # (S + 1, 3) by station, Cartesian points last, and component
    noise_scale: float  # Their root mean square over all measurements and components
    tuned: bool


@dataclass(frozen=True, slots=True)
class SmoothedRecording:
    """Trajectory fitted to a recording, and its poses at the epochs from the first to the last usable measurement.

    ``sources``: measurement of each observation of the fit. ``origin_ns``: Unix time at which its time is zero.
    """

    poses: PoseBatch
    fit: TrajectoryFit
    motion: MotionModel
    sources: list[Measurement]
    origin_ns: int
    parameters: Parameters  # of the recording, with the set-up that was used
    refinement: RefinedSetup | None  # None: switched off or not possible


def smooth_recording(
    recording: Recording,
    *,
    path: Path,
    refine: Refine = "auto",
    on_progress: Callable[[float], None] | None = None,
) -> SmoothedRecording:
    """Fit a smooth trajectory to all measurements of a recording, with its set-up or, where they contradict it, a refined one.

    The hyperparameters are estimated from the measurements. Those of the recording, which the live estimator used, bound the
    process noise: at least a third of them, and all of them while prisms are occluded. Progress is a fraction, 0 to 1.
    Raises as :func:`tsgt.analysis.processing.process`, also RecordingError if no trajectory fits.
    """
    parameters = recording.parameters
    names = [prism.prism for prism in parameters.prisms]
    check_layout(np.array([prism.position_m for prism in parameters.prisms]), names=names)
    measurements = plausible_measurements(recording)
    check_prisms_measured(parameters, measurements, path)
    check_time_span(parameters, measurements, path)
    origin_ns = min(m.stamp_ns for m in measurements)
    observations, sources = build_observations(parameters, measurements, origin_ns=origin_ns)
    motion = estimate_motion_model(observations, parameters.pipeline, recorded=noise_scales(parameters))
    refined = None
    if motion.tuned:
        refined = refine_recorded_setup(parameters, observations, motion.prior, motion.noise_scales, refine)
    if refined is not None and refined.used:
        parameters = with_setup(parameters, refined.parameters, refined.setup, refined.covariance)
        observations, sources = build_observations(parameters, measurements, origin_ns=origin_ns)
        motion = estimate_motion_model(observations, parameters.pipeline, start=refined.motion_prior)
    try:
        found = fit_trajectory(
            observations,
            prior=motion.prior,
            occluded_prior=parameters.pipeline.motion,
            noise_scale=motion.noise_scales,
            setup_jacobian=setup_jacobian(parameters),
            on_progress=on_progress,
        )
    except GeometryError as error:
        raise RecordingError(str(error), path=path) from error
    poses = _poses(found, parameters, measurements, sources, origin_ns)
    if not poses.valid.any():
        raise RecordingError(no_valid_pose_message(poses, parameters), path=path)
    return SmoothedRecording(poses, found, motion, sources, origin_ns, parameters, refined)


def estimate_motion_model(
    observations: Observations,
    pipeline: PipelineParameters,
    *,
    recorded: FloatArray | None = None,
    start: MotionPrior | None = None,
) -> MotionModel:
    """Estimate the hyperparameters, with a floor on the process noise; too few measurements: return those of ``pipeline``.

    ``recorded``: noise scales, (S + 1, 3), for that case; by default the factor of ``pipeline`` for all. ``start``: prior near the
    result, which saves time.
    """
    try:
        tuned = tune(observations, start=start)
    except GeometryError:
        scales = (
            np.full((len(observations.frames), 3), pipeline.noise_scale) if recorded is None else recorded
        )
        return MotionModel(pipeline.motion, scales, overall_scale(observations, scales), tuned=False)
    return MotionModel(
        with_noise_floor(tuned.prior, pipeline.motion, NOISE_FLOOR_SHARE),
        tuned.noise_scales,
        tuned.noise_scale,
        tuned=True,
    )


def _poses(
    found: TrajectoryFit,
    parameters: Parameters,
    measurements: Sequence[Measurement],
    sources: Sequence[Measurement],
    origin_ns: int,
) -> PoseBatch:
    stations = {station.station: station for station in parameters.stations}
    seen = MeasurementHistory(
        times_ns=np.array([measured_at_ns(m, stations[m.station]) for m in sources], dtype=np.int64),
        stations=np.array([m.station for m in sources], dtype=np.int64),
        prisms=found.observations.prism,
        residuals_m=np.linalg.norm(found.residuals_m, axis=1),
        unusable_ns=[
            np.array(
                sorted(
                    measured_at_ns(m, stations[m.station])
                    for m in measurements
                    if m.prism == prism.prism and m.station in stations and not usable(m)
                ),
                dtype=np.int64,
            )
            for prism in parameters.prisms
        ],
    )
    period_ns = parameters.pipeline.period_ns
    first, last = -(-int(seen.times_ns[0]) // period_ns), int(seen.times_ns[-1]) // period_ns
    epochs_ns = np.arange(first, last + 1, dtype=np.int64) * period_ns
    chunks, poses = [], ContinuousPoseOutput(parameters)
    for start in range(0, max(len(epochs_ns), 1), _EPOCHS_PER_CHUNK):
        some_ns = epochs_ns[start : start + _EPOCHS_PER_CHUNK]
        time_s = (some_ns - origin_ns) / 1e9
        states, covariance = found.trajectory.at(time_s, dim=_POSE_DIM)
        common = found.trajectory.common_at(time_s, dim=_POSE_DIM)
        chunks.append(poses.smoothed(some_ns, seen, states, covariance, common=common))
    return PoseBatch.concatenated(chunks)
