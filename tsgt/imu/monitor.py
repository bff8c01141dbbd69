"""What the samples themselves show about the IMU, or the wheels: rate, gaps; saturation, stuck and implausible values. Sans-I/O."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from tsgt.recording import ImuStatus

if TYPE_CHECKING:
    from tsgt.imu.lines import HelloLine
    from tsgt.model import ImuSamples, OdometrySamples, Vector3

RATE_WINDOW_NS = 10_000_000_000

LOSS_TIMEOUT_NS = 1_000_000_000
"""An IMU without a sample for this long is lost; a computer under load delays lines by some 100 ms."""

STUCK_NS = 250_000_000
"""A device that repeats all six values for this long has stopped measuring: its noise changes them."""

SATURATED_SHARE = 0.999  # of the full scale

PROBLEM_HOLD_NS = 2_000_000_000  # a problem has passed after this long without it

MIN_GRAVITY_MPS2, MAX_GRAVITY_MPS2 = 8.0, 12.0
"""Bounds of the mean magnitude of the specific force over 10 s, which a driving robot changes by less than 1 m/s^2."""

RATE_TOLERANCE = 0.1  # of the rate in hello

_MIN_WINDOW_NS = 5_000_000_000  # of samples, before rate and gravity are judged


class SampleCounter:
    """Counts samples and gaps of a device, and finds its rate; instants are on the master's Unix clock in ns."""

    def __init__(self) -> None:
        self._window: deque[tuple[int, int, int]] = (
            deque()
        )  # Arrival, begin and number of samples of each record
        self.samples = self.gaps = self.lost = 0
        self._next_sequence: int | None = None
        self._stamp_ns: int | None = None

    def program_started(self) -> None:
        """Find the rate anew."""
        self._window.clear()

    def count(self, record: ImuSamples | OdometrySamples) -> None:
        """Count the samples of a record."""
        count = len(record.stamp_ns)
        if self._next_sequence is not None and record.sequence > self._next_sequence:
            self.gaps += 1
            self.lost += record.sequence - self._next_sequence
        self._next_sequence = record.sequence + count
        self.samples += count
        self._stamp_ns = record.stamp_ns[-1]
        self._window.append((record.received_ns, record.stamp_ns[0] - record.duration_ns[0], count))
        self._forget(record.received_ns)

    def is_lost(self, now_ns: int) -> bool:
        """Whether there has been no sample for too long, or none yet."""
        return self._stamp_ns is None or now_ns - self._stamp_ns > LOSS_TIMEOUT_NS

    def age_s(self, now_ns: int) -> float | None:
        """Return the age of the newest sample; None before the first one."""
        return None if self._stamp_ns is None else (now_ns - self._stamp_ns) / 1e9

    def rate_hz(self, now_ns: int) -> float | None:
        """Return the samples per second of the window; None without any."""
        self._forget(now_ns)
        if not self._window:
            return None
        span_ns = max(now_ns - self._window[0][1], 1_000_000_000)
        return sum(count for _, _, count in self._window) / (span_ns / 1e9)

    def _forget(self, now_ns: int) -> None:
        while self._window and self._window[0][0] <= now_ns - RATE_WINDOW_NS:
            self._window.popleft()


class _Piece(NamedTuple):
    """A record's share of the window, without its forces."""

    received_ns: int
    samples: int
    duration_ns: int


class ImuMonitor:
    """Counts samples and finds problems; instants are on the master's Unix clock in ns.

    ``problem``: what is wrong with the values now, for people; empty when nothing is.
    """

    def __init__(self) -> None:
        self._hello: HelloLine | None = None
        self._window: deque[_Piece] = deque()
        self._force_sums_mps2: deque[float] = deque()  # of the same records
        self._window_samples = self._window_ns = 0
        self._counter = SampleCounter()
        self._saturated = 0
        self._values: tuple[Vector3, Vector3] | None = None
        self._same_ns = 0
        self._problem = ""
        self._problem_ns = 0

    def program_started(self, hello: HelloLine) -> None:
        """Take the identity, rate and full scale of the device."""
        self._hello = hello
        self._counter.program_started()
        self._window.clear()
        self._force_sums_mps2.clear()
        self._window_samples = self._window_ns = 0

    def samples(self, record: ImuSamples) -> None:
        """Take a record."""
        self._counter.count(record)
        piece = _Piece(record.received_ns, len(record.stamp_ns), sum(record.duration_ns))
        self._window.append(piece)
        self._force_sums_mps2.append(sum(math.hypot(*force) for force in record.specific_force_mps2))
        self._window_samples += piece.samples
        self._window_ns += piece.duration_ns
        while self._window[0].received_ns <= record.received_ns - RATE_WINDOW_NS:
            oldest = self._window.popleft()
            self._force_sums_mps2.popleft()
            self._window_samples -= oldest.samples
            self._window_ns -= oldest.duration_ns
        self._find_problem(record)

    def lost(self, now_ns: int) -> bool:
        """Whether there has been no sample for too long, or none yet."""
        return self._counter.is_lost(now_ns)

    def problem(self, now_ns: int) -> str:
        """Return what is wrong with the values at present, for people; empty if nothing is."""
        return self._problem if now_ns - self._problem_ns <= PROBLEM_HOLD_NS else ""

    def status(self, now_ns: int, problem: str, clock_skew_ppm: float | None) -> ImuStatus:
        """Return the status; ``problem`` of the program precedes that of the values."""
        counter, hello = self._counter, self._hello
        name = "" if hello is None else " ".join(filter(None, (hello.make, hello.model, hello.serial_number)))
        return ImuStatus(
            device=name,
            samples=counter.samples,
            rate_hz=counter.rate_hz(now_ns),
            age_s=counter.age_s(now_ns),
            gaps=counter.gaps,
            lost=counter.lost,
            saturated=self._saturated,
            clock_skew_ppm=clock_skew_ppm,
            problem=problem or self.problem(now_ns),
        )

    def _find_problem(self, record: ImuSamples) -> None:
        problem = self._saturation(record) or self._stuck(record) or self._implausible()
        if problem:
            self._problem, self._problem_ns = problem, record.received_ns

    def _saturation(self, record: ImuSamples) -> str:
        hello = self._hello
        if hello is None:
            return ""
        rates = _at_limit(record.angular_rate_radps, hello.angular_rate_limit_radps)
        forces = _at_limit(record.specific_force_mps2, hello.specific_force_limit_mps2)
        self._saturated += sum(map(max, rates, forces))
        if any(rates):
            return "the angular rate is at the limit of the device"
        return "the specific force is at the limit of the device" if any(forces) else ""

    def _stuck(self, record: ImuSamples) -> str:
        for values in zip(
            record.angular_rate_radps, record.specific_force_mps2, record.duration_ns, strict=True
        ):
            self._same_ns = self._same_ns + values[2] if values[:2] == self._values else 0
            self._values = values[:2]
        return "it repeats the same values" if self._same_ns >= STUCK_NS else ""

    def _implausible(self) -> str:
        samples, duration_ns = self._window_samples, self._window_ns
        if duration_ns < _MIN_WINDOW_NS or self._hello is None:
            return ""
        force = sum(self._force_sums_mps2) / samples
        if not MIN_GRAVITY_MPS2 <= force <= MAX_GRAVITY_MPS2:
            return (
                f"the mean specific force is {force:.2f} m/s^2, expected about 9.8: "
                "another unit, or gravity was removed"
            )
        rate_hz = samples / (duration_ns / 1e9)
        if abs(rate_hz / self._hello.rate_hz - 1) > RATE_TOLERANCE:
            return f"it measures {rate_hz:.1f} times a second, and hello promised {self._hello.rate_hz:g}"
        return ""


def _at_limit(values: tuple[Vector3, ...], limit: float | None) -> list[bool]:
    if limit is None:
        return [False] * len(values)
    return [max(map(abs, value)) >= SATURATED_SHARE * limit for value in values]
