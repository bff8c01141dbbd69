"""A suspension of the computer, during which CLOCK_MONOTONIC stands still."""

from __future__ import annotations

import pytest

from tsgt.clock import SuspensionWatch, suspended_ns
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
