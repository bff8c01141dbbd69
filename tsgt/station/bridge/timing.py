"""When a bridge program's measurements were made, and which of its lines say the same once more.

A wrong time bends a pose more than a missing measurement does, so a line whose time cannot be right is refused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.timesync import LATEST_NS, InstrumentClock

if TYPE_CHECKING:
    from tsgt.station.bridge.messages import Hello, MeasurementLine

OLDEST_NS = 10_000_000_000
"""A measurement that is older when it arrives was not held up on its way: its time counts from somewhere else."""

UNUSABLE_EVERY_NS = 500_000_000
"""That there still is no target is worth a reading so often."""

_MS_NS = 1_000_000

_SLACK_NS = 1_000
"""A time in whole ms that a program has had as seconds in a floating-point number is off by less than this."""

_NONE_UNUSABLE = ("", 0)

_HELD_MAX = 64


class Stamped(NamedTuple):
    """A measurement that is new and has a time.

    Attributes
    ----------
    line
        What the program said.
    prism
        What it is of.
    at_ns
        When it was made, on the host's CLOCK_MONOTONIC, in ns.
    arrived_ns
        When the line came, on the same clock.
    """

    line: MeasurementLine
    prism: int
    at_ns: int
    arrived_ns: int


class Stamper:
    """Finds the time of each measurement; it outlives the program, so that nothing counts twice after a restart.

    Parameters
    ----------
    latency_ns
        From a measurement to the time that the program gives, taken off.
    """

    def __init__(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        self._stamps = ""
        self._whose = ("", "", "", "")
        self._clock = InstrumentClock()
        self._held: list[tuple[MeasurementLine, int, int]] = []
        self._last: tuple[int, float | None, float | None, float | None] | None = None
        self._last_at_ns: int | None = None
        self._unusable = _NONE_UNUSABLE

    def begin(self, hello: Hello) -> None:
        """Take it that a program was started. The clock of the same instrument need not be learnt again."""
        self._stamps = hello.stamps
        self._held = []
        whose = (hello.make, hello.model, hello.serial_number, hello.clock)
        if whose != self._whose:
            self._whose, self._clock, self._last = whose, InstrumentClock(), None

    def forget_others(self, prism: int) -> None:
        """Forget what waits for the instrument's clock to be known and is of another prism."""
        self._held = [held for held in self._held if held[1] == prism]

    def push(
        self, line: MeasurementLine, prism: int, arrived_ns: int, *, together: bool
    ) -> list[Stamped | str]:
        """Take a line; return what can be used now, which may be earlier lines too, or why one is refused.

        Parameters
        ----------
        line, prism
            What the program said, and what it is of.
        arrived_ns
            When the line came.
        together
            Whether another measurement came in the same piece: then nobody knows when either was printed.
        """
        if not line.status.usable:
            return self._without_target(line, prism, arrived_ns)
        if self._is_repeat(line):
            return []
        if self._stamps == "instrument":
            return self._by_instrument(line, prism, arrived_ns)
        if self._stamps == "host":
            if line.host_time_ns is None:
                return ["it has no host_time_ns, which hello has promised"]
            return [self._checked(line, prism, line.host_time_ns, arrived_ns, OLDEST_NS)]
        if together:
            return [
                "it came together with others, so nobody knows when; print each at once (flush the output)"
            ]
        return [self._checked(line, prism, arrived_ns, arrived_ns, OLDEST_NS)]

    def _is_repeat(self, line: MeasurementLine) -> bool:
        """Whether this measurement was here just before: the same time, the instrument's best, and the same values.

        One with the same time and other values is new, and its time is too coarse.
        """
        time_ns = line.host_time_ns if line.instrument_time_ns is None else line.instrument_time_ns
        if time_ns is None:
            return False
        before = self._last
        self._last = (time_ns, line.horizontal_angle_rad, line.zenith_angle_rad, line.slope_distance_m)
        return before == self._last

    def _without_target(self, line: MeasurementLine, prism: int, arrived_ns: int) -> list[Stamped | str]:
        """Pass on what says that there is nothing to measure, when that is news; no pose depends on its time."""
        status, last_ns = self._unusable
        news = line.status != status or arrived_ns - last_ns >= UNUSABLE_EVERY_NS
        at_ns = arrived_ns - self._latency_ns
        if not news or at_ns < 0:
            return []
        self._unusable = (line.status, arrived_ns)
        return [Stamped(line, prism, at_ns, arrived_ns)]

    def _by_instrument(self, line: MeasurementLine, prism: int, arrived_ns: int) -> list[Stamped | str]:
        """Put the instrument's time on the host's clock, as soon as enough lines have told how the two lie."""
        if line.instrument_time_ns is None:
            return ["it has no instrument_time_ns, which hello has promised"]
        time_ms, rest_ns = divmod(line.instrument_time_ns, _MS_NS)
        # One is enough: an instrument that counts finer than in ms has few whole ones. Of what is held nothing is told yet.
        if _SLACK_NS <= rest_ns < _MS_NS - _SLACK_NS:
            self._clock.expect_parts()
        self._clock.add(time_ms, arrived_ns - rest_ns)
        self._held.append((line, prism, arrived_ns))
        if not self._clock.stands:
            if len(self._held) <= _HELD_MAX:
                return []
            del self._held[0]
            return ["its instrument_time_ns does not fit those of the others"]
        held, self._held = self._held, []
        return [self._mapped(*each) for each in held]

    def _mapped(self, line: MeasurementLine, prism: int, arrived_ns: int) -> Stamped | str:
        assert line.instrument_time_ns is not None  # noqa: S101 (only such lines are held)
        time_ms, rest_ns = divmod(line.instrument_time_ns, _MS_NS)
        mapped = self._clock.at(time_ms)
        assert mapped is not None  # noqa: S101 (the clock stands)
        # To whole ms half of one is added: nearest to the envelope that is after the arrival.
        host_ns = mapped.host_ns + rest_ns
        at_ns = arrived_ns if 0 < host_ns - arrived_ns < _MS_NS else host_ns
        return self._checked(line, prism, at_ns, arrived_ns, LATEST_NS)

    def _checked(
        self, line: MeasurementLine, prism: int, time_ns: int, arrived_ns: int, oldest_ns: int
    ) -> Stamped | str:
        ahead_s = (time_ns - arrived_ns) / 1e9
        if time_ns > arrived_ns:
            return f"its time is {ahead_s:.6f} s ahead of its arrival, by this computer's CLOCK_MONOTONIC"
        if time_ns < arrived_ns - oldest_ns:
            return f"its time is {-ahead_s:.3f} s before its arrival, by this computer's CLOCK_MONOTONIC"
        at_ns = time_ns - self._latency_ns
        if at_ns < 0 or (self._last_at_ns is not None and at_ns <= self._last_at_ns):
            return "its time is not after that of the measurement before it"
        self._last_at_ns = at_ns
        self._unusable = _NONE_UNUSABLE
        return Stamped(line, prism, at_ns, arrived_ns)
