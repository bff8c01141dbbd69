"""Bounds on the collections in the daemons' memory."""

from __future__ import annotations

import gc
from collections import deque

from tsgt.master.classic import DUPLICATE_WINDOW
from tsgt.master.stream_server import QUEUE_LINES
from tsgt.radio.superframe import QUEUE_CAPACITY
from tsgt.recording.recorder import HUNG_DISK_FACTOR, MAX_PENDING_LINES
from tsgt.station.backlog import MAX_RECEPTIONS
from tsgt.timesync import MAX_SAMPLES

MAX_ENTRIES = 500
"""Default bound of a collection."""

MAX_IMU_LINES = 3000
"""Lines of 50 s, and as many again that were held back and arrive at once."""

MAX_IMU_MEASUREMENTS = 1500
"""Of 50 s: three stations that deliver a backlog of a minute send 25 a second (docs/explanation/superframe.md)."""

STATED_BOUNDS = {
    ("_Reader", "_queue"): QUEUE_LINES,
    ("StationIngest", "_known"): DUPLICATE_WINDOW,
    ("Recorder", "_queue"): HUNG_DISK_FACTOR * MAX_PENDING_LINES,
    ("SuperframeLink", "_unsynced"): HUNG_DISK_FACTOR * MAX_PENDING_LINES,  # whose lines wait there
    ("_Stream", "pending"): HUNG_DISK_FACTOR * MAX_PENDING_LINES,  # likewise
    ("SendQueue", "_queue"): QUEUE_CAPACITY,
    ("SendQueue", "_runs"): QUEUE_CAPACITY // 2,  # every other one is acknowledged
    ("Backlog", "queued"): QUEUE_CAPACITY,
    ("Backlog", "receptions"): MAX_RECEPTIONS,
    ("ImuSetupMonitor", "_records"): MAX_IMU_LINES,
    ("ImuSetupMonitor", "_measurements"): MAX_IMU_MEASUREMENTS,
    ("ImuSelector", "_records"): MAX_IMU_LINES,
    **dict.fromkeys(
        (("ClockSegment", name) for name in ("_forward", "_samples", "_received_ns")), MAX_SAMPLES
    ),
}
"""Bounds of other collections, by class and attribute."""

_SIZED = (list, deque, dict, set, bytearray, tuple)
_PACKAGES = tuple(
    f"tsgt.{room}."
    for room in ("master", "estimation", "radio", "timesync", "station", "recording", "geometry")
)


def oversized_collections() -> tuple[str, ...]:
    """Return the collections of all daemon objects in this process that exceed their bound, one line each."""
    found = []
    kinds: dict[type, bool] = {}  # whether the class belongs to a daemon
    for thing in gc.get_objects():
        kind = type(thing)
        ours = kinds.get(kind)
        if ours is None:
            ours = kinds[kind] = str(kind.__module__).startswith(_PACKAGES)
        if not ours:
            continue
        names = getattr(thing, "__dict__", None) or [
            name for base in kind.__mro__ for name in getattr(base, "__slots__", ())
        ]
        for name in names:
            value = getattr(thing, name, None)
            bound = STATED_BOUNDS.get((kind.__name__, name), MAX_ENTRIES)
            if isinstance(value, _SIZED) and len(value) > bound:
                found.append(f"{kind.__module__}.{kind.__name__}.{name}: {len(value)} entries, limit {bound}")
    return tuple(sorted(set(found)))
