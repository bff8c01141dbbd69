"""The recording on disk against the stream, byte by byte."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tsgt.simulation.mission import MasterLog

_NOT_STREAMED = tuple(
    f'{{"type":"{kind}",'.encode() for kind in ("recording", "parameters", "imu", "odometry")
)
"""Starts of lines that are recorded only."""

_STATUS_START = b'{"type":"status",'


def recording_failures(master_log: MasterLog) -> Iterator[str]:
    """Yield the first difference between recording and stream.

    The recording of a master that was killed may end early, with half a line.
    """
    path, hashes = master_log.recording(), master_log.line_hashes
    if path is None:
        if hashes and not master_log.crashed:
            yield "the master published records but has no recording"
        return
    count = 0
    for line in _streamed_lines(path):
        if count == len(hashes) or hash(line) != hashes[count]:
            yield f"{path.name}: line {count + 1} of the stream was recorded as {line[:200]!r}"
            return
        count += 1
    if count < len(hashes) and not master_log.crashed:
        yield f"{path.name}: {count} lines of the stream's {len(hashes)} are recorded"


def size_failures(master_log: MasterLog) -> Iterator[str]:
    """Yield the first status that states another file than the recording, or a size that it did not have."""
    path = master_log.recording()
    if path is None:
        return
    size = before = 0
    at = 0
    with path.open("rb") as file:
        for line in file:
            if line.startswith(_STATUS_START) and at < len(master_log.statuses):
                stated = master_log.statuses[at].recording
                at += 1
                # Between the status before and this one, unless lines have to wait for the disk.
                if stated is not None and not (
                    stated.file == path.name
                    and (stated.waiting_lines or before <= stated.bytes)
                    and stated.bytes <= size
                ):
                    yield f"status {at}: {stated.bytes} bytes in {stated.file}, {path.name} had {before} to {size}"
                    return
                before = size + len(line)
            size += len(line)


def _streamed_lines(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        for line in file:
            if line.endswith(b"\n") and not line.startswith(_NOT_STREAMED):
                yield line[:-1]
