"""Poses of the estimator ``continuous`` from a whole recording: one smooth trajectory through all measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.validation import believed, check_measured, check_span, why_none_is_valid
from tsgt.errors import GeometryError, RecordingError
from tsgt.estimation import ContinuousPoses, PoseBatch, Seen, build_observations, measured_at_ns, usable
from tsgt.geometry import check_layout
from tsgt.geometry.trajectory import CALMEST, at_least, fit, tune

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from tsgt.geometry import Observations
    from tsgt.geometry.trajectory import Fit
    from tsgt.model import Measurement, MotionPrior, Parameters, PipelineParameters
    from tsgt.recording import Recording

# Bounds the memory of a long recording's poses; what is computed on the way to them is to stay in a cache.
_EPOCHS_AT_ONCE = 1024

# Parts of a state's error that poses tell of.
_POSE = 6


@dataclass(frozen=True, slots=True)
class Motion:
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
class Smoothed:
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
    fit: Fit
    motion: Motion
    sources: list[Measurement]
    origin_ns: int


def smoothed(
    recording: Recording, *, path: Path, on_progress: Callable[[float], None] | None = None
) -> Smoothed:
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
    measurements = believed(recording)
    check_measured(parameters, measurements, path)
    check_span(parameters, measurements, path)
    origin_ns = min(m.stamp_ns for m in measurements)
    observations, sources = build_observations(parameters, measurements, origin_ns=origin_ns)
    motion = motion_of(observations, parameters.pipeline)
    try:
        found = fit(
            observations,
            prior=motion.prior,
            while_hidden=parameters.pipeline.motion,
            noise_scale=motion.noise_scale,
            on_progress=on_progress,
        )
    except GeometryError as error:
        raise RecordingError(str(error), path=path) from error
    poses = _poses(found, parameters, measurements, sources, origin_ns)
    if not poses.valid.any():
        raise RecordingError(why_none_is_valid(poses, parameters), path=path)
    return Smoothed(poses, found, motion, sources, origin_ns)


def motion_of(observations: Observations, pipeline: PipelineParameters) -> Motion:
    """Find how the robot moves; where the measurements are too few to tell, and at least about as lively, as the parameters say."""
    try:
        tuned = tune(observations)
    except GeometryError:
        return Motion(pipeline.motion, pipeline.noise_scale, tuned=False)
    return Motion(at_least(tuned.prior, pipeline.motion, CALMEST), tuned.noise_scale, tuned=True)


def _poses(
    found: Fit,
    parameters: Parameters,
    measurements: Sequence[Measurement],
    sources: Sequence[Measurement],
    origin_ns: int,
) -> PoseBatch:
    stations = {station.station: station for station in parameters.stations}
    seen = Seen(
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
    chunks, poses = [], ContinuousPoses(parameters)
    for start in range(0, max(len(epochs_ns), 1), _EPOCHS_AT_ONCE):
        some_ns = epochs_ns[start : start + _EPOCHS_AT_ONCE]
        states, covariance = found.trajectory.at((some_ns - origin_ns) / 1e9, parts=_POSE)
        chunks.append(poses.smoothed(some_ns, seen, states, covariance))
    return PoseBatch.concatenated(chunks)
