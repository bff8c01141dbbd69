"""Samples of an IMU recorded by other programs: CSV with named columns, and ROS 2 bags with ``sensor_msgs/Imu``."""

from __future__ import annotations

from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.analysis.formats.csv_table import read_table
from tsgt.errors import InputFileError, MissingExtraError
from tsgt.model import ImuSamples

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from tsgt.model import Vector3

TABLE_SUFFIX = ".csv"

GAP = 1.5  # median intervals; a longer one lacks samples

_SAMPLES_PER_RECORD = 10
_MIN_SAMPLES = 2

_TIME = ("stamp_ns", "time_s")
_RATE = tuple(f"angular_rate_{axis}_radps" for axis in "xyz")
_FORCE = tuple(f"specific_force_{axis}_mps2" for axis in "xyz")
_MESSAGE = "sensor_msgs/msg/Imu"


class FileSample(NamedTuple):
    """One sample: its time on the clock of the computer that recorded it."""

    stamp_ns: int
    angular_rate_radps: Vector3
    specific_force_mps2: Vector3


def read_imu_file(path: Path, topic: str | None = None) -> list[FileSample]:
    """Read a CSV file or a bag in the order of time; repeated samples are dropped.

    ``topic``: of a bag; default: the only one with IMU messages. Raises InputFileError if the file cannot be used, and
    MissingExtraError for a bag without the library rosbags.
    """
    samples = list(_table(path) if path.suffix == TABLE_SUFFIX else _bag(path, topic))
    unique = {sample.stamp_ns: sample for sample in samples}
    if len(unique) < _MIN_SAMPLES:
        raise InputFileError("contains fewer than two samples of an IMU", path=path)
    return [unique[stamp_ns] for stamp_ns in sorted(unique)]


def interval_ns(samples: Sequence[FileSample]) -> int:
    """Return the median interval between samples."""
    return max(1, round(median(b.stamp_ns - a.stamp_ns for a, b in pairwise(samples))))


def imu_records(samples: Sequence[FileSample], offset_ns: int) -> Iterator[ImuSamples]:
    """Yield records without gaps in them; ``offset_ns`` is added to all times. The sequence counts missing samples."""
    period_ns = interval_ns(samples)
    sequence = 0
    run: list[tuple[FileSample, int]] = []
    last_ns: int | None = None
    for sample in samples:
        since_ns = period_ns if last_ns is None else sample.stamp_ns - last_ns
        last_ns = sample.stamp_ns
        gap = since_ns > GAP * period_ns
        if run and (gap or len(run) == _SAMPLES_PER_RECORD):
            yield _record(sequence, run, offset_ns)
            sequence += len(run)
            run = []
        if gap:
            sequence += max(round(since_ns / period_ns) - 1, 1)
        run.append((sample, period_ns if gap else since_ns))
    if run:
        yield _record(sequence, run, offset_ns)


def _record(sequence: int, run: list[tuple[FileSample, int]], offset_ns: int) -> ImuSamples:
    stamps = tuple(sample.stamp_ns + offset_ns for sample, _ in run)
    return ImuSamples(
        sequence=sequence,
        received_ns=stamps[-1],
        stamp_ns=stamps,
        duration_ns=tuple(duration_ns for _, duration_ns in run),
        instrument_time_ns=tuple(sample.stamp_ns for sample, _ in run),
        angular_rate_radps=tuple(sample.angular_rate_radps for sample, _ in run),
        specific_force_mps2=tuple(sample.specific_force_mps2 for sample, _ in run),
    )


def _table(path: Path) -> Iterator[FileSample]:
    header, rows = read_table(path)
    header.expect([_TIME, *([name] for name in (*_RATE, *_FORCE))], ())
    for row in rows:
        stamp_ns = (
            row.non_negative_integer("stamp_ns") if "stamp_ns" in row.cells else row.seconds_ns("time_s")
        )
        wx, wy, wz = (row.within(name, -100.0, 100.0) for name in _RATE)
        fx, fy, fz = (row.within(name, -2000.0, 2000.0) for name in _FORCE)
        yield FileSample(stamp_ns, (wx, wy, wz), (fx, fy, fz))


def _bag(path: Path, topic: str | None) -> Iterable[FileSample]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 (an extra)
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("bags of ROS 2", library="rosbags", extra="mcap") from error
    if not path.exists():
        raise InputFileError("cannot be read: No such file or directory", path=path)
    samples = []
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            found = [each for each in reader.connections if each.msgtype == _MESSAGE]
            topics = sorted({each.topic for each in found})
            if topic is None and len(topics) > 1:
                raise InputFileError(
                    f"has several topics of an IMU: {', '.join(topics)}; give --topic", path=path
                )
            chosen = [each for each in found if topic in (None, each.topic)]
            if not chosen:
                raise InputFileError(
                    f"has no topic of an IMU{'' if topic is None else f' named {topic}'}", path=path
                )
            for connection, _, data in reader.messages(connections=chosen):
                samples.append(_sample(reader.deserialize(data, connection.msgtype)))
    except (AnyReaderError, OSError, ValueError, KeyError, AttributeError, IndexError) as error:
        if isinstance(error, InputFileError):
            raise
        raise InputFileError(f"is no bag of ROS 2 that can be read: {error}", path=path) from error
    return samples


def _sample(message: object) -> FileSample:
    stamp = message.header.stamp  # type: ignore[attr-defined]
    rate, force = message.angular_velocity, message.linear_acceleration  # type: ignore[attr-defined]
    return FileSample(
        int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec),
        (float(rate.x), float(rate.y), float(rate.z)),
        (float(force.x), float(force.y), float(force.z)),
    )
