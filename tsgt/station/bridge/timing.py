"""Timestamps of a bridge program's measurements, and detection of repeated lines. Sans-I/O.

A wrong time bends a trajectory more than a missing measurement does: a line with an implausible time is rejected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.timesync import MAX_DELAY_NS, InstrumentClock

if TYPE_CHECKING:
    from tsgt.station.bridge.messages import HelloLine, MeasurementLine

MAX_AGE_NS = 10_000_000_000
"""A measurement older than this on arrival was not delayed: its time counts from another epoch."""

STATUS_INTERVAL_NS = 500_000_000  # an unchanged status without a target is reported at this interval

_MS_NS = 1_000_000

_ROUNDING_NS = 1_000
"""Bound on the error of a time in whole ms that was converted to floating-point seconds and back."""

_NO_STATUS = ("", 0)

_MAX_PENDING = 64


class TimestampedLine(NamedTuple):
    """A new measurement with its time and arrival, both on the host's CLOCK_MONOTONIC.

    ``sigma_ns``: standard error of the time from the fit of the instrument's clock; 0 where there is none.
    """

    line: MeasurementLine
    prism: int
    at_ns: int
    received_ns: int
    sigma_ns: int = 0


class LineTimestamper:
    """Determines times of measurements, ``latency_ns`` before the program's timestamps; outlives the program."""

    def __init__(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        self._source = ""
        self._clock_identity = ("", "", "", "")
        self._clock = InstrumentClock()
        self._pending: list[tuple[MeasurementLine, int, int]] = []
        self._last: tuple[int, float | None, float | None, float | None] | None = None
        self._last_at_ns: int | None = None
        self._last_status = _NO_STATUS

    def program_started(self, hello: HelloLine) -> None:
        """Start with a program's hello; keep the clock fit of the same instrument."""
        self._source = hello.stamps
        self._pending = []
        identity = (hello.make, hello.model, hello.serial_number, hello.clock)
        if identity != self._clock_identity:
            self._clock_identity, self._clock, self._last = identity, InstrumentClock(), None

    def host_clock_restarted(self, now_ns: int) -> None:
        """Drop the clock fit, and reject times before now: they are of the clock before the suspension."""
        self._clock, self._pending = InstrumentClock(), []
        self._last_at_ns = now_ns

    def drop_other_prisms(self, prism: int) -> None:
        """Drop measurements of other prisms that wait for the clock fit."""
        self._pending = [pending for pending in self._pending if pending[1] == prism]

    def push(
        self, line: MeasurementLine, prism: int, received_ns: int, *, together: bool
    ) -> list[TimestampedLine | str]:
        """Add a line; return the measurements ready now, which may include earlier ones, or why one is rejected.

        ``received_ns``: arrival of the line. ``together``: whether another measurement arrived in the same piece, so
        that neither arrival is exact.
        """
        if not line.status.usable:
            return self._without_target(line, prism, received_ns)
        if self._is_repeat(line):
            return []
        if self._source == "instrument":
            return self._by_instrument(line, prism, received_ns)
        if self._source == "host":
            if line.host_time_ns is None:
                return ["it has no host_time_ns, which hello has promised"]
            return [self._checked(line, prism, line.host_time_ns, received_ns, MAX_AGE_NS)]
        if together:
            return [
                "it arrived together with others, so that its time is unknown; flush the output after each line"
            ]
        return [self._checked(line, prism, received_ns, received_ns, MAX_AGE_NS)]

    def _is_repeat(self, line: MeasurementLine) -> bool:
        """Whether it repeats time and values of the one before; with other values it is new, and its time too coarse."""
        time_ns = line.host_time_ns if line.instrument_time_ns is None else line.instrument_time_ns
        if time_ns is None:
            return False
        before = self._last
        self._last = (time_ns, line.horizontal_angle_rad, line.zenith_angle_rad, line.slope_distance_m)
        return before == self._last

    def _without_target(
        self, line: MeasurementLine, prism: int, received_ns: int
    ) -> list[TimestampedLine | str]:
        """Report a changed status at once, and an unchanged one now and then; no pose depends on its time."""
        status, last_ns = self._last_status
        due = line.status != status or received_ns - last_ns >= STATUS_INTERVAL_NS
        at_ns = received_ns - self._latency_ns
        if not due or at_ns < 0:
            return []
        self._last_status = (line.status, received_ns)
        return [TimestampedLine(line, prism, at_ns, received_ns)]

    def _by_instrument(
        self, line: MeasurementLine, prism: int, received_ns: int
    ) -> list[TimestampedLine | str]:
        """Map the instrument's time to the host's clock, once enough lines have initialised the clock fit."""
        if line.instrument_time_ns is None:
            return ["it has no instrument_time_ns, which hello has promised"]
        time_ms, fraction_ns = divmod(line.instrument_time_ns, _MS_NS)
        # One is conclusive: a clock finer than ms rarely shows whole ones. Pending lines have no time yet.
        if _ROUNDING_NS <= fraction_ns < _MS_NS - _ROUNDING_NS:
            self._clock.use_fractional_milliseconds()
        self._clock.add(time_ms, received_ns - fraction_ns)
        self._pending.append((line, prism, received_ns))
        if not self._clock.initialised:
            if len(self._pending) <= _MAX_PENDING:
                return []
            del self._pending[0]
            return ["its instrument_time_ns does not fit those of the others"]
        pending, self._pending = self._pending, []
        return [self._mapped(*each) for each in pending]

    def _mapped(self, line: MeasurementLine, prism: int, received_ns: int) -> TimestampedLine | str:
        assert line.instrument_time_ns is not None  # noqa: S101 (only such lines are pending)
        time_ms, fraction_ns = divmod(line.instrument_time_ns, _MS_NS)
        mapped = self._clock.at(time_ms)
        assert mapped is not None  # noqa: S101 (the clock is initialised)
        # Half a ms is added to truncated whole ms: near the envelope that lies after the arrival.
        host_ns = mapped.host_ns + fraction_ns
        at_ns = received_ns if 0 < host_ns - received_ns < _MS_NS else host_ns
        return self._checked(line, prism, at_ns, received_ns, MAX_DELAY_NS, mapped.sigma_ns)

    def _checked(
        self,
        line: MeasurementLine,
        prism: int,
        time_ns: int,
        received_ns: int,
        max_age_ns: int,
        sigma_ns: int = 0,
    ) -> TimestampedLine | str:
        ahead_s = (time_ns - received_ns) / 1e9
        if time_ns > received_ns:
            return f"its time is {ahead_s:.6f} s ahead of its arrival, by this computer's CLOCK_MONOTONIC"
        if time_ns < received_ns - max_age_ns:
            return f"its time is {-ahead_s:.3f} s before its arrival, by this computer's CLOCK_MONOTONIC"
        at_ns = time_ns - self._latency_ns
        if at_ns < 0 or (self._last_at_ns is not None and at_ns <= self._last_at_ns):
            return "its time is not after that of the measurement before it"
        self._last_at_ns = at_ns
        self._last_status = _NO_STATUS
        return TimestampedLine(line, prism, at_ns, received_ns, sigma_ns)
