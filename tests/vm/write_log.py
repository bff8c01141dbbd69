"""The log of all writes to a virtual disk (QEMU's blklogwrites, the format of Linux's dm-log-writes), and what a power cut leaves.

A disk may lose what was written since its last flush, in any order: a cut keeps all writes before a flush, and of those
after it some.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import random
    from pathlib import Path

_SUPER = struct.Struct("<QQQI")  # magic, version, number of entries, sector size
_ENTRY = struct.Struct("<QQQQ")  # sector, number of sectors, flags, length of inline data
_MAGIC = 0x6A736677736872
_FLUSH, _FUA, _DISCARD = 1, 2, 4


@dataclass(frozen=True, slots=True)
class Write:
    """One request: where its data is in the log, and where it belongs on the disk."""

    offset: int
    length: int
    log_offset: int
    flush: bool
    durable: bool
    """Whether it is on the disk when it is complete."""


def count(log: Path) -> int:
    """Return how many requests are logged."""
    with log.open("rb") as file:
        head = file.read(_SUPER.size)
    return _SUPER.unpack(head)[2] if len(head) == _SUPER.size else 0


def read(log: Path) -> list[Write]:
    """Return the requests in the order in which the disk took them."""
    writes = []
    with log.open("rb") as file:
        magic, _, number, sector_bytes = _SUPER.unpack(file.read(_SUPER.size))
        if magic != _MAGIC:
            raise ValueError(f"{log} is no log of writes")
        at = sector_bytes
        for _ in range(number):
            file.seek(at)
            sector, sectors, flags, _ = _ENTRY.unpack(file.read(_ENTRY.size))
            at += sector_bytes
            length = 0 if flags & _DISCARD else sectors * sector_bytes
            writes.append(Write(sector * sector_bytes, length, at, bool(flags & _FLUSH), bool(flags & _FUA)))
            at += length
    return writes


def replay(log: Path, writes: list[Write], cut: int, disk: Path, generator: random.Random) -> None:
    """Bring a disk from the state at the start of the log to one that a power cut after ``cut`` requests may leave."""
    flushed = max((number for number, write in enumerate(writes[:cut]) if write.flush), default=-1)
    with log.open("rb") as source, disk.open("r+b") as target:
        for number, write in enumerate(writes[:cut]):
            if not write.length or (number > flushed and not write.durable and generator.random() < 0.5):
                continue
            source.seek(write.log_offset)
            target.seek(write.offset)
            target.write(source.read(write.length))
