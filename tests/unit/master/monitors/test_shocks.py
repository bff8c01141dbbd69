"""Shocks of the IMU are kept for a master that starts later."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from harness.files.records import IMU_PARAMETERS, PARAMETERS
from structlog.testing import capture_logs

from tsgt.master.monitors import ShockMemory
from tsgt.recording import read_imu_shocks
from tsgt.simulation.kernel import VirtualClock

if TYPE_CHECKING:
    from pathlib import Path

WITH_IMU = replace(PARAMETERS, imu=IMU_PARAMETERS)


def shocks_before(parameters: Any) -> int:
    """Return those of the IMU."""
    return int(parameters.imu.shocks_before)


async def _run_for(memory: ShockMemory, for_s: float) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(for_s):
            await memory.run(VirtualClock(0))


async def test_next_master_recalls_the_shocks(tmp_path: Path) -> None:
    """Once they are written; a new set-up with the same mounting has them at once, another mounting has none."""
    memory = ShockMemory(tmp_path)
    assert shocks_before(memory.recall(WITH_IMU)) == 0
    memory.note(1)
    memory.note(2)
    assert shocks_before(memory.recall(WITH_IMU)) == 2
    await _run_for(memory, 0.1)
    with capture_logs() as logs:
        assert shocks_before(ShockMemory(tmp_path).recall(WITH_IMU)) == 2
    assert [(each["event"], each["shocks"]) for each in logs] == [("imu_shocks_recalled", 2)]
    moved = replace(WITH_IMU, imu=replace(IMU_PARAMETERS, position_m=(0.0, 0.0, 0.9)))
    assert shocks_before(memory.recall(moved)) == 0
    assert memory.recall(PARAMETERS) == PARAMETERS


async def test_disk_that_refuses_the_file_is_tried_again(tmp_path: Path) -> None:
    """Here the folder comes later."""
    folder = tmp_path / "recordings"
    memory = ShockMemory(folder)
    memory.recall(WITH_IMU)
    memory.note(1)
    await _run_for(memory, 0.5)
    assert read_imu_shocks(folder, IMU_PARAMETERS) == 0
    folder.mkdir()
    await _run_for(memory, 0.5)
    assert read_imu_shocks(folder, IMU_PARAMETERS) == 1
