"""Lines of samples become records with times on the master's Unix clock. Sans-I/O.

Until the device's clock is fitted, samples wait. A sample whose time cannot be is dropped: a wrong time distorts the
motion more than a missing sample does.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from tsgt.imu.device_clock import DeviceClock
from tsgt.imu.lines import DeviceSamples, SamplesLine, check_angular_rate, check_specific_force
from tsgt.imu.sample_times import SampleTimes
from tsgt.model import ImuSamples

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tsgt.imu.lines import DeviceHello
    from tsgt.imu.sample_times import SampleTime
    from tsgt.model import Vector3

MAX_AGE_NS = 10_000_000_000
"""A sample that is older on arrival was not delayed: its time counts from another epoch."""

MAX_AHEAD_NS = 5_000_000
"""By how much the fitted time of a sample may exceed its arrival: the fit is inexact, and follows slowly."""

MAX_PENDING_S = 10.0  # of samples that wait for the fit


LineT = TypeVar("LineT", bound=DeviceSamples)
RecordT = TypeVar("RecordT")


class _Sample(NamedTuple):
    time: SampleTime
    instrument_time_ns: int | None
    values: Any
    arrived_ns: int


class RecordTimes(NamedTuple):
    """What a record says of the times of its samples, by the names of its fields."""

    sequence: int
    received_ns: int
    stamp_ns: tuple[int, ...]
    duration_ns: tuple[int, ...]
    instrument_time_ns: tuple[int, ...] | None


class DeviceSampler(ABC, Generic[LineT, RecordT]):
    """Assigns times to the samples of a device; outlives the program, whose runs have one sequence.

    Attributes
    ----------
    clock_steps
        How often the device's clock or counter has been set or has begun again, by what its samples show.
    dropped
        Samples dropped so far because their time cannot be, or because too many were waiting. ``problem``: the reason
        of the last one.
    """

    def __init__(self, unix_at_zero_ns: int) -> None:
        self._unix_at_zero_ns = unix_at_zero_ns
        self._times = SampleTimes(1.0)
        self._clock: DeviceClock | None = None
        self._pending: deque[_Sample] = deque()
        self._max_pending = 0
        self._period_ns = 1e9
        self._last_stamp_ns: int | None = None
        self._gap = True
        self._sequence = 0
        self.clock_steps = 0
        self.dropped = 0
        self.problem = ""

    @abstractmethod
    def _values(self, line: LineT, index: int, duration_ns: int) -> Any:
        """Return what a sample measured. Raises ValueError if no device measures that."""

    @abstractmethod
    def _record_of(self, times: RecordTimes, values: Sequence[Any]) -> RecordT:
        """Return the record of samples that follow each other."""

    def program_started(self, hello: DeviceHello) -> None:
        """Begin with the samples of a new run of the program."""
        self._times = SampleTimes(hello.rate_hz)
        self._clock = None
        self._pending.clear()
        self._max_pending = round(MAX_PENDING_S * hello.rate_hz)
        self._period_ns = 1e9 / hello.rate_hz
        self._gap = True

    @property
    def clock_skew_ppm(self) -> float | None:
        """Skew of the host's clock against the device's; positive: the host's runs faster. None before the first fit."""
        clock = self._clock
        return None if clock is None or not clock.initialised else clock.skew_ppm

    def push(self, line: LineT, received_ns: int) -> list[RecordT]:
        """Take a line that arrived at this time on CLOCK_MONOTONIC; return the records that are ready.

        A record holds samples that follow each other without a gap. Raises ValueError if the line's host times cannot
        be; none of its samples is used then.
        """
        arrivals = line.host_time_ns or (received_ns,) * len(line)
        if max(arrivals) > received_ns:
            ahead_s = (max(arrivals) - received_ns) / 1e9
            raise ValueError(
                f"host_time_ns is {ahead_s:.6f} s ahead of the line's arrival, by this computer's CLOCK_MONOTONIC"
            )
        if min(arrivals) < received_ns - MAX_AGE_NS:
            age_s = (received_ns - min(arrivals)) / 1e9
            raise ValueError(
                f"host_time_ns is {age_s:.3f} s before the line's arrival, by this computer's CLOCK_MONOTONIC"
            )
        if self._clock is None:
            self._clock = DeviceClock(counter=line.instrument_time_ns is None)
        for sample in self._samples(line, arrivals):
            if sample.time.restarted:
                self._restart(self._clock)
            steps = self._clock.steps
            if not self._clock.add(sample.time.end_ns, sample.arrived_ns):
                self._drop("its time is ahead of its arrival")
                continue
            if self._clock.steps > steps:
                self.clock_steps += 1
                self._gap = True
            self._pending.append(sample)
            if len(self._pending) > self._max_pending:
                self._pending.popleft()
                self._drop("the clock of the device does not run like that of this computer")
        if not self._clock.initialised:
            return []
        pending, self._pending = self._pending, deque()
        return list(self._records(self._clock, pending, received_ns))

    def _samples(self, line: LineT, arrivals: tuple[int, ...]) -> Iterator[_Sample]:
        for i in range(len(line)):
            counter = None if line.counter is None else line.counter[i]
            instrument_time_ns = None if line.instrument_time_ns is None else line.instrument_time_ns[i]
            time = self._times.push(counter, instrument_time_ns)
            if time is None:
                self._drop("it repeats the one before")
                continue
            try:
                values = self._values(line, i, time.duration_ns)
            except ValueError as error:
                self._drop(str(error))
                continue
            yield _Sample(time, instrument_time_ns, values, arrivals[i])

    def _restart(self, clock: DeviceClock) -> None:
        """Begin a new fit, unless this is the first sample."""
        if clock.started:
            clock.reset()
            self.clock_steps += 1
            for _ in self._pending:
                self._drop("the clock of the device began again")
            self._pending.clear()
        self._gap = True

    def _drop(self, reason: str) -> None:
        self.dropped += 1
        self.problem = reason
        self._gap = True

    def _records(self, clock: DeviceClock, samples: deque[_Sample], received_ns: int) -> Iterator[RecordT]:
        run: list[tuple[int, int, _Sample]] = []
        for sample in samples:
            stamp_ns = clock.stamp(sample.time.end_ns)
            duration_ns = round(sample.time.duration_ns * clock.rate)
            if not -MAX_AGE_NS <= stamp_ns - sample.arrived_ns <= MAX_AHEAD_NS:
                self._drop("its time is ahead of its arrival, or long before it")
                continue
            last_ns = self._last_stamp_ns
            if last_ns is not None and stamp_ns - duration_ns // 2 < last_ns:
                self._drop("its time is not after that of the sample before it")
                continue
            if sample.time.lost or self._gap:
                if run:
                    yield self._record(run, received_ns)
                    run = []
                self._sequence += self._lost(sample, stamp_ns)
            self._gap = False
            self._last_stamp_ns = stamp_ns
            run.append((stamp_ns, duration_ns, sample))
        if run:
            yield self._record(run, received_ns)

    def _lost(self, sample: _Sample, stamp_ns: int) -> int:
        """Return how many samples are missing before this one: as the device counts, or after a restart by the times."""
        if self._last_stamp_ns is None:
            return sample.time.lost
        by_time = round((stamp_ns - self._last_stamp_ns) / self._period_ns) - 1
        return max(sample.time.lost, by_time, 0) if self._gap else sample.time.lost

    def _record(self, run: list[tuple[int, int, _Sample]], received_ns: int) -> RecordT:
        sequence = self._sequence
        self._sequence += len(run)
        times_ns = [
            sample.instrument_time_ns for _, _, sample in run if sample.instrument_time_ns is not None
        ]
        times = RecordTimes(
            sequence=sequence,
            received_ns=self._unix_at_zero_ns + received_ns,
            stamp_ns=tuple(self._unix_at_zero_ns + stamp_ns for stamp_ns, _, _ in run),
            duration_ns=tuple(duration_ns for _, duration_ns, _ in run),
            instrument_time_ns=tuple(times_ns) if len(times_ns) == len(run) else None,
        )
        return self._record_of(times, [sample.values for _, _, sample in run])


class Sampler(DeviceSampler[SamplesLine, ImuSamples]):
    """The sampler of an IMU; values are angular rate and specific force."""

    def _values(self, line: SamplesLine, index: int, duration_ns: int) -> tuple[Vector3, Vector3]:
        # The line has checked values, but not increments, whose durations it does not know.
        if line.angular_rate_radps is not None:
            rate = line.angular_rate_radps[index]
        else:
            rate = _mean(line.delta_angle_rad, index, duration_ns)
            check_angular_rate([rate])
        if line.specific_force_mps2 is not None:
            force = line.specific_force_mps2[index]
        else:
            force = _mean(line.delta_velocity_mps, index, duration_ns)
            check_specific_force([force])
        return rate, force

    def _record_of(self, times: RecordTimes, values: Sequence[tuple[Vector3, Vector3]]) -> ImuSamples:
        return ImuSamples(
            **times._asdict(),
            angular_rate_radps=tuple(rate for rate, _ in values),
            specific_force_mps2=tuple(force for _, force in values),
        )


def _mean(increments: tuple[Vector3, ...] | None, index: int, duration_ns: int) -> Vector3:
    """Return an increment over its duration."""
    assert increments is not None  # noqa: S101 (a line has one of both)
    x, y, z = increments[index]
    duration_s = duration_ns / 1e9
    return (x / duration_s, y / duration_s, z / duration_s)
