"""Keeps the number of shocks of the IMU for a master that starts later."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, NoReturn

import structlog

from tsgt.errors import OutputFileError
from tsgt.recording import IMU_SHOCKS_FILE, read_imu_shocks, write_imu_shocks

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.model import ImuParameters, Parameters

RETRY_NS = 1_000_000_000

log = structlog.get_logger()


class ShockMemory:
    """The number of shocks with the mounting in force, in memory and in a folder."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._imu: ImuParameters | None = None
        self._shocks = 0
        self._changed = asyncio.Event()

    def recall(self, parameters: Parameters) -> Parameters:
        """Return parameters with the shocks that this master and those before have measured with the same mounting."""
        imu, before = parameters.imu, self._imu
        self._imu = imu
        if imu is None:
            return parameters
        if before is None or before.mounting != imu.mounting:
            self._shocks = read_imu_shocks(self._directory, imu)
            if self._shocks:
                path = self._directory / IMU_SHOCKS_FILE
                log.warning("imu_shocks_recalled", shocks=self._shocks, path=str(path))
        return replace(parameters, imu=replace(imu, shocks_before=self._shocks))

    def note(self, shocks: int) -> None:
        """Take the present number of shocks."""
        if shocks != self._shocks:
            self._shocks = shocks
            self._changed.set()

    async def run(self, clock: Clock) -> NoReturn:
        """Write the number when it changes, in a thread; try again if the disk refuses it."""
        failed = False
        while True:
            await self._changed.wait()
            self._changed.clear()
            if self._imu is None:
                continue
            try:
                await asyncio.to_thread(write_imu_shocks, self._directory, self._imu, self._shocks)
                failed = False
            except OutputFileError as error:
                if not failed:
                    log.error("imu_shocks_not_kept", error=str(error))  # noqa: TRY400 (the message suffices)
                failed = True
                self._changed.set()
                await clock.sleep_until(clock.monotonic_ns() + RETRY_NS)
