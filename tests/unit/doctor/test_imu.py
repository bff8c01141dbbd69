"""Checks of ``tsgt doctor``: the robot's IMU."""

from __future__ import annotations

import asyncio
import re
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import pytest
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
"""


def findings(
    tmp_path: Path, *, installed: bool = True, running: bool = False, **changes: Any
) -> dict[str, Finding]:
    """Run the checks of a master whose IMU prints samples."""
    found: dict[str, Finding] = {}

    async def main() -> None:
        fake = FakeMachine(tmp_path)
        fake.change("master.toml", "[[stations]]\nstation = 1", CONFIG + "[[stations]]\nstation = 1")
        if installed:
            fake.programs.add("imu-program")
        if running:
            fake.served.add(tmp_path / "poses.sock")
        start = fake.start_imu = FakeStart(VirtualClock(NOW_NS), imu.HELLO)
        clock = fake.machine().clock

        async def sample() -> None:
            for number in range(0, 10**5, 10):
                await clock.sleep_until(clock.monotonic_ns() + 50_000_000)
                if start.programs:
                    start.programs[-1].print_lines(imu.samples(number, 10, **changes))

        task = asyncio.create_task(sample())
        found.update(await fake.run_checks("master.toml"))
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    with capture_logs():
        run_virtual(main)
    return found


def test_sound_imu(tmp_path: Path) -> None:
    """Rate, gravity and clock."""
    found = findings(tmp_path)["imu"]
    assert found.outcome is Outcome.OK
    rate = re.match(r"Fake IMU, ([\d.]+) Hz, 0 gaps", found.detail)
    assert rate is not None
    assert float(rate[1]) == pytest.approx(200, abs=5)
    assert "gravity 9.810 m/s^2" in found.detail
    assert re.search(r"0 saturated samples.*gyro bias \+0\.0\d \+0\.00 \+0\.57 deg/s", found.detail)


@pytest.mark.parametrize(
    ("force_mps2", "expected"), [(1.0, "another unit, or gravity was removed"), (9.4, "is the robot at rest")]
)
def test_wrong_gravity(tmp_path: Path, force_mps2: float, expected: str) -> None:
    """In g; an axis that is off by 4 percent."""
    found = findings(tmp_path, specific_force_mps2=[[0.0, 0.0, force_mps2]] * 10)["imu"]
    assert found.outcome is Outcome.FAILED
    assert expected in found.detail


def test_turning_robot_or_another_unit(tmp_path: Path) -> None:
    """A mean rate at rest that is no bias."""
    rates = [[1e-5 * number, 0.0, 0.15] for number in range(10)]
    found = findings(tmp_path, angular_rate_radps=rates)["imu"]
    assert found.outcome is Outcome.FAILED
    assert "is the robot at rest, the unit rad/s" in found.detail


def test_missing_program(tmp_path: Path) -> None:
    """With the key of the configuration."""
    found = findings(tmp_path, installed=False)["imu"]
    assert found.outcome is Outcome.FAILED
    assert "command under [imu]" in found.detail


def test_running_master_is_left_alone(tmp_path: Path) -> None:
    """It has the device open."""
    assert findings(tmp_path, running=True)["imu"].outcome is Outcome.SKIPPED


def test_master_without_imu(tmp_path: Path) -> None:
    """No finding."""

    async def main() -> None:
        assert "imu" not in await FakeMachine(tmp_path).run_checks("master.toml")

    run_virtual(main)
