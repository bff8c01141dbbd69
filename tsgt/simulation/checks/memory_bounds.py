"""Whether anything in the daemons' memory grows without a bound that is stated."""

from __future__ import annotations

import gc
from collections import deque

from tsgt.master import QUEUE_LINES
from tsgt.master.classic import KNOWN_MEASUREMENTS
from tsgt.radio.superframe import MOST_QUEUED
from tsgt.recording.recorder import HUNG_FACTOR, WAITING_LINES
from tsgt.timesync import MOST_PAIRS

MOST_ENTRIES = 500
"""A list, queue or table of a daemon has at most so many entries, if nothing else is stated."""

STATED = {
    ("_Reader", "_queue"): QUEUE_LINES,
    ("_Station", "_known"): KNOWN_MEASUREMENTS,
    ("Recorder", "_waiting"): HUNG_FACTOR * WAITING_LINES,
    ("Outbox", "_queue"): MOST_QUEUED,
    **dict.fromkeys((("Stretch", name) for name in ("_before", "_pairs", "_received_ns")), MOST_PAIRS),
}
"""Those with a bound of their own: class and attribute, and how many entries it may have."""

_SIZED = (list, deque, dict, set, bytearray, tuple)
_PACKAGES = ("tsgt.master.", "tsgt.radio.", "tsgt.station.", "tsgt.recording.", "tsgt.geometry.")


def overgrown() -> tuple[str, ...]:
    """Look at all objects of the daemons that live in this process, one line for each that has too much in it."""
    found = []
    kinds: dict[type, bool] = {}  # whether it is one of a daemon's
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
            if isinstance(value, _SIZED) and len(value) > STATED.get((kind.__name__, name), MOST_ENTRIES):
                found.append(f"{kind.__module__}.{kind.__name__}.{name} has {len(value)} entries")
    return tuple(sorted(set(found)))
