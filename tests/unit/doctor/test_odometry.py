"""Checks of ``tsgt doctor``: the robot's wheel odometry."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from harness.hardware.fake_machine import NOW_NS, FakeMachine
from harness.inertial import imu
from harness.instruments.bridge import FakeStart
from structlog.testing import capture_logs

from tsgt.doctor import Outcome
from tsgt.simulation.kernel import VirtualClock, run_virtual

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.doctor import Finding

CONFIG = """
[imu]
command = ["imu-program"]
position_m = [0.0, 0.0, 0.0]
orientation_xyzw = [0.0, 0.0, 0.0, 1.0]
latitude_deg = 46.8

[odometry]
command = ["odometry-program"]
"""
HELLO = {"type": "hello", "odometry": 1, "make": "Acme", "rate_hz": 10.0}


def finding(
    tmp_path: Path,
    *,
    speed_mps: float = 0.0,
    every: int = 1,
    programs: tuple[str, ...] = ("odometry-program",),
) -> Finding:
    """Run the checks of a master whose wheel odometry prints a sample ten times a second."""
    found: dict[str, Finding] = {}

    async def main() -> None:
        fake = FakeMachine(tmp_path)
        fake.change("master.toml", "[[stations]]\nstation = 1", CONFIG + "[[stations]]\nstation = 1")
        fake.programs.update(programs)
        fake.start_imu = FakeStart(VirtualClock(NOW_NS), imu.HELLO)
        start = fake.start_odometry = FakeStart(VirtualClock(NOW_NS), HELLO)
        clock = fake.machine().clock

        async def sample() -> None:
            for number in range(0, 10**5, every):
                await clock.sleep_until(clock.monotonic_ns() + 100_000_000 * every)
                if start.programs:
                    line = {"type": "samples", "counter": [number], "speed_mps": [speed_mps]}
                    start.programs[-1].print_lines(line)

        task = asyncio.create_task(sample())
        found.update(await fake.run_checks("master.toml"))
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    with capture_logs():
        run_virtual(main)
    return found["odometry"]


def test_sound_odometry(tmp_path: Path) -> None:
    """Device, rate and the speed at rest."""
    found = finding(tmp_path)
    assert found.outcome is Outcome.OK
    assert found.detail.startswith("Acme, ")
    assert "0 gaps, 0 untrusted samples, speed +0.000 m/s" in found.detail


def test_wheels_that_turn_at_rest(tmp_path: Path) -> None:
    """Or a robot that drives."""
    found = finding(tmp_path, speed_mps=0.1)
    assert found.outcome is Outcome.FAILED
    assert "speed +0.100 m/s" in found.detail
    assert "is the robot at rest?" in found.detail


def test_missing_samples(tmp_path: Path) -> None:
    """Every second one."""
    assert finding(tmp_path, every=2).outcome is Outcome.NOTE


def test_missing_program(tmp_path: Path) -> None:
    """With the key of the configuration."""
    found = finding(tmp_path, programs=())
    assert found.outcome is Outcome.FAILED
    assert "command under [odometry]" in found.detail
