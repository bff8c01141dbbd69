"""The disk monitor: low, full, failing and recovered."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from tsgt.errors import RecordingError
from tsgt.master.monitors.disk import HUNG_DISK_TIMEOUT_NS, RECOVERY_FACTOR, DiskMonitor
from tsgt.recording import LOW_DISK_BYTES, DiskStatus, RecordingStatus

SECOND = 1_000_000_000
HOUR = 3600 * SECOND


def recording(*, size: int = 1000, written_ns: int | None = 0, waiting: int = 0) -> RecordingStatus:
    """Return the status of a recording."""
    return RecordingStatus(
        file="run.jsonl", bytes=size, last_write_ns=written_ns, waiting_lines=waiting, lost_lines=0
    )


def free(size: float) -> DiskStatus:
    """Return a disk with this many bytes free."""
    return DiskStatus(free_bytes=int(size), total_bytes=32 * LOW_DISK_BYTES)


def failed_write(error: int) -> RecordingError:
    """Return the error of a write that the kernel has refused."""
    raised = RecordingError(f"a line was not written ({os.strerror(error)})", path=Path("run.jsonl"))
    raised.__cause__ = OSError(error, os.strerror(error))
    return raised


def test_space_is_low_until_there_is_clearly_more() -> None:
    """One event each, with the time that is left at the present rate."""
    monitor = DiskMonitor(0)
    assert monitor.update(HOUR, recording(), None, free(LOW_DISK_BYTES)) == []
    size = LOW_DISK_BYTES // 10  # in one hour
    (low,) = monitor.update(HOUR, recording(size=size), None, free(0.9 * LOW_DISK_BYTES))
    assert low.event == "disk_low"
    assert "0.9 GB are free" in low.message
    assert "about 9 h" in low.message
    assert monitor.update(HOUR, recording(), None, free(0.8 * LOW_DISK_BYTES)) == []
    assert monitor.update(HOUR, recording(), None, free(1.1 * LOW_DISK_BYTES)) == []
    (normal,) = monitor.update(HOUR, recording(), None, free(RECOVERY_FACTOR * LOW_DISK_BYTES))
    assert normal.event == "disk_recovered"


@pytest.mark.parametrize(
    ("error", "event"),
    [
        (errno.ENOSPC, "disk_full"),
        (errno.EDQUOT, "disk_full"),
        (errno.EROFS, "disk_failed"),
        (errno.EIO, "disk_failed"),
    ],
)
def test_refused_lines_are_an_event(error: int, event: str) -> None:
    """It states how many lines wait, and the reason unless the disk is full; the recovery follows once."""
    monitor = DiskMonitor(0)
    (failure,) = monitor.update(SECOND, recording(waiting=12), failed_write(error), free(2 * LOW_DISK_BYTES))
    assert failure.event == event
    assert "12 lines wait" in failure.message
    assert event == "disk_full" or os.strerror(error) in failure.message
    assert monitor.update(SECOND, recording(waiting=99), failed_write(error), None) == []
    (recovery,) = monitor.update(2 * SECOND, recording(), None, free(2 * LOW_DISK_BYTES))
    assert recovery.event == "disk_recovered"
    assert monitor.update(3 * SECOND, recording(), None, free(2 * LOW_DISK_BYTES)) == []


def test_full_disk_that_accepts_lines_again_is_low() -> None:
    """Before it has recovered."""
    monitor = DiskMonitor(0)
    monitor.update(SECOND, recording(waiting=12), failed_write(errno.ENOSPC), free(0))
    (event,) = monitor.update(SECOND, recording(), None, free(LOW_DISK_BYTES))
    assert event.event == "disk_low"


@pytest.mark.parametrize("written_ns", [None, 0])
def test_disk_that_does_not_respond_has_failed(written_ns: int | None) -> None:
    """Lines wait, and no write ends; without lines nothing is wrong."""
    monitor = DiskMonitor(0)
    later_ns = HUNG_DISK_TIMEOUT_NS + 1
    assert monitor.update(later_ns, recording(written_ns=written_ns), None, None) == []
    assert monitor.update(later_ns - 1, recording(written_ns=written_ns, waiting=5), None, None) == []
    (event,) = monitor.update(later_ns, recording(written_ns=written_ns, waiting=5), None, None)
    assert event.event == "disk_failed"
    (event,) = monitor.update(later_ns, recording(written_ns=later_ns), None, None)
    assert event.event == "disk_recovered"
