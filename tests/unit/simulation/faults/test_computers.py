"""Faults of computers in the field: slow disks, suspension, NTP."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from harness.missions.missions import run_linear_drive

from tsgt.simulation.checks import check_invariants
from tsgt.simulation.faults import FIELD_DAY_FAULTS, Fault, FaultKind, inject_fault, parse_faults

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.mission import Mission


def test_kinds_of_field_days_come_by_name_only() -> None:
    """What needs a mission of its own is not among all."""
    assert not FIELD_DAY_FAULTS & parse_faults("all")
    assert parse_faults("ntp-slew") == {FaultKind.NTP_SLEW}


@pytest.mark.slow
def test_measurements_around_a_suspension_have_their_true_times(tmp_path: Path) -> None:
    """With 8 s the offset of the clock jumps by 122 times 2^16 us and 4.6 ms, which beacons without the full time do not tell."""

    async def suspend(mission: Mission) -> None:
        await mission.sleep_until(12.0)
        await mission.suspend(2, 8.0)

    result = run_linear_drive(tmp_path, suspend, 32.0)
    assert check_invariants(result, replay=False) == []
    late = [m for m in result.master_logs[-1].measurements if m.station == 2 and m.received_ns is not None]
    assert sum((m.stamp_ns - result.start_ns) / 1e9 > 21.0 for m in late) > 15


@pytest.mark.slow
def test_measurements_wait_for_a_stalled_disk(tmp_path: Path) -> None:
    """No station's queue gets shorter while the master's disk stalls, and nothing is lost."""
    queued: list[int] = []

    async def stall(mission: Mission) -> None:
        await mission.sleep_until(10.0)
        mission.computers["master"].disk.stall(10_000_000_000, 16_000_000_000)
        await mission.sleep_until(15.9)
        for station in (1, 2, 3):
            await mission.stop(f"station{station}")
            queued.append(mission.station_logs[station].statuses[-1].queued or 0)
            mission.start_station(station)

    result = run_linear_drive(tmp_path, stall, 24.0)
    assert check_invariants(result) == []
    assert min(queued) >= 12


@pytest.mark.slow
def test_suspended_computer_is_neither_rebooted_nor_killed(tmp_path: Path) -> None:
    """Its programs end only after it has been resumed: the mission would wait for them with the time at a stop."""

    async def suspend(mission: Mission) -> None:
        await mission.sleep_until(4.0)
        async with asyncio.TaskGroup() as group:
            group.create_task(mission.suspend(2, 4.0))
            group.create_task(mission.reboot(2, 5.0, 1.0))
            await mission.sleep_until(6.0)
            await mission.crash("station2", down_s=1.0)

    result = run_linear_drive(tmp_path, suspend, 10.0)
    assert len(result.station_logs[2].journals) == 2  # the client restarts when it is resumed


@pytest.mark.parametrize("disk_full", [False, True])
@pytest.mark.slow
def test_write_that_is_torn_as_a_computer_resumes(tmp_path: Path, *, disk_full: bool) -> None:
    """The client that began anew after the suspension died of it, and is restarted; time goes on meanwhile.

    If the disk was full before the suspension, what was measured then is lost.
    """

    async def suspend(mission: Mission) -> None:
        torn = Fault(4.0, FaultKind.TORN_WRITE, 2, 1.0, 1)
        async with asyncio.TaskGroup() as group:
            await mission.sleep_until(2.0)
            if disk_full:
                group.create_task(inject_fault(mission, Fault(2.0, FaultKind.DISK_FULL, 2, 4.0, 1)))
            await mission.sleep_until(4.0)
            group.create_task(mission.suspend(2, 14.0))
            group.create_task(inject_fault(mission, torn))

    result = run_linear_drive(tmp_path, suspend, 26.0)
    assert check_invariants(result, replay=False) == []
    assert (
        sum(
            m.station == 2 and m.stamp_ns - result.start_ns > 22e9
            for m in result.master_logs[-1].measurements
        )
        > 3
    )


@pytest.mark.slow
def test_restart_waits_for_a_computer_that_is_switched_off(tmp_path: Path) -> None:
    """Two clients on one computer would serve the same socket."""

    async def restart(mission: Mission) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(mission.reboot(2, 4.0, 4.0))
            group.create_task(mission.restart(2, 5.0))

    result = run_linear_drive(tmp_path, restart, 16.0)
    assert len(result.station_logs[2].journals) == 3
