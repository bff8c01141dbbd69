"""Poses of a recording, and replacing parts of its parameters before processing."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

from tsgt.analysis.smoothing import smooth_recording
from tsgt.analysis.validation import (
    MAX_EPOCHS,
    check_prisms_measured,
    check_time_span,
    no_valid_pose_message,
    plausible_measurements,
)
from tsgt.errors import ConfigError, DegenerateGeometryError, RecordingError
from tsgt.estimation import LinearEstimator
from tsgt.geometry import check_layout
from tsgt.model import PolarMeasurement, PrismPosition

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from tsgt.estimation import PoseBatch
    from tsgt.model import Matrix4, Measurement, Parameters, TargetResidual, Vector3
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
        return smooth_recording(recording, path=path, on_progress=on_progress).poses
    parameters = recording.parameters
    pipeline = LinearEstimator(parameters)
    measurements = plausible_measurements(recording)
    check_prisms_measured(parameters, measurements, path)
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


def with_frames(parameters: Parameters, frames: Mapping[int, Matrix4], *, path: Path) -> Parameters:
    """Replace the frames of all stations by ``T_station1_station`` of a set-up file. Raises ConfigError if one is missing."""
    missing = [s.station for s in parameters.stations if s.station not in frames]
    if missing:
        raise ConfigError(
            f"{path}: stations.{missing[0]}: missing; the recording has this station", path=path
        )
    # The recorded target residuals belong to the replaced frames.
    stations = (
        dataclasses.replace(s, T_station1_station=frames[s.station], targets=()) for s in parameters.stations
    )
    return dataclasses.replace(parameters, stations=tuple(stations))


def with_targets(parameters: Parameters, targets: Mapping[int, tuple[TargetResidual, ...]]) -> Parameters:
    """Replace the target residuals of the stations' frames, by station number."""
    stations = (dataclasses.replace(s, targets=targets.get(s.station, ())) for s in parameters.stations)
    return dataclasses.replace(parameters, stations=tuple(stations))


def with_latencies(parameters: Parameters, latencies_ns: Mapping[int, int]) -> Parameters:
    """Replace the latencies (ns, by station number) of the stations that ``latencies_ns`` contains."""
    stations = (
        dataclasses.replace(s, latency_ns=latencies_ns.get(s.station, s.latency_ns))
        for s in parameters.stations
    )
    return dataclasses.replace(parameters, stations=tuple(stations))


def with_layout(parameters: Parameters, layout: Mapping[int, Vector3], *, path: Path) -> Parameters:
    """Replace the prism layout by that of a set-up file, in m in the robot frame; prisms that the recording lacks are ignored.

    Raises ConfigError if a prism of the recording has no position in the file, or the layout determines no pose.
    """
    missing = [p.prism for p in parameters.prisms if p.prism not in layout]
    if missing:
        raise ConfigError(f"{path}: prisms.{missing[0]}: missing; the recording has this prism", path=path)
    numbers = [p.prism for p in parameters.prisms]
    try:
        check_layout([layout[number] for number in numbers], names=numbers)
    except DegenerateGeometryError as error:
        raise ConfigError(f"{path}: {error}", path=path, key="prisms") from error
    prisms = (PrismPosition(prism=number, position_m=layout[number]) for number in numbers)
    return dataclasses.replace(parameters, prisms=tuple(prisms))


def has_raw_angles(measurements: Sequence[Measurement]) -> bool:
    """Return whether any measurement depends on a station frame; Cartesian points are in frame ``station1``."""
    return any(isinstance(m, PolarMeasurement) for m in measurements)
