"""Which measurements of a recording are plausible, and why a recording yields no poses."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import RecordingError
from tsgt.estimation import Reason, has_plausible_time, measured_at_ns, usable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from tsgt.estimation import PoseBatch
    from tsgt.model import Measurement, Parameters, StationParameters
    from tsgt.recording import Recording

MAX_EPOCHS = 2_000_000  # 28 h at 20 Hz, about 1.5 GB. More indicate a wrong clock

_DATED_LATE = "dated more than 1 s after they arrived"


def plausible_measurements(recording: Recording) -> list[Measurement]:
    """Return the measurements whose timestamp is plausible given their time of arrival, and those of unknown stations."""
    stations = _stations(recording.parameters)
    return [m for m in recording.measurements if _has_plausible_time(m, stations)]


def no_measurements_message(recording: Recording) -> str:
    """Return why a recording has no plausible measurements, as the predicate of a sentence."""
    if not recording.measurements:
        return "holds no measurements"
    count = len(recording.measurements)
    return f"holds {count} measurements, all {_DATED_LATE} (check the clocks of the stations)"


def check_prisms_measured(recording: Recording, measurements: Sequence[Measurement], path: Path) -> None:
    """Raise if there are no plausible ``measurements``, or none usable of a prism of the layout."""
    if not measurements:
        raise RecordingError(
            f"{no_measurements_message(recording)}, so there is nothing to process", path=path
        )
    seen = measured_prisms(recording.parameters, measurements)
    for prism in (p.prism for p in recording.parameters.prisms):
        if prism not in seen:
            raise RecordingError(
                f"prism {prism} has no usable measurement ({_missing_prism_reason(prism, recording)}), "
                "and without an IMU a pose needs all prisms of the layout; add its station's measurements or use a layout "
                "without it",
                path=path,
            )


def check_any_measured(recording: Recording, measurements: Sequence[Measurement], path: Path) -> None:
    """Raise if there is no usable measurement at all; with an IMU any prism will do."""
    if not measured_prisms(recording.parameters, measurements):
        check_prisms_measured(recording, measurements, path)


def measured_prisms(parameters: Parameters, measurements: Sequence[Measurement]) -> set[int]:
    """Return the prisms of the layout that have a usable measurement of a known station."""
    return {m.prism for m in _usable_measurements(parameters, measurements)}


def check_time_span(parameters: Parameters, measurements: Sequence[Measurement], path: Path) -> None:
    """Raise if the usable measurements are of one instant, or all span more than :data:`MAX_EPOCHS` epochs."""
    stations = _stations(parameters)
    instants = {
        measured_at_ns(m, stations[m.station]) for m in _usable_measurements(parameters, measurements)
    }
    if len(instants) == 1:
        raise RecordingError(
            "its usable measurements are all of one instant, which gives no trajectory: record for longer",
            path=path,
        )
    stamps = [m.stamp_ns for m in measurements]
    span_ns = max(stamps, default=0) - min(stamps, default=0)
    if span_ns > MAX_EPOCHS * parameters.pipeline.period_ns:
        raise RecordingError(
            f"its measurements span {span_ns / 86_400e9:.1f} days, too many for one trajectory: "
            "remove those with timestamps of a wrong clock (or, for `tsgt process`, give a lower --rate)",
            path=path,
        )


def _stations(parameters: Parameters) -> dict[int, StationParameters]:
    return {station.station: station for station in parameters.stations}


def _has_plausible_time(measurement: Measurement, stations: Mapping[int, StationParameters]) -> bool:
    station = stations.get(measurement.station)
    return station is None or has_plausible_time(measurement, station)


def _usable_measurements(
    parameters: Parameters, measurements: Sequence[Measurement]
) -> Iterator[Measurement]:
    """Return the usable measurements of the layout's prisms by known stations."""
    stations, prisms = _stations(parameters), {prism.prism for prism in parameters.prisms}
    return (m for m in measurements if usable(m) and m.station in stations and m.prism in prisms)


def _missing_prism_reason(prism: int, recording: Recording) -> str:
    parameters, stations = recording.parameters, _stations(recording.parameters)
    received = [m for m in recording.measurements if m.prism == prism]
    unknown = sorted({m.station for m in received} - set(stations))
    if unknown:
        return f"station {unknown[0]} measured it, but is not among the parameters"
    statuses = Counter(m.status.value for m in received if _has_plausible_time(m, stations))
    dated_late = sorted({m.station for m in received if not _has_plausible_time(m, stations)})
    reasons = []
    if statuses:
        listed = ", ".join(f"{status} ({n})" for status, n in statuses.most_common())
        reasons.append(f"{statuses.total()} with status {listed}")
    if dated_late:
        count = len(received) - statuses.total()
        clocks = " and ".join(map(str, dated_late))
        reasons.append(f"{count} {_DATED_LATE}: check the clock of station {clocks}")
    if reasons:
        return ", ".join(reasons)
    trackers = [str(s.station) for s in parameters.stations if s.prism == prism]
    return (
        f"station {' and '.join(trackers)} sent no measurement of it" if trackers else "no station tracks it"
    )


def no_valid_pose_message(poses: PoseBatch, parameters: Parameters) -> str:
    """Return one line that names the most frequent reason for invalid poses, and what to check."""
    counts = poses.invalid_counts()
    if not counts:
        return "the measurements of the stations have no pose epoch in common; record for longer"
    # Reasons of computed poses are more informative than outages, which every recording has.
    specific = (
        Reason.TILT,
        Reason.RESIDUAL,
        Reason.DEGENERATE_GEOMETRY,
        Reason.UNCERTAIN,
        Reason.CONTRADICTED,
    )
    computed = [reason for reason in specific if reason.word in counts]
    candidates = computed or [r for r in Reason if r.word in counts]
    limits = parameters.pipeline
    match max(candidates, key=lambda reason: counts[reason.word]):
        case Reason.TILT:
            advice = (
                "the robot would be upside down: the prism layout is mirrored or two prisms are swapped; "
                "check numbers and signs of the prism positions"
            )
        case Reason.RESIDUAL:
            typical_mm = float(np.nanmedian(poses.residual_m)) * 1e3
            advice = (
                f"the layout residual is {typical_mm:.0f} mm (median), the limit is "
                f"{limits.residual_limit_m * 1e3:.0f} mm: check for swapped prisms, another robot's layout, "
                "wrong station frames"
            )
        case Reason.DEGENERATE_GEOMETRY:
            advice = "the measured prisms lie in a line or coincide: check which station tracks which prism"
        case Reason.UNCERTAIN:
            advice = (
                f"at no epoch is sigma of position at most {limits.position_sigma_limit_m * 1e3:g} mm and of rotation at "
                f"most {math.degrees(limits.rotation_sigma_limit_rad):g} degrees: check that the stations' times overlap, "
                "and which station tracks which prism"
            )
        case Reason.STATION_STATUS:
            advice = "the stations report errors: check tilt, prism and lock"
        case Reason.CONTRADICTED:
            advice = (
                "the IMU contradicts the measurements: a tripod, a prism or the IMU may have moved; in the field, "
                "`tsgt calibrate check` measures targets again and tells whether a tripod has"
            )
        case _:
            advice = (
                f"at no epoch do all prisms have measurements at most {limits.outage_limit_ns / 1e9:g} s apart "
                "around it: check that the stations' times overlap"
            )
    listed = ", ".join(f"{reason} {count}" for reason, count in counts.items())
    return f"none of {len(poses)} poses is valid ({listed}); {advice}"
