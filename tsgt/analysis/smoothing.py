"""Poses of the estimator ``continuous`` from a whole recording: one smooth trajectory through all measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.validation import (
    check_prisms_measured,
    check_time_span,
    no_valid_pose_message,
    plausible_measurements,
)
from tsgt.errors import GeometryError, RecordingError
from tsgt.estimation import ContinuousPoseOutput, PoseBatch, MeasurementHistory, build_observations, measured_at_ns, usable
from tsgt.geometry import check_layout
from tsgt.geometry.trajectory import NOISE_FLOOR_SHARE, fit_trajectory, tune, with_noise_floor

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from tsgt.geometry import Observations
    from tsgt.geometry.trajectory import TrajectoryFit
    from tsgt.model import Measurement, MotionPrior, Parameters, PipelineParameters
    from tsgt.recording import Recording

# Bounds the memory of a long recording's poses; what is computed on the way to them is to stay in a cache.
_EPOCHS_AT_ONCE = 1024

# Parts of a state's error that poses tell of.
_POSE = 6


@dataclass(frozen=True, slots=True)
class MotionModel:
    """How a robot moves and how noisy it was measured.

    Attributes
    ----------
    prior
        How it moves.
    noise_scale
        What the stated noise of the instruments is multiplied by.
    tuned
        Found from the measurements; otherwise they were too few for that, and these are the recording's.
    """

    prior: MotionPrior
    noise_scale: float
    tuned: bool


@dataclass(frozen=True, slots=True)
class SmoothedRecording:
    """A trajectory fitted to a recording.

    Attributes
    ----------
    poses
        At all epochs from the first to the last usable measurement.
    fit
        The trajectory.
    motion
        What it was fitted with.
    sources
        The measurement of each of the fit's observations.
    origin_ns
        What the fit's times count from, on the master's Unix clock.
    """

    poses: PoseBatch
    fit: TrajectoryFit
    motion: MotionModel
    sources: list[Measurement]
    origin_ns: int


def smooth_recording(
    recording: Recording, *, path: Path, on_progress: Callable[[float], None] | None = None
) -> SmoothedRecording:
    """Fit a smooth trajectory to all measurements of a recording.

    How the robot moves is found from the measurements themselves. The recording's own motion parameters, with which the
    live stream was computed, say how lively it must be taken to be: a third of that at least, and all of that while it is
    hidden.

    Parameters
    ----------
    recording
        Measurements and the parameters in force.
    path
        Its file, for messages.
    on_progress
        Called now and then with the share of the work that is done, 0 to 1.

    Raises
    ------
    RecordingError
        There are no measurements, none for one of the prisms, they span days, no trajectory fits them, or no epoch has
        a valid pose.
    DegenerateGeometryError
        The prism layout cannot be used: prisms coincide or lie in a line.
    """
    parameters = recording.parameters
    names = [prism.prism for prism in parameters.prisms]
    check_layout(np.array([prism.position_m for prism in parameters.prisms]), names=names)
    measurements = plausible_measurements(recording)
    check_prisms_measured(parameters, measurements, path)
    check_time_span(parameters, measurements, path)
    origin_ns = min(m.stamp_ns for m in measurements)
    observations, sources = build_observations(parameters, measurements, origin_ns=origin_ns)
    motion = estimate_motion_model(observations, parameters.pipeline)
    try:
        found = fit_trajectory(
            observations,
            prior=motion.prior,
            occluded_prior=parameters.pipeline.motion,
            noise_scale=motion.noise_scale,
            on_progress=on_progress,
        )
    except GeometryError as error:
        raise RecordingError(str(error), path=path) from error
    poses = _poses(found, parameters, measurements, sources, origin_ns)
    if not poses.valid.any():
        raise RecordingError(no_valid_pose_message(poses, parameters), path=path)
    return SmoothedRecording(poses, found, motion, sources, origin_ns)


def estimate_motion_model(observations: Observations, pipeline: PipelineParameters) -> MotionModel:
    """Find how the robot moves; where the measurements are too few to tell, and at least about as lively, as the parameters say."""
    try:
        tuned = tune(observations)
    except GeometryError:
        return MotionModel(pipeline.motion, pipeline.noise_scale, tuned=False)
    return MotionModel(
        with_noise_floor(tuned.prior, pipeline.motion, NOISE_FLOOR_SHARE), tuned.noise_scale, tuned=True
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
    for start in range(0, max(len(epochs_ns), 1), _EPOCHS_AT_ONCE):
        some_ns = epochs_ns[start : start + _EPOCHS_AT_ONCE]
        states, covariance = found.trajectory.at((some_ns - origin_ns) / 1e9, dim=_POSE)
        chunks.append(poses.smoothed(some_ns, seen, states, covariance))
    return PoseBatch.concatenated(chunks)
