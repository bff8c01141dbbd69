"""Programs that read an IMU as real processes, with simulated devices behind pseudo-terminals."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from harness.inertial.imu_devices import PtyDevice, SimulatedVectorNav, SimulatedXsens
from harness.missions.processes import TIMEOUT_S
from structlog.testing import capture_logs

from tsgt.clock import SystemClock, UnixTimeline
from tsgt.config import ImuConfig
from tsgt.imu import Imu

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from harness.inertial.imu_devices import Motion, SimulatedDevice

    from tsgt.model import ImuSamples

DEVICES: dict[str, Callable[[], SimulatedDevice]] = {"vectornav": SimulatedVectorNav, "xsens": SimulatedXsens}


def motion(number: int) -> Motion:
    """Return a rotation about z with a little noise."""
    return (1e-5 * (number % 7), 0.0, 0.25), (0.0, 0.0, 9.81)


def program(make: str, path: Path) -> list[str]:
    """Return the command of a program that ships."""
    return [sys.executable, "-m", "tsgt", "imu", make, str(path), "--rate-hz", "200"]


@pytest.mark.parametrize("make", DEVICES)
def test_device_becomes_records(make: str, tmp_path: Path) -> None:
    """Program, supervision and clock together: every sample once, with its duration and value."""
    device = DEVICES[make]()
    records: list[ImuSamples] = []
    events: list[Any] = []

    async def main() -> None:
        enough = asyncio.Event()

        def take(record: ImuSamples) -> None:
            records.append(record)
            if sum(len(each.stamp_ns) for each in records) >= 300:
                enough.set()

        clock = SystemClock()
        config = ImuConfig(
            command=tuple(program(make, tmp_path / "imu")),
            position_m=(0.0, 0.0, 0.0),
            orientation_xyzw=(0.0, 0.0, 0.0, 1.0),
            gravity_mps2=9.81,
        )
        imu = Imu(
            config,
            clock,
            UnixTimeline.fixed_now(clock),
            on_samples=take,
            on_event=lambda *event: events.append(event),
        )
        task = asyncio.create_task(imu.run())
        await asyncio.wait_for(enough.wait(), TIMEOUT_S)
        assert imu.status().problem == ""
        task.cancel()
        await asyncio.wait([task])

    with PtyDevice(device, tmp_path / "imu", motion), capture_logs():
        asyncio.run(main())
    assert sum(len(record.stamp_ns) for record in records) >= 300
    for record in records:
        assert all(abs(duration - 5_000_000) < 50_000 for duration in record.duration_ns)
        assert record.angular_rate_radps[0][2] == pytest.approx(0.25, rel=1e-3)
        assert record.specific_force_mps2[0] == pytest.approx((0.0, 0.0, 9.81), rel=1e-3)


def test_program_ends_with_its_input(tmp_path: Path) -> None:
    """It does not wait for its device."""
    with PtyDevice(SimulatedXsens(), tmp_path / "imu", motion):
        running = subprocess.Popen(
            program("xsens", tmp_path / "imu"), stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert running.stdin is not None
        assert running.stdout is not None
        hello = json.loads(running.stdout.readline())
        assert hello["model"] == "MTi-300-2A5G4"
        assert json.loads(running.stdout.readline())["type"] == "samples"
        running.stdin.close()
        assert running.wait(TIMEOUT_S) == 0
        running.stdout.close()


def test_lost_device_is_named(tmp_path: Path) -> None:
    """One line that says which port, and exit code 1."""
    device = SimulatedVectorNav()
    with PtyDevice(device, tmp_path / "imu", motion) as served:
        running = subprocess.Popen(
            program("vectornav", tmp_path / "imu"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.readline()
        served.silent = True
        assert running.wait(TIMEOUT_S) == 1
        assert b"imu at 115200 baud: no sample for 1 s" in running.stderr.read()
        running.communicate()


def test_missing_port_is_named(tmp_path: Path) -> None:
    """One line, exit code 1."""
    run = subprocess.run(
        program("vectornav", tmp_path / "imu"), stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    assert run.returncode == 1
    assert b"cannot be opened" in run.stderr
