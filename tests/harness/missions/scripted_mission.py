"""A master's stream in real time whose content a test changes: stations, poses, disk, fence, or silence."""

from __future__ import annotations

import asyncio
import math
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from harness.files.records import SETUP
from harness.readers.web import pose, station, status

from tsgt.master.stream_server import StreamServer
from tsgt.recording import DiskStatus, HelloRecord, RecordingStatus, encode_line

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

PERIOD_S = 0.05
SECOND_NS = 1_000_000_000


@dataclass
class ScriptedMission:
    """What the stream says from now on."""

    server: StreamServer
    stations: dict[int, dict[str, Any]] = field(default_factory=lambda: {1: {}, 2: {}, 3: {}})
    """Changes of the status of each station."""
    pose: dict[str, Any] = field(default_factory=dict)
    """Changes of the poses."""
    centre_m: tuple[float, float] = (14.0, 12.0)
    """The robot drives in a circle about it."""
    free_bytes: int = 20_000_000_000
    hung: bool = False
    """Whether the master sends nothing."""

    async def run(self) -> None:
        """Send poses and status for ever."""
        number = 0
        while True:
            if not self.hung:
                self._send(number)
            number += 1
            await asyncio.sleep(PERIOD_S)

    def _send(self, number: int) -> None:
        now_ns = time.time_ns()
        angle = number * PERIOD_S / 8
        x, y = self.centre_m[0] + 5 * math.cos(angle), self.centre_m[1] + 5 * math.sin(angle)
        heading = angle + math.pi / 2
        sent = pose(
            0,
            position_m=(x, y, 0.0),
            orientation_xyzw=(0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)),
        )
        shares = tuple(
            replace(each, residual_m=1e-3 * (each.id + math.sin(number / 40 + each.id)))
            for each in sent.stations
        )
        self._publish(replace(sent, stations=shares, residual_m=0.002, **self.pose), now_ns)
        if number % round(1 / PERIOD_S) == 0:
            stations = (station(number, **changes) for number, changes in self.stations.items())
            recording = RecordingStatus(
                file="master-20261121T055100Z.jsonl",
                bytes=18_000_000,
                last_write_ns=now_ns,
                waiting_lines=0,
                lost_lines=0,
            )
            disk = DiskStatus(free_bytes=self.free_bytes, total_bytes=32_000_000_000)
            self._publish(status(0, *stations, recording=recording, disk=disk), now_ns)

    def _publish(self, record: Any, now_ns: int) -> None:
        self.server.publish(encode_line(replace(record, stamp_ns=now_ns)))


@asynccontextmanager
async def scripted_mission(path: Path) -> AsyncIterator[ScriptedMission]:
    """Serve a stream in which all is well on a socket."""
    async with StreamServer(path, encode_line(HelloRecord())) as server:
        server.publish(encode_line(SETUP))
        mission = ScriptedMission(server)
        task = asyncio.create_task(mission.run())
        try:
            yield mission
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
