"""Check of the robot's IMU: its program, rate, clock, and gravity."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tsgt.clock import UnixTimeline
from tsgt.doctor.finding import failed, note, ok
from tsgt.doctor.sensor_program import program_unavailable, status_after
from tsgt.imu import Imu

if TYPE_CHECKING:
    from tsgt.config import ImuConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine
    from tsgt.model import ImuSamples, Vector3

DURATION_S = 8.0  # the rate and the plausibility of the values are judged after 5 s of samples

GRAVITY_TOLERANCE_MPS2 = 0.2
"""An uncalibrated accelerometer is off by 20 to 50 mg; more is another unit or a removed gravity."""

BIAS_SIGMAS = 6.0
"""The mean rate at rest is the bias. A device that gives degrees exceeds this 57 times over."""

EARTH_RATE_RADPS = 7.3e-5


async def check_imu(machine: Machine, config: ImuConfig | None, *, daemon: bool) -> list[Finding]:
    """Run the program for some seconds; the robot must be at rest. None configured: no finding."""
    if config is None:
        return []
    if (found := program_unavailable(machine, "imu", config.command, daemon=daemon)) is not None:
        return [found]
    records: list[ImuSamples] = []
    imu = Imu(
        config,
        machine.clock,
        UnixTimeline.fixed_now(machine.clock),
        on_samples=records.append,
        on_event=lambda _event, _message: None,
        start=machine.start_imu,
    )
    status = await status_after(machine, imu, DURATION_S)
    if status.problem:
        return [failed("imu", f"{status.device or config.command[0]}: {status.problem}")]
    gravity = math.hypot(*_mean([each for record in records for each in record.specific_force_mps2]))
    rate = _mean([each for record in records for each in record.angular_rate_radps])
    expected = config.parameters().gravity_mps2
    bias = " ".join(f"{math.degrees(each):+.2f}" for each in rate)
    text = (
        f"{status.device}, {status.rate_hz or 0.0:.1f} Hz, {status.gaps} gaps, {status.saturated} saturated samples, "
        f"gravity {gravity:.3f} m/s^2, gyro bias {bias} deg/s, "
        f"its clock against this one {status.clock_skew_ppm or 0.0:+.1f} ppm"
    )
    if max(map(abs, rate)) > BIAS_SIGMAS * config.noise.noise().gyro_bias_radps + EARTH_RATE_RADPS:
        return [
            failed(
                "imu",
                f"{text}: more than {BIAS_SIGMAS:g} times its sigma; is the robot at rest, the unit rad/s, the preset under "
                "[imu] noise right?",
            )
        ]
    if abs(gravity - expected) > GRAVITY_TOLERANCE_MPS2:
        return [
            failed("imu", f"{text}; expected {expected:.3f} m/s^2: is the robot at rest, the unit m/s^2?")
        ]
    return [
        note("imu", f"{text}; samples are missing: check cable and load") if status.gaps else ok("imu", text)
    ]


def _mean(values: list[Vector3]) -> list[float]:
    return [sum(axis) / len(values) for axis in zip(*values, strict=True)]
