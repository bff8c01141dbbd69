"""Wheel odometry recorded by other programs, for the trajectory with an IMU: CSV with named columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.analysis.formats.csv_table import TIME, read_table
from tsgt.analysis.formats.sample_runs import SampleRun, in_order_of_time, sample_runs
from tsgt.model import OdometrySamples

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

_MAX_SPEED_MPS, _MAX_YAW_RATE_RADPS = 50.0, 20.0  # as of the lines of a program


class WheelSample(NamedTuple):
    """One sample: the end of its interval on the clock of the computer that recorded it."""

    stamp_ns: int
    speed_mps: float
    yaw_rate_radps: float | None


def read_wheel_files(paths: Sequence[Path]) -> list[WheelSample]:
    """Read CSV files, in the order of time; raises InputFileError if one cannot be used."""
    return in_order_of_time((path, _table(path)) for path in paths)


def wheel_records(samples: Sequence[WheelSample], offset_ns: int) -> Iterator[OdometrySamples]:
    """Yield records without gaps in them; ``offset_ns`` is added to all times. The sequence counts missing samples."""
    return (_record(run, offset_ns) for run in sample_runs(samples))


def _record(run: SampleRun[WheelSample], offset_ns: int) -> OdometrySamples:
    stamps = tuple(sample.stamp_ns + offset_ns for sample in run.samples)
    rates = tuple(sample.yaw_rate_radps for sample in run.samples if sample.yaw_rate_radps is not None)
    return OdometrySamples(
        sequence=run.sequence,
        received_ns=stamps[-1],
        stamp_ns=stamps,
        duration_ns=run.duration_ns,
        instrument_time_ns=tuple(sample.stamp_ns for sample in run.samples),
        speed_mps=tuple(sample.speed_mps for sample in run.samples),
        yaw_rate_radps=rates if len(rates) == len(run.samples) else None,
        valid=(True,) * len(run.samples),
    )


def _table(path: Path) -> Iterator[WheelSample]:
    header, rows = read_table(path)
    header.expect([TIME, ("speed_mps",)], ("yaw_rate_radps",))
    for row in rows:
        rate = None
        if "yaw_rate_radps" in row.cells:
            rate = row.within("yaw_rate_radps", -_MAX_YAW_RATE_RADPS, _MAX_YAW_RATE_RADPS)
        yield WheelSample(row.stamp_ns(), row.within("speed_mps", -_MAX_SPEED_MPS, _MAX_SPEED_MPS), rate)
