"""Reads recordings: torn ends are skipped, corrupt lines are errors, unknown types are ignored."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from dataclasses import dataclass, field
from statistics import median
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.model import (
    ImuSamples,
    Measurement,
    OdometrySamples,
    Parameters,
    PointMeasurement,
    PolarMeasurement,
)
from tsgt.recording.format import (
    HEADER_START,
    MAX_LINE_BYTES,
    NO_HEADER,
    Line,
    RecordingHeader,
    Typed,
    check_header,
    decode,
    decode_line,
)
from tsgt.recording.merged import MergedRecord, same_content

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


# Start of every line as it is written, of the IMU and of poses
_LINE_START = b'{"type":'
_IMU_START, _POSE_START = _LINE_START + b'"imu",', _LINE_START + b'"pose",'

S = TypeVar("S", ImuSamples, OdometrySamples)
_TAGS: dict[type, str] = {ImuSamples: "imu", OdometrySamples: "odometry"}

SAME_MEASUREMENT_NS = 1_000_000_000
"""Two masters give a measurement times that differ by less. Later, a robot at rest may give all of its values again."""

MIN_JUDGED = 10
"""Fewer measurements are not judged by their units: some may be damaged."""

MAX_ZENITH_RAD, MAX_DISTANCE_M = 7.0, 10_000.0
"""Limits of medians: a full turn, and what no total station measures."""

_MEASUREMENTS: dict[str, type[Measurement]] = {"measurement": PolarMeasurement, "point": PointMeasurement}


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """The content of a recording that post-processing needs."""

    header: RecordingHeader  # of the first run of the master
    parameters: Parameters  # the last ones in the file
    measurements: list[Measurement]
    """In the order of arrival, merged ones at their place in the file; each once, also if several runs have it."""
    end_ns: int | None
    """Latest arrival, status or event in the file, on the master's Unix clock in ns; None without any."""
    imu_samples: list[ImuSamples] = field(
        default_factory=list
    )  # in the order of arrival; empty unless they were read
    odometry: list[OdometrySamples] = field(default_factory=list)  # likewise
    left_out: int = 0
    """Measurements before the set-up was replaced while the master ran: the last parameters need not apply to them."""
    set_ups_differ: bool = False
    """Whether runs that were joined have another set-up than the last, which is used for all of them."""


@dataclass(frozen=True, slots=True)
class _Stamped:
    stamp_ns: int


class _Origin(NamedTuple):
    """Where a measurement comes from: the number of the master's run in the file, and whether it was merged from a journal."""

    run: int
    merged: bool


def read_lines(
    path: Path,
    *,
    imu: bool = False,
    poses: bool = True,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Iterator[Line]:
    """Yield the lines of a recording, headers included; each is checked to be JSON with a type.

    ``imu``: also yield the lines of the IMU, which are most of the bytes of a recording; skipping them costs little.
    ``poses``: likewise the poses, most of the lines. Lines that are skipped are not checked, but for another line in them.

    ``keep_going``: skip lines that cannot be read instead of raising. ``on_problem``: called for each skipped line: a
    torn last line of a run always, others with ``keep_going``.

    Raises
    ------
    RecordingError
        The file cannot be read, or does not begin with the header of a recording.
    RecordingVersionError
        It was written in another version of the format.
    CorruptLineError
        A line is not JSON with a type, and ``keep_going`` is not set.
    """
    number = 0
    skipped = tuple(start for start, wanted in ((_IMU_START, imu), (_POSE_START, poses)) if not wanted)
    for number, raw in enumerate(_raw_lines(path), start=1):
        # Where the end of a line was lost, a measurement may follow in the same one.
        if number > 1 and raw.startswith(skipped) and raw.endswith(b"}\n") and raw.find(_LINE_START, 1) < 0:
            continue
        for piece in _divided(raw):
            data = piece.removesuffix(b"\n") if piece.endswith(b"\n") else piece.rstrip(b"\0")
            try:
                kind = decode(Typed, data).type
                if kind == "recording":
                    check_header(data, path, number)
            except ValueError as error:
                if number == 1 and not piece.strip(b"\0"):
                    raise RecordingError(
                        "holds only zero bytes: a power cut came before its first line was on the disk",
                        path=path,
                    ) from error
                if number == 1:
                    raise RecordingError(NO_HEADER, path=path) from error
                problem = _unreadable(piece, str(error), path, number)
                if len(piece) < len(raw) and not piece.endswith(b"\n"):
                    problem = RecordingError(
                        "the last line of a run is torn and is skipped", path=path, line=number
                    )
                if not keep_going and isinstance(problem, CorruptLineError):
                    raise problem from error
                if on_problem is not None:
                    on_problem(problem)
                continue
            if number == 1 and kind != "recording":
                raise RecordingError(NO_HEADER, path=path)
            yield Line(number, kind, data)
    if number == 0:
        raise RecordingError("is empty; it does not even have the header of a recording", path=path)


def load_recording(
    path: Path,
    *,
    imu: bool = False,
    whole: bool = False,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Recording:
    """Read measurements and parameters for post-processing.

    Where the set-up was replaced by another while the master ran, what precedes the last set-up is left out: the tripods may have
    stood elsewhere. ``whole``: include it. ``imu``: also read the samples of the robot's IMU and wheel odometry. ``keep_going``, ``on_problem``: as for :func:`read_lines`; a line with missing or wrong fields counts as one that
    cannot be read. Raises RecordingError as :func:`read_lines`, without parameters in the file, and where
    angles or distances are in another unit.
    """
    header: RecordingHeader | None = None
    parameters: Parameters | None = None
    measurements: list[Measurement] = []
    origins: list[_Origin] = []  # of the measurements
    run = 0
    imu_samples: list[ImuSamples] = []
    odometry: list[OdometrySamples] = []
    end_ns: int | None = None
    left_out = 0
    replaced = new_session = set_ups_differ = False
    valid_from_ns = -(2**63)  # measurements before the last set-up arrive late or were merged
    for line in read_lines(path, imu=imu, poses=False, keep_going=keep_going, on_problem=on_problem):
        known_ns: int | None = None
        try:
            match line.type:
                case "recording":
                    header = header or decode_line(RecordingHeader, line, path)
                    run += 1
                    new_session = True
                case "parameters":
                    previous, parameters = parameters, decode_line(Parameters, line, path)
                    differs = previous is not None and not parameters.same_corrections(previous)
                    reloaded = not new_session and parameters != previous
                    set_ups_differ = not reloaded and (set_ups_differ or differs)
                    replaced = reloaded and not whole
                    if replaced:
                        left_out += len(measurements)
                        for samples in (measurements, origins, imu_samples, odometry):
                            samples.clear()
                    new_session = False
                case "measurement" | "point":
                    measurement: Measurement = decode_line(_MEASUREMENTS[line.type], line, path)
                    measurements.append(measurement)
                    origins.append(_Origin(run, merged=False))
                    known_ns = measurement.received_ns
                case "merged":
                    measurements.append(decode_line(MergedRecord, line, path).measurement)
                    origins.append(_Origin(run, merged=True))
                    known_ns = measurements[-1].received_ns
                case "setup" if replaced:
                    valid_from_ns, replaced = decode_line(_Stamped, line, path).stamp_ns, False
                case "imu":
                    imu_samples.append(decode_line(ImuSamples, line, path))
                case "odometry" if imu:
                    odometry.append(decode_line(OdometrySamples, line, path))
                case "status" | "event":
                    known_ns = decode_line(_Stamped, line, path).stamp_ns
        except CorruptLineError as problem:
            if not keep_going:
                raise
            if on_problem is not None:
                on_problem(problem)
        if known_ns is not None:
            end_ns = known_ns if end_ns is None else max(end_ns, known_ns)
    if run > 1:
        measurements = _counted_once(measurements, origins)
    early = [each for each in measurements if each.stamp_ns < valid_from_ns]
    if early:
        measurements = [each for each in measurements if each.stamp_ns >= valid_from_ns]
    if header is None or parameters is None:  # read_lines has checked the header
        raise RecordingError("contains no parameters; the program that wrote it ended too early", path=path)
    _check_units(measurements, path)
    return Recording(
        header=header,
        parameters=parameters,
        measurements=measurements,
        end_ns=end_ns,
        imu_samples=imu_samples,
        odometry=odometry,
        left_out=left_out + len(early),
        set_ups_differ=set_ups_differ,
    )


def _check_units(measurements: list[Measurement], path: Path) -> None:
    """Raise RecordingError where angles or distances are in another unit: no robot fits them, which a search finds out slowly."""
    angles = [abs(each.zenith_angle_rad) for each in measurements if isinstance(each, PolarMeasurement)]
    distances = [
        math.hypot(*each.position_m) if isinstance(each, PointMeasurement) else each.slope_distance_m or 0.0
        for each in measurements
    ]
    for values, name, median_name, limit, unit in (
        (angles, "angles", "median zenith angle", MAX_ZENITH_RAD, "rad"),
        (distances, "distances", "median", MAX_DISTANCE_M, "m"),
    ):
        if len(values) >= MIN_JUDGED and (found := median(values)) > limit:
            raise RecordingError(
                f"its {name} are in another unit: the {median_name} is {found:.6g}, but in {unit} it is at most "
                f"{limit:g}; convert them to {unit}",
                path=path,
            )


def _counted_once(measurements: list[Measurement], origins: list[_Origin]) -> list[Measurement]:
    """Return measurements of several runs without those that another run has as well.

    A master that is killed before it acknowledges a measurement has recorded it, and the next one records it again; a journal
    may be merged into each run. Of one that was delivered and merged the delivered one is returned, otherwise the first.
    """
    kept: list[int] = []
    earlier: defaultdict[object, list[int]] = defaultdict(list)
    for row in sorted(range(len(measurements)), key=lambda row: origins[row].merged):
        measurement = measurements[row]
        is_polar = isinstance(measurement, PolarMeasurement)
        others = earlier[(measurement.station, measurement.sequence) if is_polar else measurement]
        if not any(
            origins[other].run != origins[row].run and _is_same(measurement, measurements[other])
            for other in others
        ):
            kept.append(row)
            others.append(row)
    return [measurements[row] for row in sorted(kept)]


def _is_same(one: Measurement, other: Measurement) -> bool:
    """Whether two measurements of different runs, of equal number, are the same one."""
    if isinstance(one, PointMeasurement) or isinstance(other, PointMeasurement):
        return one == other
    return abs(one.stamp_ns - other.stamp_ns) <= SAME_MEASUREMENT_NS and same_content(one, other)


def replaced_line(path: Path) -> int:
    """Return the number of the last line with parameters that replace others while the master runs; 0: there is none."""
    found, begins, previous = 0, False, b""
    for number, line in enumerate(_raw_lines(path), start=1):
        if line.startswith(b'{"type":"parameters"'):
            found = number if not begins and line != previous else found
            begins, previous = False, line
        elif HEADER_START in line:
            begins = True
    return found


def read_imu_samples(
    path: Path,
    *,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Iterator[ImuSamples]:
    """Yield the samples of the robot's IMU in the order of arrival; parameters and errors as of :func:`read_lines`."""
    yield from _read_samples(ImuSamples, path, keep_going=keep_going, on_problem=on_problem)


def read_odometry(
    path: Path,
    *,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Iterator[OdometrySamples]:
    """Yield the samples of the wheel odometry, as :func:`read_imu_samples`."""
    yield from _read_samples(OdometrySamples, path, keep_going=keep_going, on_problem=on_problem)


def _read_samples(
    kind: type[S],
    path: Path,
    *,
    keep_going: bool,
    on_problem: Callable[[RecordingError], None] | None,
) -> Iterator[S]:
    for line in read_lines(path, imu=True, keep_going=keep_going, on_problem=on_problem):
        if line.type != _TAGS[kind]:
            continue
        try:
            samples = decode_line(kind, line, path)
        except CorruptLineError as problem:
            if not keep_going:
                raise
            if on_problem is not None:
                on_problem(problem)
        else:
            yield samples


def _divided(raw: bytes) -> tuple[bytes, ...]:
    """Return a line in two where a run that was joined begins in it, because the run before has lost the end of its last line."""
    start = raw.find(HEADER_START, 1)
    return (raw,) if start < 0 else (raw[:start], raw[start:])


def _unreadable(raw: bytes, why: str, path: Path, line: int) -> RecordingError:
    if len(raw) > MAX_LINE_BYTES and raw.endswith(b"\n"):
        return CorruptLineError(
            f"is longer than {MAX_LINE_BYTES} bytes; --keep-going skips it", path=path, line=line
        )
    if raw.endswith(b"\n"):
        if b"\0" in raw:
            why = "it holds zero bytes, as after a power cut"
        return CorruptLineError(f"cannot be read: {why}; --keep-going skips it", path=path, line=line)
    if b"\0" in raw:
        return RecordingError(
            "the file ends with zero bytes, as after a power cut; they are skipped", path=path, line=line
        )
    return RecordingError("the last line is torn and is skipped", path=path, line=line)


def _raw_lines(path: Path) -> Iterator[bytes]:
    """Yield lines with their ends; of a line that is too long only its start."""
    try:
        with path.open("rb") as file:
            read_line = functools.partial(file.readline, MAX_LINE_BYTES)
            for raw in iter(read_line, b""):
                piece = raw
                while len(piece) == MAX_LINE_BYTES and not piece.endswith(b"\n"):
                    piece = read_line()
                # A line that is too long is corrupt if it ends, and a torn tail if not.
                yield raw if piece is raw or not piece.endswith(b"\n") else raw + b"\n"
    except OSError as error:
        raise RecordingError(f"cannot be read ({error.strerror})", path=path) from error
