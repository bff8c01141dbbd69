"""Replays a recording through the live estimator: the same lines, bit for bit, at any speed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.estimation import LiveEstimator
from tsgt.model import (
    ImuSamples,
    Measurement,
    OdometrySamples,
    Parameters,
    PointMeasurement,
    PolarMeasurement,
)
from tsgt.recording import (
    BeaconRecord,
    ClockRecord,
    EventRecord,
    HelloRecord,
    SetupRecord,
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

_Arrival = (
    Measurement
    | ImuSamples
    | OdometrySamples
    | SetupRecord
    | StatusRecord
    | EventRecord
    | ClockRecord
    | BeaconRecord
)

# Records that arrived at the master; headers and parameters are not on the stream, nor are samples of an IMU and of wheels.
_ARRIVALS: dict[str, type[_Arrival]] = {
    "measurement": PolarMeasurement,
    "point": PointMeasurement,
    "imu": ImuSamples,
    "odometry": OdometrySamples,
    "setup": SetupRecord,
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
    """Repeat the calls of the live master, in the same order with the same instants.

    Corrupt lines are passed to ``on_problem`` and skipped if ``keep_going`` is set; else they raise. Yields the instant
    of an arrival on the master's Unix clock in ns, and the stream's lines that follow from it. A session without its
    ``setup`` gets the one of its parameters. Raises RecordingError if
    the recording cannot be read, or measurements precede all parameters.
    """
    estimator: LiveEstimator | None = None
    unannounced: Parameters | None = None  # of a session whose set-up is not among the lines so far
    missing_poses = 0
    for line in read_lines(path, imu=True, keep_going=keep_going, on_problem=on_problem):
        try:
            if line.type == "parameters":
                unannounced = decode_line(Parameters, line, path)
                estimator, missing_poses = LiveEstimator(unannounced), 0
            elif line.type == "pose" and estimator is not None:
                # A pose that was not replayed yet was due by the timer.
                missing_poses += 1
                if missing_poses > 0 and (due_ns := estimator.next_deadline_ns()) is not None:
                    poses = [encode_line(pose) for pose in estimator.advance(due_ns)]
                    missing_poses -= len(poses)
                    yield due_ns, poses
            elif line.type in _ARRIVALS:
                if estimator is None:
                    raise RecordingError(
                        f"a line of type {line.type} precedes all parameters; this is not a complete recording",
                        path=path,
                        line=line.number,
                    )
                now_ns, lines, poses_made = _arrival(
                    estimator, decode_line(_ARRIVALS[line.type], line, path), line
                )
                missing_poses -= poses_made
                if unannounced is not None:
                    if line.type != "setup":  # recorded by an older version, or imported
                        lines.insert(0, encode_line(SetupRecord.of(unannounced, now_ns)))
                    unannounced = None
                yield now_ns, lines
        except CorruptLineError as problem:
            if not keep_going:
                raise
            if on_problem is not None:
                on_problem(problem)


def greeting(path: Path, *, keep_going: bool = False) -> HelloRecord:
    """Return the greeting of a replay: with the limits of the recording's first session. Raises as :func:`replayed`."""
    for line in read_lines(path, keep_going=keep_going):
        if line.type == "parameters":
            return HelloRecord.of(decode_line(Parameters, line, path))
    return HelloRecord()


def _arrival(
    estimator: LiveEstimator,
    record: _Arrival,
    line: Line,
) -> tuple[int, list[bytes], int]:
    """Pass on an arrival; return its instant, the lines that follow from it, and the number of poses among them."""
    if isinstance(record, SetupRecord | StatusRecord | EventRecord | ClockRecord | BeaconRecord):
        now_ns = record.stamp_ns
        records: list[object] = [*estimator.advance(now_ns), record]
    elif isinstance(record, ImuSamples):
        now_ns = record.received_ns
        poses = [encode_line(each) for each in estimator.imu_samples(record)[:-1]]
        return now_ns, poses, len(poses)
    elif isinstance(record, OdometrySamples):
        now_ns = record.received_ns
        poses = [encode_line(each) for each in estimator.odometry_samples(record)[:-1]]
        return now_ns, poses, len(poses)
    else:
        now_ns = record.received_ns
        records = [*estimator.measurement(record)]
    # Lines of the file are passed on unchanged, with unknown keys of a newer program.
    lines = [line.data if each is record else encode_line(each) for each in records]
    return now_ns, lines, len(records) - 1


async def replay(
    arrivals: Iterator[tuple[int, list[bytes]]], server: StreamServer, clock: Clock, *, speed: float
) -> int:
    """Publish arrivals, waiting for slow readers; return the number of lines. Speed 1: real time, infinity: fastest."""
    lines_published = 0
    start_ns: int | None = None
    replay_start_ns = clock.monotonic_ns()
    for now_ns, lines in arrivals:
        start_ns = now_ns if start_ns is None else start_ns
        if math.isfinite(speed):
            await clock.sleep_until(replay_start_ns + round((now_ns - start_ns) / speed))
        for line in lines:
            await server.publish_when_ready(line)
        lines_published += len(lines)
    return lines_published
