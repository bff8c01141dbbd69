"""A program for the client's bridge, with an invented instrument in place of yours.

Usage, in the client's configuration: ``command = ["python3", "/path/bridge_program.py"]``; with the name of a CSV file
as argument its rows (horizontal angle and zenith angle in rad, slope distance in m) are printed one by one, repeatedly. It
requires only Python's standard library. docs/reference/bridge.md specifies the lines.
"""

from __future__ import annotations

import csv
import itertools
import json
import math
import queue
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

PERIOD_NS = 400_000_000

Row = tuple[float, float, float]


def circling() -> Iterator[Row]:
    """Yield measurements of a prism that moves in a circle, 20 m away."""
    for step in itertools.count():
        angle = 0.05 * step
        x, y = 20 + 3 * math.cos(angle), 3 * math.sin(angle)
        yield math.atan2(y, x) % (2 * math.pi), math.pi / 2, math.hypot(x, y)


def rows_of(path: str) -> Iterable[Row]:
    """Return the rows of a CSV file, repeatedly."""
    with open(path, encoding="utf-8") as file:  # noqa: PTH123 (as anybody would write it)
        rows = [(float(row[0]), float(row[1]), float(row[2])) for row in csv.reader(file)]
    return itertools.cycle(rows)


def send(record: dict[str, Any]) -> None:
    """Print a line and flush the output, which is buffered otherwise."""
    print(json.dumps(record), flush=True)


def listen(commands: queue.Queue[dict[str, Any] | None]) -> None:
    """Queue the client's commands; None when the client is gone."""
    for line in sys.stdin:
        commands.put(json.loads(line))
    commands.put(None)


def measured(row: Row) -> dict[str, Any]:
    """Return a measurement of this moment. Replace it by your instrument, and the time by that of its callback."""
    horizontal, zenith, distance = row
    return {
        "host_time_ns": time.monotonic_ns(),  # CLOCK_MONOTONIC
        "horizontal_angle_rad": horizontal,
        "zenith_angle_rad": zenith,
        "slope_distance_m": distance,
        "status": "ok",
    }


def main() -> None:
    """Measure and execute commands until the client is gone."""
    rows = iter(rows_of(sys.argv[1]) if len(sys.argv) > 1 else circling())
    commands: queue.Queue[dict[str, Any] | None] = queue.Queue()
    threading.Thread(target=listen, args=(commands,), daemon=True).start()
    send(
        {
            "type": "hello",
            "bridge": 1,
            "make": "Example",
            "model": "invented",
            "stamps": "host",
            "commands": ["track", "direct", "measure"],
        }
    )
    send({"type": "settings", "prism_type": "360", "prism_constant_m": 0.0})
    prism: int | None = None
    next_ns = time.monotonic_ns()
    while True:
        try:
            command = commands.get(timeout=max(0, next_ns - time.monotonic_ns()) / 1e9)
        except queue.Empty:
            next_ns += PERIOD_NS
            row = next(rows)
            if prism is not None:
                send({"type": "measurement", "prism": prism} | measured(row))
            continue
        if command is None:
            return
        if command["type"] == "measure":
            send({"type": "shot", "id": command["id"]} | measured(next(rows)))
            continue
        prism = command["prism"] if command["type"] == "track" else None
        send({"type": "done", "id": command["id"]})


if __name__ == "__main__":
    main()
