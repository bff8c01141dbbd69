"""The recording on disk against the stream, byte by byte."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.recording import StatusRecord, decode
from tsgt.recording.recorder import MAX_PENDING_LINES

if TYPE_CHECKING:
    from array import array
    from collections.abc import Iterator
    from pathlib import Path

    from tsgt.recording import RecordingStatus
    from tsgt.simulation.mission import MasterLog

_NOT_STREAMED = tuple(
    f'{{"type":"{kind}",'.encode() for kind in ("recording", "parameters", "imu", "odometry")
)
"""Starts of lines that are recorded only."""

_STATUS_START = b'{"type":"status",'


class _Compared(NamedTuple):
    lost: list[range]  # numbers of the stream's lines, from 0, that are missing before a recorded one
    end: int  # number of the stream's lines up to the last recorded one
    unknown: bytes | None  # first recorded line that is none of those that follow


def lost_lines(master_log: MasterLog) -> list[range]:
    """Return the numbers, from 0, of the stream's lines that the recording lacks although it has later ones.

    They are the oldest of those that waited for a full disk: see :class:`tsgt.recording.recorder.Recorder`.
    """
    path = master_log.recording()
    return _compare(path, master_log.line_hashes).lost if path and _stated_losses(master_log) else []


def recording_failures(master_log: MasterLog) -> Iterator[str]:
    """Yield the first difference between recording and stream, and lines that are missing without a cause.

    The recording of a master that was killed may end early, with half a line. Lines are lost only while as many as a
    master keeps wait for its disk, and are counted in the status.
    """
    path, hashes = master_log.recording(), master_log.line_hashes
    if path is None:
        if hashes and not master_log.crashed:
            yield "the master published records but has no recording"
        return
    lost, end, unknown = _compare(path, hashes)
    if unknown is not None:
        yield f"{path.name}: line {end + 1} of the stream was recorded as {unknown[:200]!r}"
    elif end < len(hashes) and not master_log.crashed:
        yield f"{path.name}: {end} lines of the stream's {len(hashes)} are recorded"
    missing, stated = sum(map(len, lost)), _stated_losses(master_log)
    if missing > stated:
        yield f"{path.name}: {missing} lines of the stream are missing, first line {lost[0].start + 1}; the status counts {stated}"
    waiting = max((each.waiting_lines for each in _statuses(master_log)), default=0)
    if stated and waiting < MAX_PENDING_LINES:
        yield f"{path.name}: {stated} lines are lost, but only {waiting} were waiting for the disk"


def _compare(path: Path, hashes: array[int]) -> _Compared:
    lost: list[range] = []
    end = 0
    for line in _streamed_lines(path):
        try:
            at = hashes.index(hash(line), end)
        except ValueError:
            return _Compared(lost, end, line)
        if at > end:
            lost.append(range(end, at))
        end = at + 1
    return _Compared(lost, end, None)


def _statuses(master_log: MasterLog) -> Iterator[RecordingStatus]:
    return (each.recording for each in master_log.statuses if each.recording is not None)


def _stated_losses(master_log: MasterLog) -> int:
    return max((each.lost_lines for each in _statuses(master_log)), default=0)


def size_failures(master_log: MasterLog) -> Iterator[str]:
    """Yield the first status that states another file than the recording, or a size that it did not have."""
    path = master_log.recording()
    if path is None:
        return
    size = before = 0
    count = 0
    with path.open("rb") as file:
        for line in file:
            if line.startswith(_STATUS_START) and line.endswith(b"\n"):
                stated = decode(StatusRecord, line).recording
                count += 1
                # Between the status before and this one, unless lines have to wait for the disk.
                if stated is not None and not (
                    stated.file == path.name
                    and (stated.waiting_lines or before <= stated.bytes)
                    and stated.bytes <= size
                ):
                    yield f"status {count}: {stated.bytes} bytes in {stated.file}, {path.name} had {before} to {size}"
                    return
                before = size + len(line)
            size += len(line)


def _streamed_lines(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        for line in file:
            if line.endswith(b"\n") and not line.startswith(_NOT_STREAMED):
                yield line[:-1]
