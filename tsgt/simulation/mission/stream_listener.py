"""A reader of the master's stream, a few seconds out of every half minute: what it got is compared with what was published."""

from __future__ import annotations

import socket
from array import array
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from tsgt.simulation.mission.mission import Mission

FIRST_S, PERIOD_S = 8.0, 30.0
WINDOW_READS, READ_INTERVAL_S = 5, 1.0
_READ_BYTES = 1 << 20


async def listen_to_stream(mission: Mission) -> NoReturn:
    """Connect again and again until cancelled; the lines are hashed into ``heard`` of the master's log."""
    at_s = FIRST_S
    while True:
        await mission.sleep_until(at_s)
        master_log = mission.master_logs[-1]
        # Not asyncio's streams, which wake up for every line.
        with (
            socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as connection,
            suppress(OSError),
        ):
            connection.connect(str(mission.stream_socket()))
            content = b""
            for read in range(1, WINDOW_READS + 1):
                await mission.sleep_until(at_s + read * READ_INTERVAL_S)
                with suppress(BlockingIOError):
                    content += connection.recv(_READ_BYTES)
            lines = content.split(b"\n")[:-1]
            master_log.heard.append(array("q", map(hash, lines)))
        at_s += PERIOD_S
