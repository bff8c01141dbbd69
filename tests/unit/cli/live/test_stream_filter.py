"""Selection of lines by kind, time and rate."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.files.records import CLOCK, EVENT, HELLO, POINT, POSE, SETUP, START, STATUS, measurement

from tsgt.cli.live.stream_filter import StreamFilter
from tsgt.recording import BeaconRecord, encode_line

SMOOTHED = replace(POSE, kind="smoothed")
BEACON = BeaconRecord(stamp_ns=START, stamp_sigma_ns=1, session=1, counter=0)
RECORDS = (HELLO, SETUP, measurement(0), POINT, POSE, SMOOTHED, CLOCK, BEACON, STATUS, EVENT)
MS = 1_000_000


def selected(stream_filter: StreamFilter, records: tuple[object, ...] = RECORDS) -> list[object]:
    """Return the records that a filter accepts."""
    return [record for record in records if stream_filter.accepts(encode_line(record))]


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ("", RECORDS),
        ("pose", (POSE,)),
        ("smoothed event", (SMOOTHED, EVENT)),
        ("measurement clock", (measurement(0), POINT, CLOCK, BEACON)),
        ("hello setup status", (HELLO, SETUP, STATUS)),
    ],
)
def test_kinds(kinds: str, expected: tuple[object, ...]) -> None:
    """Poses are of two kinds; points are measurements, beacons belong to the clocks."""
    assert selected(StreamFilter(frozenset(kinds.split()))) == list(expected)


def test_rate_applies_to_each_series() -> None:
    """At most so many poses per second, whatever the rate of the stream; other lines are not affected."""
    delayed = replace(SMOOTHED, delay_s=1.0)
    stamps = [START + 50 * MS * epoch for epoch in range(200)]
    poses = [replace(pose, stamp_ns=at) for at in stamps for pose in (POSE, SMOOTHED, delayed)]
    found = selected(StreamFilter(rate_hz=3.0), (*poses, EVENT, EVENT))
    assert found[-2:] == [EVENT, EVENT]
    for series in ("interpolated", "smoothed", "smoothed_1s"):
        assert sum(getattr(pose, "series", "") == series for pose in found) in (30, 31)  # in 10 s
    assert selected(StreamFilter(rate_hz=20.0), tuple(poses)) == poses


def test_since_skips_what_is_older() -> None:
    """But not what is in force."""
    later = replace(POSE, stamp_ns=POSE.stamp_ns + 1)
    since = StreamFilter(since_ns=later.stamp_ns)
    assert selected(since, (HELLO, SETUP, POSE, later)) == [HELLO, SETUP, later]


def test_line_that_is_none_is_an_error() -> None:
    """The caller reports it."""
    with pytest.raises(ValueError, match="JSON"):
        StreamFilter(frozenset({"pose"})).accepts(b"garbage")
