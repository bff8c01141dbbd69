"""Samples of a device as runs without gaps, which become records; shared by files of an IMU and of wheel odometry."""

from __future__ import annotations

from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING, Generic, NamedTuple, Protocol, TypeVar

from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

GAP = 1.5  # median intervals; a longer one lacks samples

MIN_SAMPLES = 2
"""Of a file: fewer have no interval."""

_SAMPLES_PER_RUN = 10


class Stamped(Protocol):
    """A sample with its time on the clock of the computer that recorded it."""

    @property
    def stamp_ns(self) -> int:
        """Time in ns."""


Sample = TypeVar("Sample", bound=Stamped)


class SampleRun(NamedTuple, Generic[Sample]):
    """Consecutive samples, and the duration of each."""

    sequence: int
    """Sequence number of the first; it counts missing samples."""
    samples: list[Sample]
    duration_ns: tuple[int, ...]


def in_order_of_time(files: Iterable[tuple[Path, Iterable[Sample]]]) -> list[Sample]:
    """Return the samples of all files in the order of time, each once where files overlap.

    Raises InputFileError if a file has fewer than two samples, or two different samples have the same time: one of them
    would stand for the interval of both.
    """
    unique: dict[int, Sample] = {}
    for path, samples in files:
        times = set()
        for sample in samples:
            times.add(sample.stamp_ns)
            if unique.setdefault(sample.stamp_ns, sample) != sample:
                raise InputFileError(
                    f"different samples have the same time, {sample.stamp_ns // 10**9}.{sample.stamp_ns % 10**9:09d} s; each needs its "
                    "own, of the device's clock, with all its digits",
                    path=path,
                )
        if len(times) < MIN_SAMPLES:
            raise InputFileError("contains fewer than two samples", path=path)
    return [unique[stamp_ns] for stamp_ns in sorted(unique)]


def interval_ns(samples: Sequence[Stamped]) -> int:
    """Return the median interval between samples."""
    return max(1, round(median(b.stamp_ns - a.stamp_ns for a, b in pairwise(samples))))


def sample_runs(samples: Sequence[Sample]) -> Iterator[SampleRun[Sample]]:
    """Yield the samples, in the order of time, in runs of ten at most without gaps in them."""
    period_ns = interval_ns(samples)
    sequence = 0
    run: list[tuple[Sample, int]] = []
    last_ns: int | None = None
    for sample in samples:
        since_ns = period_ns if last_ns is None else sample.stamp_ns - last_ns
        last_ns = sample.stamp_ns
        gap = since_ns > GAP * period_ns
        if run and (gap or len(run) == _SAMPLES_PER_RUN):
            yield _run(sequence, run)
            sequence += len(run)
            run = []
        if gap:
            sequence += max(round(since_ns / period_ns) - 1, 1)
        run.append((sample, period_ns if gap else since_ns))
    if run:
        yield _run(sequence, run)


def _run(sequence: int, run: list[tuple[Sample, int]]) -> SampleRun[Sample]:
    return SampleRun(sequence, [sample for sample, _ in run], tuple(duration_ns for _, duration_ns in run))
