"""A suspension of the computer, during which CLOCK_MONOTONIC stands still, and the timeline of a program."""

from __future__ import annotations

import pytest

from tsgt.clock import SuspensionWatch, SystemClock, UnixTimeline, suspended_ns
from tsgt.errors import ComputerSuspendedError


def test_suspension_is_noticed() -> None:
    """After one the watch raises; before, and for what two readings of clocks differ by, it does not."""
    total_ns = [7_000_000_000]
    watch = SuspensionWatch(lambda: total_ns[0])
    watch.check()
    total_ns[0] += 1_000_000
    watch.check()
    total_ns[0] += 2_500_000_000
    with pytest.raises(ComputerSuspendedError, match=r"2\.5 s"):
        watch.check()


def test_each_suspension_begins_another_boot() -> None:
    """Two runs share a clock only if the computer was not suspended between them."""

    def boot(suspended_ns: int, boot: str = "boot") -> str:
        return SuspensionWatch(lambda: suspended_ns).boot(boot)

    assert boot(40_000) == boot(90_000) == "boot"
    assert boot(300_000_000) not in {"boot", boot(600_000_000)}
    assert boot(600_000_000, "") == ""


def test_suspensions_of_this_computer_are_counted() -> None:
    """Two readings agree within less than what counts as a suspension."""
    SuspensionWatch(suspended_ns).check()
    assert suspended_ns() >= -5_000_000


class InterruptedClock(SystemClock):
    """A clock whose n-th reading comes after an interruption of ``interruptions_ns[n]``, or of 100 ns."""

    def __init__(self, interruptions_ns: list[int]) -> None:
        self._interruptions_ns = interruptions_ns
        self._now_ns = 5_000_000_000

    def monotonic_ns(self) -> int:
        """Return the time after the next interruption."""
        self._now_ns += self._interruptions_ns.pop(0) if self._interruptions_ns else 100
        return self._now_ns

    def realtime_ns(self) -> int:
        """Return the Unix time, likewise."""
        return 1_700_000_000_000_000_000 + self.monotonic_ns()


@pytest.mark.parametrize("interrupted", range(6))
def test_interruption_does_not_shift_timeline(interrupted: int) -> None:
    """While the clocks are read, the program is interrupted for 50 ms, anywhere in two of three readings."""
    interruptions_ns = [100] * 9
    interruptions_ns[interrupted] = interruptions_ns[interrupted + 3] = 50_000_000
    timeline = UnixTimeline.fixed_now(InterruptedClock(interruptions_ns))
    assert abs(timeline.unix_at_zero_ns - 1_700_000_000_000_000_000) <= 200
