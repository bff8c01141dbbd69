"""What a status says of recording, disk and stations, for all who show it; IMU and wheels: tests of status and page."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tsgt.model import Status
from tsgt.recording import DiskStatus, RecordingStatus, StationStatus
from tsgt.recording.conditions import (
    MAX_WAITING_LINES,
    DiskCondition,
    RecordingCondition,
    StationCondition,
    disk_condition,
    recording_condition,
    station_condition,
)

SECOND = 1_000_000_000
NOW_NS = 1_800_000_000 * SECOND
STATION = StationStatus(
    id=1, measurements=5, usable=5, age_s=0.2, status=Status.OK, last_heard_s=0.1, answering=True
)


@pytest.mark.parametrize(
    ("written_s", "waiting", "expected"),
    [
        (0.5, 0, RecordingCondition.WRITTEN),
        (60.0, 0, RecordingCondition.WRITTEN),
        (0.5, 20, RecordingCondition.WRITTEN),
        (6.0, 1, RecordingCondition.NOT_WRITTEN),
        (0.5, MAX_WAITING_LINES + 1, RecordingCondition.SLOW),
        (None, 20, RecordingCondition.WRITTEN),
        (None, MAX_WAITING_LINES + 1, RecordingCondition.NOT_WRITTEN),
    ],
)
def test_recording(written_s: float | None, waiting: int, expected: RecordingCondition) -> None:
    """Where nothing waits, nothing has to be written; the first lines wait for the first write."""
    written_ns = None if written_s is None else NOW_NS - round(written_s * SECOND)
    status = RecordingStatus(
        file="a.jsonl", bytes=1, last_write_ns=written_ns, waiting_lines=waiting, lost_lines=0
    )
    assert recording_condition(status, NOW_NS) == expected


@pytest.mark.parametrize(
    ("free", "expected"),
    [
        (2_000_000_000, DiskCondition.OK),
        (900_000_000, DiskCondition.NEARLY_FULL),
        (1_000, DiskCondition.FULL),
    ],
)
def test_disk(free: int, expected: DiskCondition) -> None:
    """By its free space."""
    assert disk_condition(DiskStatus(free_bytes=free, total_bytes=32_000_000_000)) == expected


@pytest.mark.parametrize(
    ("last_heard_s", "answering", "expected"),
    [
        (2.0, False, StationCondition.TRACKING),
        (4.0, False, StationCondition.SILENT),
        (24.0, True, StationCondition.TRACKING),
        (70.0, True, StationCondition.SILENT),
    ],
)
def test_station_that_is_asked_nothing_is_not_silent_at_once(
    last_heard_s: float, expected: StationCondition, *, answering: bool
) -> None:
    """Others are synchronised meanwhile; a master that asks none for a minute receives none."""
    station = replace(STATION, last_heard_s=last_heard_s, age_s=last_heard_s + 0.1, answering=answering)
    assert station_condition(station) == expected
