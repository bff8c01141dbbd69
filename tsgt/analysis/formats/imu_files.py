"""Samples of an IMU recorded by other programs: CSV with named columns, and ROS 2 bags with ``sensor_msgs/Imu``."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.analysis.formats.bag import is_bag, open_bag
from tsgt.analysis.formats.csv_table import TIME, read_table
from tsgt.analysis.formats.sample_runs import SampleRun, in_order_of_time, sample_runs
from tsgt.errors import InputFileError
from tsgt.model import ImuSamples

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from tsgt.model import Vector3

_RATE = tuple(f"angular_rate_{axis}_radps" for axis in "xyz")
_FORCE = tuple(f"specific_force_{axis}_mps2" for axis in "xyz")
_LIMITS = (*((name, 100.0) for name in _RATE), *((name, 2000.0) for name in _FORCE))
_MESSAGE = "sensor_msgs/msg/Imu"


class FileSample(NamedTuple):
    """One sample: its time on the clock of the computer that recorded it."""

    stamp_ns: int
    angular_rate_radps: Vector3
    specific_force_mps2: Vector3


def read_imu_files(paths: Sequence[Path], topic: str | None = None) -> list[FileSample]:
    """Read CSV files and bags, in the order of time.

    ``topic``: of a bag; default: the only one with IMU messages. Raises InputFileError if a file cannot be used, and
    MissingExtraError for a bag without the library rosbags.
    """
    return in_order_of_time((path, _bag(path, topic) if is_bag(path) else _table(path)) for path in paths)


def imu_records(
    samples: Sequence[FileSample], to_master_ns: Callable[[int], int] = lambda stamp_ns: stamp_ns
) -> Iterator[ImuSamples]:
    """Yield records without gaps in them. The sequence counts missing samples.

    ``to_master_ns``: takes a sample's time to the master's clock.
    """
    return (_record(run, to_master_ns) for run in sample_runs(samples))


def _record(run: SampleRun[FileSample], to_master_ns: Callable[[int], int]) -> ImuSamples:
    stamps = tuple(to_master_ns(sample.stamp_ns) for sample in run.samples)
    return ImuSamples(
        sequence=run.sequence,
        received_ns=stamps[-1],
        stamp_ns=stamps,
        duration_ns=run.duration_ns,
        instrument_time_ns=tuple(sample.stamp_ns for sample in run.samples),
        angular_rate_radps=tuple(sample.angular_rate_radps for sample in run.samples),
        specific_force_mps2=tuple(sample.specific_force_mps2 for sample in run.samples),
    )


def _table(path: Path) -> Iterator[FileSample]:
    header, rows = read_table(path)
    header.expect([TIME, *([name] for name in (*_RATE, *_FORCE))], ())
    for row in rows:
        wx, wy, wz = (row.within(name, -limit, limit) for name, limit in _LIMITS[:3])
        fx, fy, fz = (row.within(name, -limit, limit) for name, limit in _LIMITS[3:])
        yield FileSample(row.stamp_ns(), (wx, wy, wz), (fx, fy, fz))


def _bag(path: Path, topic: str | None) -> Iterable[FileSample]:
    with open_bag(path) as reader:
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
        return [
            _sample(reader.deserialize(data, connection.msgtype), path)
            for connection, _, data in reader.messages(connections=chosen)
        ]


def _sample(message: object, path: Path) -> FileSample:
    stamp = message.header.stamp  # type: ignore[attr-defined]
    rate, force = message.angular_velocity, message.linear_acceleration  # type: ignore[attr-defined]
    # A message says in this way that it does not contain them (sensor_msgs/Imu).
    for covariance in (message.angular_velocity_covariance, message.linear_acceleration_covariance):  # type: ignore[attr-defined]
        if covariance[0] == -1:
            raise InputFileError(
                "has messages without angular velocity or linear acceleration (their covariance begins with -1)",
                path=path,
            )
    stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    if stamp_ns < 0:
        raise InputFileError(f"has a message with a time before 1970, {stamp_ns} ns", path=path)
    sample = FileSample(
        stamp_ns,
        (float(rate.x), float(rate.y), float(rate.z)),
        (float(force.x), float(force.y), float(force.z)),
    )
    values = (*sample.angular_rate_radps, *sample.specific_force_mps2)
    for (name, limit), value in zip(_LIMITS, values, strict=True):
        if not abs(value) <= limit:  # true for NaN
            raise InputFileError(
                f"{name} of the sample at {sample.stamp_ns} ns is {value:g}; expected -{limit:g} to {limit:g}",
                path=path,
            )
    return sample
