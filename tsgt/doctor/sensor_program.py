"""Runs the program of one of the robot's sensors for some seconds: for the checks of IMU and wheel odometry."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol, TypeVar

from tsgt.doctor.finding import failed, skipped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine

StatusT_co = TypeVar("StatusT_co", covariant=True)


class SensorProgram(Protocol[StatusT_co]):
    """Starts the program of a sensor and reads its samples."""

    async def run(self) -> None:
        """Read until cancelled."""

    def status(self) -> StatusT_co:
        """Return how well it reads."""
        ...


def program_unavailable(
    machine: Machine, section: str, command: Sequence[str], *, daemon: bool
) -> Finding | None:
    """Return why the program of a section of the configuration cannot be run; None: it can."""
    if daemon:
        return skipped(section, "the running master reads it; `tsgt listen` and its status show how well")
    if machine.which(command[0]) is None:
        return failed(
            section,
            f"the program {command[0]} does not exist or is not executable: command under [{section}]",
        )
    return None


async def status_after(machine: Machine, program: SensorProgram[StatusT_co], duration_s: float) -> StatusT_co:
    """Run a program for some seconds and return its status at the end."""
    task = asyncio.create_task(program.run())
    try:
        await machine.clock.sleep_until(machine.clock.monotonic_ns() + round(duration_s * 1e9))
        return program.status()
    finally:
        task.cancel()
        await asyncio.wait([task])
