"""A recording through the live pipeline again: the same lines, bit for bit, at any speed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.estimation import Feed
from tsgt.model import Measurement, Parameters, PointMeasurement, PolarMeasurement
from tsgt.recording import (
    BeaconRecord,
    ClockRecord,
    EventRecord,
    StatusRecord,
    decode_line,
    encode_line,
    read_lines,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.master.stream_server import StreamServer
    from tsgt.recording import Line

# What came from outside; headers and parameters are not on the stream.
_ARRIVALS: dict[str, type[Measurement | StatusRecord | EventRecord | ClockRecord | BeaconRecord]] = {
    "measurement": PolarMeasurement,
    "point": PointMeasurement,
    "clock": ClockRecord,
    "beacon": BeaconRecord,
    "status": StatusRecord,
    "event": EventRecord,
}


def replayed(
    path: Path,
    *,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Iterator[tuple[int, list[bytes]]]:
    """Make the calls that the live master made, in the same order with the same instants.

    Parameters
    ----------
    path
        The recording.
    keep_going
        Skip lines that cannot be read instead of raising.
    on_problem
        Told of each line that is skipped.

    Yields
    ------
    tuple[int, list[bytes]]
        The instant of an arrival on the master's Unix clock in ns, and the lines that it brought to the stream.

    Raises
    ------
    RecordingError
        The recording cannot be read, or measurements stand in it before any parameters.
    """
    feed: Feed | None = None
    missing_poses = 0
    for line in read_lines(path, keep_going=keep_going, on_problem=on_problem):
        try:
            if line.type == "parameters":
                feed, missing_poses = Feed(decode_line(Parameters, line, path)), 0
            elif line.type == "pose" and feed is not None:
                # One that was not made yet was due by the timer, with nothing arriving any more.
                missing_poses += 1
                if missing_poses > 0 and (due_ns := feed.next_deadline_ns()) is not None:
                    poses = [encode_line(pose) for pose in feed.advance(due_ns)]
                    missing_poses -= len(poses)
                    yield due_ns, poses
            elif line.type in _ARRIVALS:
                if feed is None:
                    raise RecordingError(
                        f"a line of type {line.type} stands before any parameters; this is not a whole recording",
                        path=path,
                        line=line.number,
                    )
                now_ns, lines, poses_made = _arrival(
                    feed, decode_line(_ARRIVALS[line.type], line, path), line
                )
                missing_poses -= poses_made
                yield now_ns, lines
        except CorruptLineError as problem:
            if not keep_going:
                raise
            if on_problem is not None:
                on_problem(problem)


def _arrival(
    feed: Feed, record: Measurement | StatusRecord | EventRecord | ClockRecord | BeaconRecord, line: Line
) -> tuple[int, list[bytes], int]:
    """Hand over what arrived: the instant, the lines that it brought, and how many of them are poses."""
    if isinstance(record, StatusRecord | EventRecord | ClockRecord | BeaconRecord):
        now_ns = record.stamp_ns
        records: list[object] = [*feed.advance(now_ns), record]
    else:
        now_ns = record.received_ns
        records = [*feed.measurement(record)]
    # What stood in the file goes out as it stood there, with keys that only a newer program knows.
    lines = [line.data if each is record else encode_line(each) for each in records]
    return now_ns, lines, len(records) - 1


async def replay(
    arrivals: Iterator[tuple[int, list[bytes]]], server: StreamServer, clock: Clock, *, speed: float
) -> int:
    """Publish replayed arrivals at their own pace times a speed, waiting for readers rather than losing lines.

    Parameters
    ----------
    arrivals
        From :func:`replayed`.
    server
        The open stream.
    clock
        Sets the pace.
    speed
        1 is the pace of the recording, infinity as fast as the readers can take.

    Returns
    -------
    int
        How many lines were published.
    """
    lines_published = 0
    start_ns: int | None = None
    began_ns = clock.monotonic_ns()
    for now_ns, lines in arrivals:
        start_ns = now_ns if start_ns is None else start_ns
        if math.isfinite(speed):
            await clock.sleep_until(began_ns + round((now_ns - start_ns) / speed))
        for line in lines:
            await server.publish_patiently(line)
        lines_published += len(lines)
    return lines_published
