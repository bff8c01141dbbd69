"""What a reader of the stream got, against what the master published."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tsgt.simulation.mission import MasterLog

_GREETING_LINES = 2
"""The greeting and the newest set-up."""


def heard_failures(master_log: MasterLog, connections: Sequence[Sequence[int]]) -> Iterator[str]:
    """Yield the connections in which a reader did not get successive lines of the stream, after greeting and set-up.

    ``connections``: hashes of the lines that it got in each.
    """
    published = master_log.line_hashes
    places: dict[int, list[int]] = {}
    for place, line in enumerate(published):
        places.setdefault(line, []).append(place)
    for number, heard in enumerate(connections, 1):
        lines = array("q", heard[_GREETING_LINES:])
        if len(heard) >= _GREETING_LINES and heard[1] not in master_log.setup_hashes:
            yield f"connection {number}: the second line is no set-up that was published"
        if not lines or any(published[at : at + len(lines)] == lines for at in places.get(lines[0], ())):
            continue
        wrong = sum(line not in places for line in lines)
        yield (
            f"connection {number}: {len(lines)} lines are not successive lines of the stream; {wrong} of them were never published"
        )
