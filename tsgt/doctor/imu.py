"""Check of the robot's IMU: its program, rate, clock, and gravity."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING

from tsgt.clock import UnixTimeline
from tsgt.doctor.finding import failed, note, ok, skipped
from tsgt.imu import Imu

if TYPE_CHECKING:
    from tsgt.config import ImuConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine
    from tsgt.model import ImuSamples

DURATION_S = 8.0  # the rate and the plausibility of the values are judged after 5 s of samples

GRAVITY_TOLERANCE_MPS2 = 0.2
"""An uncalibrated accelerometer is off by 20 to 50 mg; more is another unit or a removed gravity."""


async def check_imu(machine: Machine, config: ImuConfig | None, *, daemon: bool) -> list[Finding]:
    """Run the program for some seconds; the robot must be at rest. None configured: no finding."""
    if config is None:
        return []
    if daemon:
        return [skipped("imu", "the running master reads it; `tsgt listen` and its status show how well")]
    if machine.which(config.command[0]) is None:
        return [
            failed(
                "imu",
                f"the program {config.command[0]} does not exist or is not executable: command under [imu]",
            )
        ]
    records: list[ImuSamples] = []
    imu = Imu(
        config,
        machine.clock,
        UnixTimeline.fixed_now(machine.clock),
        on_samples=records.append,
        on_event=lambda _event, _message: None,
        start=machine.start_imu,
    )
    task = asyncio.create_task(imu.run())
    try:
        await machine.clock.sleep_until(machine.clock.monotonic_ns() + round(DURATION_S * 1e9))
        status = imu.status()
    finally:
        task.cancel()
        await asyncio.wait([task])
    if status.problem:
        return [failed("imu", f"{status.device or config.command[0]}: {status.problem}")]
    forces = [force for record in records for force in record.specific_force_mps2]
    gravity = math.hypot(*(sum(values) / len(forces) for values in zip(*forces, strict=True)))
    expected = config.parameters().gravity_mps2
    text = (
        f"{status.device}, {status.rate_hz or 0.0:.1f} Hz, {status.gaps} gaps, gravity {gravity:.3f} m/s^2, "
        f"its clock against this one {status.clock_skew_ppm or 0.0:+.1f} ppm"
    )
    if abs(gravity - expected) > GRAVITY_TOLERANCE_MPS2:
        return [
            failed("imu", f"{text}; expected {expected:.3f} m/s^2: is the robot at rest, the unit m/s^2?")
        ]
    return [
        note("imu", f"{text}; samples are missing: check cable and load") if status.gaps else ok("imu", text)
    ]
