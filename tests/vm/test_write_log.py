"""The log of a disk's writes, and what a power cut leaves of them: without a virtual machine."""

from __future__ import annotations

import random
import struct
from typing import TYPE_CHECKING

from vm import write_log

if TYPE_CHECKING:
    from pathlib import Path

SECTOR = 512
FLUSH, FUA = 1, 2


def make_log(path: Path, requests: list[tuple[int, bytes, int]]) -> None:
    """Write a log of requests: sector, data, flags."""
    content = struct.pack("<QQQI", 0x6A736677736872, 1, len(requests), SECTOR).ljust(SECTOR, b"\0")
    for sector, data, flags in requests:
        content += struct.pack("<QQQQ", sector, len(data) // SECTOR, flags, 0).ljust(SECTOR, b"\0") + data
    path.write_bytes(content)


def test_flushed_writes_survive_every_cut(tmp_path: Path) -> None:
    """Of those after the flush each may be lost, alone; one that is forced to the disk is not."""
    log, disk = tmp_path / "log", tmp_path / "disk"
    block = {name: name.encode() * SECTOR for name in "abcd"}
    make_log(
        log,
        [(0, block["a"], 0), (0, b"", FLUSH), (1, block["b"], 0), (2, block["c"], 0), (3, block["d"], FUA)],
    )
    writes = write_log.read(log)
    assert write_log.count(log) == len(writes) == 5
    found = set()
    for seed in range(40):
        disk.write_bytes(bytes(4 * SECTOR))
        write_log.replay(log, writes, 5, disk, random.Random(seed))  # noqa: S311 (instants)
        found.add(bytes(disk.read_bytes()[::SECTOR]))
    assert found == {b"a\0\0d", b"ab\0d", b"a\0cd", b"abcd"}


def test_nothing_after_the_cut_is_on_the_disk(tmp_path: Path) -> None:
    """Cut before the last request."""
    log, disk = tmp_path / "log", tmp_path / "disk"
    make_log(log, [(0, b"a" * SECTOR, FUA), (1, b"b" * SECTOR, FUA)])
    disk.write_bytes(bytes(2 * SECTOR))
    write_log.replay(log, write_log.read(log), 1, disk, random.Random(0))  # noqa: S311 (instants)
    assert disk.read_bytes()[::SECTOR] == b"a\0"
