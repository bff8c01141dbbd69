"""How old a line is, by clocks that nobody has synchronised.

Lines carry times of another clock: the master's Unix clock, or the relay's monotonic clock. A line cannot arrive before it
was made, so the smallest difference between arrival and origin is the best estimate of the offset between the clocks, and
whatever a later line takes beyond that is delay.
"""

from __future__ import annotations

MAX_SKEW = 200e-6
"""Relative skew of two quartz clocks that are disciplined by NTP at most: the offset may grow at this rate without delay."""


class LeastDelay:
    """Estimates the offset from another clock to ours as the smallest one seen."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._at_ns = 0

    @property
    def known(self) -> bool:
        """Whether there was a sample."""
        return self._offset_ns is not None

    def sample(self, origin_ns: int, arrived_ns: int) -> None:
        """Use a line that was made at ``origin_ns`` on its clock, and arrived at ``arrived_ns`` on ours."""
        offset_ns = arrived_ns - origin_ns
        if self._offset_ns is not None:
            slack_ns = round(MAX_SKEW * max(0, arrived_ns - self._at_ns))
            offset_ns = min(offset_ns, self._offset_ns + slack_ns)
        self._offset_ns, self._at_ns = offset_ns, arrived_ns

    def here_ns(self, origin_ns: int) -> int:
        """Return a time of the other clock on ours; never later than the truth by more than the least delay."""
        if self._offset_ns is None:
            raise ValueError("no sample yet")
        return origin_ns + self._offset_ns
