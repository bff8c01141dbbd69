"""Wheel odometry recorded by other programs, for the trajectory with an IMU: CSV with named columns."""

from __future__ import annotations

from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.analysis.formats.csv_table import read_table
from tsgt.errors import InputFileError
from tsgt.model import OdometrySamples

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

GAP = 1.5  # median intervals; a longer one lacks samples

_SAMPLES_PER_RECORD = 10
_MIN_SAMPLES = 2
_MAX_SPEED_MPS, _MAX_YAW_RATE_RADPS = 50.0, 20.0  # as of the lines of a program


class WheelSample(NamedTuple):
    """One sample: the end of its interval on the clock of the computer that recorded it."""

    stamp_ns: int
    speed_mps: float
    yaw_rate_radps: float | None


def read_wheel_files(paths: Sequence[Path]) -> list[WheelSample]:
    """Read CSV files, in the order of time; of samples of the same time the last is kept.

    Raises InputFileError if a file cannot be used, or they have fewer than two samples.
    """
    unique = {sample.stamp_ns: sample for path in paths for sample in _table(path)}
    if len(unique) < _MIN_SAMPLES:
        raise InputFileError("contains fewer than two samples of odometry", path=paths[0])
    return [unique[stamp_ns] for stamp_ns in sorted(unique)]


def wheel_records(samples: Sequence[WheelSample], offset_ns: int) -> Iterator[OdometrySamples]:
    """Yield records without gaps in them; ``offset_ns`` is added to all times. The sequence counts missing samples."""
    period_ns = max(1, round(median(b.stamp_ns - a.stamp_ns for a, b in pairwise(samples))))
    sequence = 0
    run: list[tuple[WheelSample, int]] = []
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


def _record(sequence: int, run: list[tuple[WheelSample, int]], offset_ns: int) -> OdometrySamples:
    stamps = tuple(sample.stamp_ns + offset_ns for sample, _ in run)
    rates = tuple(sample.yaw_rate_radps for sample, _ in run if sample.yaw_rate_radps is not None)
    return OdometrySamples(
        sequence=sequence,
        received_ns=stamps[-1],
        stamp_ns=stamps,
        duration_ns=tuple(duration_ns for _, duration_ns in run),
        instrument_time_ns=tuple(sample.stamp_ns for sample, _ in run),
        speed_mps=tuple(sample.speed_mps for sample, _ in run),
        yaw_rate_radps=rates if len(rates) == len(run) else None,
        valid=(True,) * len(run),
    )


def _table(path: Path) -> Iterator[WheelSample]:
    header, rows = read_table(path)
    header.expect([("stamp_ns", "time_s"), ("speed_mps",)], ("yaw_rate_radps",))
    for row in rows:
        stamp_ns = (
            row.non_negative_integer("stamp_ns") if "stamp_ns" in row.cells else row.seconds_ns("time_s")
        )
        rate = None
        if "yaw_rate_radps" in row.cells:
            rate = row.within("yaw_rate_radps", -_MAX_YAW_RATE_RADPS, _MAX_YAW_RATE_RADPS)
        yield WheelSample(stamp_ns, row.within("speed_mps", -_MAX_SPEED_MPS, _MAX_SPEED_MPS), rate)
