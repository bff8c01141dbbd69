"""What the duration of an fsync costs a master that acknowledges what is on its disk: retransmissions, and the age of data and poses.

Run it with ``python benchmarks/run.py slow_disk [SEED...]``; 2 minutes of the scenario `dynamic` per row and seed, without losses.
Every fsync of the master's recording takes the same time, in virtual time, and the next one waits for it.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn
from unittest.mock import patch

import numpy as np
from measuring import simulated

from tsgt.config import ScenarioConfig
from tsgt.errors import MessageError
from tsgt.master import daemon
from tsgt.master.recording_thread import RecordingThread
from tsgt.radio.superframe.wire import CODE_BYTES, decode_reply
from tsgt.simulation.options import SimulationOptions

if TYPE_CHECKING:
    from tsgt.simulation.lora.air import Transceiver
    from tsgt.simulation.lora.frames import Frame
    from tsgt.simulation.mission import Mission, MissionResult

FSYNC_MS = (0, 5, 20, 50, 200)
DURATION_S = 120.0


def slow_thread(fsync_s: float) -> type[RecordingThread]:
    """Return a recording thread whose fsync takes that long; what is written meanwhile waits for the next one."""

    class SlowThread(RecordingThread):
        async def run(self) -> NoReturn:
            while True:
                await self._pending.wait()
                self._pending.clear()
                sync, self._sync_requested = self._sync_requested, False
                self._recorder.flush()
                self._last_write_ns = self._unix_now_ns()
                if sync:
                    await asyncio.sleep(fsync_s)
                    self._recorder.sync()
                    self._sync_done.set()

    return SlowThread


class Replies:
    """Counts what stations send."""

    def __init__(self) -> None:
        self.measurements = 0

    async def count(self, mission: Mission) -> None:
        """Count from now on."""
        send = mission.air.send

        def counted(sender: Transceiver, frame: Frame) -> object:
            if sender.name != "master":
                with suppress(MessageError):
                    blocks = decode_reply(frame.payload[:-CODE_BYTES]).blocks
                    self.measurements += sum(len(block.measurements) for block in blocks)
            return send(sender, frame)

        mission.air.send = counted  # type: ignore[method-assign, assignment]


def row(fsync_ms: float, seed: int) -> list[float]:
    """Return the share of retransmissions, and quantiles of ages in ms."""
    replies = Replies()
    options = SimulationOptions(duration_s=DURATION_S, seed=seed)
    with (
        patch.object(daemon, "RecordingThread", slow_thread(fsync_ms / 1e3)),
        simulated(ScenarioConfig(), options, script=replies.count) as run,
    ):
        return [100 * (1 - len(run.master_logs[0].measurements) / replies.measurements), *ages_ms(run)]


def ages_ms(run: MissionResult) -> list[float]:
    """Return the duration of a frame, and p50 and p99 of the ages of arriving measurements and of published predicted poses."""
    log = run.master_logs[0]
    stamps_ns = np.array([m.stamp_ns for m in log.measurements], dtype=np.int64) - log.unix_at_zero_ns
    poses = log.valid_poses()
    poses_s = poses.newest_age_s[poses.series == "predicted"]
    return [
        log.frames_duration_ns / 1e6 / log.frame_count,
        *np.percentile((np.array(log.arrived_ns) - stamps_ns) / 1e6, (50, 99)),
        *np.percentile(poses_s * 1e3, (50, 99)),
    ]


def main() -> None:
    """Print the table."""
    seeds = [int(each) for each in sys.argv[1:]] or [0]
    print(
        "| fsync ms | retransmitted | frame ms | age of measurements p50 / p99 ms | newest of a pose p50 / p99 ms |"
    )
    print("|---|---|---|---|---|")
    for fsync_ms in FSYNC_MS:
        values = np.mean([row(fsync_ms, seed) for seed in seeds], axis=0)
        share, frame, age50, age99, pose50, pose99 = values
        print(
            f"| {fsync_ms} | {share:.1f} % | {frame:.0f} | {age50:.0f} / {age99:.0f} | {pose50:.0f} / {pose99:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
