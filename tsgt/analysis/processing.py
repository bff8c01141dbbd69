"""Poses from a recording, all measurements taken in the order of time."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import ConfigError, DegenerateGeometryError, RecordingError
from tsgt.geometry import check_layout
from tsgt.master.pipeline import Pipeline
from tsgt.master.pose_batch import Reason
from tsgt.master.tracks import believable, usable
from tsgt.model import PolarMeasurement, PrismPosition

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.master.pose_batch import PoseBatch
    from tsgt.model import Matrix4, Measurement, Parameters, Vector3
    from tsgt.recording import Recording


EPOCHS_MAX = 2_000_000
"""More poses at once than this (28 h at 20 Hz, about 1.5 GB) come of a wrong clock, not of field work."""


def process(recording: Recording, *, path: Path) -> PoseBatch:
    """Compute the poses of a recording with the parameters that it holds.

    Measurements that came late count where they belong. Without late ones the poses are those of the live stream.

    Parameters
    ----------
    recording
        Measurements and the parameters in force.
    path
        Its file, for messages.

    Returns
    -------
    PoseBatch
        All epochs, valid or not; at least one of them is valid.

    Raises
    ------
    RecordingError
        There are no measurements, none for one of the prisms, they span days, or no epoch has a valid pose.
    DegenerateGeometryError
        The prism layout cannot be used: prisms coincide or lie in a line.
    """
    parameters = recording.parameters
    pipeline = Pipeline(parameters)
    stations = {station.station: station for station in parameters.stations}
    measurements = [
        m for m in recording.measurements if m.station not in stations or believable(m, stations[m.station])
    ]
    _check_measured(parameters, measurements, path)
    _check_span(parameters, measurements, path)
    for measurement in sorted(measurements, key=lambda m: m.stamp_ns):
        pipeline.add(measurement)
    assert recording.end_ns is not None  # noqa: S101 (it has measurements, and each of them arrived)
    # A master that was left running has nothing to say for the days after the last measurement.
    first_ns = min(m.stamp_ns for m in measurements)
    poses = pipeline.advance(min(recording.end_ns, first_ns + EPOCHS_MAX * parameters.pipeline.period_ns))
    if not poses.valid.any():
        raise RecordingError(_why_none_is_valid(poses, parameters), path=path)
    return poses


def with_frames(parameters: Parameters, frames: Mapping[int, Matrix4], *, path: Path) -> Parameters:
    """Replace the frames of all stations by those of a set-up file.

    Parameters
    ----------
    parameters
        As recorded.
    frames
        ``T_station1_station`` by station number.
    path
        The set-up file, for messages.

    Raises
    ------
    ConfigError
        A station of the recording has no frame in the file.
    """
    missing = [s.station for s in parameters.stations if s.station not in frames]
    if missing:
        raise ConfigError(
            f"{path}: stations.{missing[0]}: missing; the recording has this station", path=path
        )
    stations = (dataclasses.replace(s, T_station1_station=frames[s.station]) for s in parameters.stations)
    return dataclasses.replace(parameters, stations=tuple(stations))


def with_layout(parameters: Parameters, layout: Mapping[int, Vector3], *, path: Path) -> Parameters:
    """Replace the prism layout by that of a set-up file; its prisms that the recording does not have are left out.

    Parameters
    ----------
    parameters
        As recorded.
    layout
        Positions in the robot frame in m by prism number.
    path
        The set-up file, for messages.

    Raises
    ------
    ConfigError
        A prism of the recording has no position in the file, or no pose can come of the layout.
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
    """Tell whether station frames matter to any of the measurements: Cartesian points are in frame 1 already."""
    return any(isinstance(m, PolarMeasurement) for m in measurements)


def _check_measured(parameters: Parameters, measurements: Sequence[Measurement], path: Path) -> None:
    """Refuse a recording in which a prism of the layout was never measured: no pose can come of it."""
    if not measurements:
        raise RecordingError("holds no measurements, so there is nothing to process", path=path)
    known = {station.station for station in parameters.stations}
    seen = {m.prism for m in measurements if usable(m) and m.station in known}
    for prism in (p.prism for p in parameters.prisms):
        if prism not in seen:
            raise RecordingError(
                f"prism {prism} has no usable measurement ({_what_came(prism, known, measurements, parameters)}), "
                "and a pose needs all prisms of the layout; add its station's measurements or take a layout without it",
                path=path,
            )


def _check_span(parameters: Parameters, measurements: Sequence[Measurement], path: Path) -> None:
    stamps = [m.stamp_ns for m in measurements]
    span_ns = max(stamps) - min(stamps)
    if span_ns > EPOCHS_MAX * parameters.pipeline.period_ns:
        raise RecordingError(
            f"its measurements span {span_ns / 86_400e9:.1f} days, too many for one trajectory: "
            "leave out those that were stamped by a wrong clock, or process with a lower --rate",
            path=path,
        )


def _what_came(
    prism: int, known: set[int], measurements: Sequence[Measurement], parameters: Parameters
) -> str:
    came = [m for m in measurements if m.prism == prism]
    strangers = sorted({m.station for m in came} - known)
    if strangers:
        return f"station {strangers[0]} measured it, but is not among the parameters"
    if came:
        statuses = Counter(m.status.value for m in came)
        return f"{len(came)} with status " + ", ".join(
            f"{status} ({n})" for status, n in statuses.most_common()
        )
    homes = [str(s.station) for s in parameters.stations if s.prism == prism]
    return f"station {' and '.join(homes)} sent none of it" if homes else "no station tracks it"


def _why_none_is_valid(poses: PoseBatch, parameters: Parameters) -> str:
    counts = poses.invalid_counts()
    if not counts:
        return "the measurements of the stations have no pose epoch in common; record for longer"
    # A pose that was computed and refused tells more than gaps, of which every recording has some.
    computed = [r for r in (Reason.TILT, Reason.RESIDUAL, Reason.DEGENERATE_GEOMETRY) if r.word in counts]
    candidates = computed or [r for r in Reason if r.word in counts]
    limits = parameters.pipeline
    match max(candidates, key=lambda reason: counts[reason.word]):
        case Reason.TILT:
            advice = (
                "the robot would lie upside down: the prism layout is mirrored or two prisms are swapped; "
                "check numbers and signs of the prism positions"
            )
        case Reason.RESIDUAL:
            typical_mm = float(np.nanmedian(poses.residual_m)) * 1e3
            advice = (
                f"the prisms miss their layout by {typical_mm:.0f} mm (median), allowed are "
                f"{limits.residual_limit_m * 1e3:.0f} mm: check for swapped prisms, another robot's layout, "
                "wrong station frames"
            )
        case Reason.DEGENERATE_GEOMETRY:
            advice = (
                "the measured prisms lie in a line or at one place: check which station tracks which prism"
            )
        case Reason.STATION_STATUS:
            advice = "the stations report errors: check tilt, prism and lock"
        case _:
            advice = (
                f"at no epoch do all prisms have measurements at most {limits.outage_limit_ns / 1e9:g} s apart "
                "around it: check that the stations' times overlap"
            )
    listed = ", ".join(f"{reason} {count}" for reason, count in counts.items())
    return f"none of {len(poses)} poses is valid ({listed}); {advice}"
