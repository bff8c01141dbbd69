"""Poses of a recording."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

from tsgt.analysis.smoothing import smooth_poses
from tsgt.analysis.validation import (
    MAX_EPOCHS,
    check_prisms_measured,
    check_time_span,
    no_valid_pose_message,
    plausible_measurements,
)
from tsgt.errors import RecordingError
from tsgt.estimation import LinearEstimator
from tsgt.model import PolarMeasurement

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from tsgt.estimation import PoseBatch
    from tsgt.model import Measurement
    from tsgt.recording import Recording

Estimator = Literal["linear", "continuous"]


def process(
    recording: Recording, *, path: Path, on_progress: Callable[[float], None] | None = None
) -> PoseBatch:
    """Compute the poses of a recording with its own parameters and estimator: all epochs, at least one of them valid.

    Measurements are processed in the order of their timestamps. With ``linear`` the poses equal those of the live stream if
    no measurement arrived late; with ``continuous`` each pose depends on the measurements before and after it.
    ``on_progress`` gets the completed fraction, 0 to 1. Raises RecordingError without measurements at all or of one of the
    prisms, if they span days, or if no epoch has a valid pose; DegenerateGeometryError if the prisms coincide or lie in a
    line.
    """
    if recording.parameters.pipeline.estimator == "continuous":
        return smooth_poses(recording, path=path, on_progress=on_progress).poses
    parameters = recording.parameters
    pipeline = LinearEstimator(parameters)
    measurements = plausible_measurements(recording)
    check_prisms_measured(recording, measurements, path)
    check_time_span(parameters, measurements, path)
    for measurement in sorted(measurements, key=lambda m: m.stamp_ns):
        pipeline.add(measurement)
    assert recording.end_ns is not None  # noqa: S101 (it has measurements, and each of them arrived)
    # A master may have kept running for days after the last measurement.
    first_ns = min(m.stamp_ns for m in measurements)
    poses = pipeline.advance(min(recording.end_ns, first_ns + MAX_EPOCHS * parameters.pipeline.period_ns))
    if not poses.valid.any():
        raise RecordingError(no_valid_pose_message(poses, parameters), path=path)
    return poses


def with_estimator(recording: Recording, estimator: Estimator) -> Recording:
    """Return the recording with another estimator in its parameters."""
    pipeline = dataclasses.replace(recording.parameters.pipeline, estimator=estimator)
    return dataclasses.replace(
        recording, parameters=dataclasses.replace(recording.parameters, pipeline=pipeline)
    )


def has_raw_angles(measurements: Sequence[Measurement]) -> bool:
    """Return whether any measurement depends on a station frame; Cartesian points are in frame ``station1``."""
    return any(isinstance(m, PolarMeasurement) for m in measurements)
