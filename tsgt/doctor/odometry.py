"""Check of the robot's wheel odometry: its program, rate, clock, and speed at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.clock import UnixTimeline
from tsgt.doctor.finding import failed, note, ok
from tsgt.doctor.sensor_program import program_unavailable, status_after
from tsgt.imu import WheelOdometry

if TYPE_CHECKING:
    from tsgt.config import OdometryConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine
    from tsgt.model import OdometrySamples

DURATION_S = 5.0

MAX_REST_SPEED_MPS = 0.02
"""Of the mean at rest: encoders that stand still count nothing; more is an offset, or a robot that moves."""


async def check_odometry(machine: Machine, config: OdometryConfig | None, *, daemon: bool) -> list[Finding]:
    """Run the program for some seconds; the robot must be at rest. None configured: no finding."""
    if config is None:
        return []
    if (found := program_unavailable(machine, "odometry", config.command, daemon=daemon)) is not None:
        return [found]
    records: list[OdometrySamples] = []
    odometry = WheelOdometry(
        config,
        machine.clock,
        UnixTimeline.fixed_now(machine.clock),
        on_samples=records.append,
        on_event=lambda _event, _message: None,
        start=machine.start_odometry,
    )
    status = await status_after(machine, odometry, DURATION_S)
    if status.problem:
        return [failed("odometry", f"{status.device or config.command[0]}: {status.problem}")]
    speeds = [speed for record in records for speed in record.speed_mps]
    mean_mps = sum(speeds) / len(speeds)
    text = (
        f"{status.device}, {status.rate_hz or 0.0:.1f} Hz, {status.gaps} gaps, {status.untrusted} untrusted samples, "
        f"speed {mean_mps:+.3f} m/s, its clock against this one {status.clock_skew_ppm or 0.0:+.1f} ppm"
    )
    if abs(mean_mps) > MAX_REST_SPEED_MPS:
        return [failed("odometry", f"{text}: is the robot at rest?")]
    if status.gaps:
        return [note("odometry", f"{text}; samples are missing: check cable and load")]
    return [ok("odometry", text)]
