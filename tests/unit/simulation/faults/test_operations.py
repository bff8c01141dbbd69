"""Edited configurations, a master that sleeps, and a disk that is full for long."""

from __future__ import annotations

import asyncio
import errno
from functools import partial
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np
import pytest
from harness.missions.missions import run_linear_drive

from tsgt.recording import load_recording
from tsgt.recording.recorder import Recorder
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.checks.setup_lines import parameter_failures
from tsgt.simulation.faults import FaultKind, draw_faults
from tsgt.simulation.mission import MASTER, MasterEdit, SetupMistake

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.mission import Mission, MissionResult


def _missing(result: MissionResult) -> dict[int, int]:
    """Return how many readings of each station no master has published."""
    missing = {number: len(log.true_times_ns) for number, log in result.station_logs.items()}
    for master_log in result.master_logs:
        for measurement in master_log.measurements:
            missing[measurement.station] -= 1
    return missing


async def _fill_disk(mission: Mission, from_s: float, until_s: float) -> None:
    """Let the master's disk be full between two true times from the start."""
    disk = mission.computers[MASTER].disk
    await mission.sleep_until(from_s)
    disk.fail_writes(errno.ENOSPC, round(from_s * 1e9), round(until_s * 1e9))
    await mission.sleep_until(until_s)
    disk.write_error = None


@pytest.mark.slow
def test_edited_pose_rate_is_in_force_from_the_restart_on(tmp_path: Path) -> None:
    """The recording states it, the poses follow it, and the recording after it is taken back has the old one."""

    async def edit(mission: Mission) -> None:
        await mission.sleep_until(8.0)
        await mission.edit_master(MasterEdit(pipeline={"rate_hz": 5.0}), 20.0)

    result = run_linear_drive(tmp_path, edit, 32.0)
    assert check_invariants(result) == []
    recordings = [load_recording(path) for log in result.master_logs if (path := log.recording())]
    assert [each.parameters.pipeline.period_ns for each in recordings] == [
        50_000_000,
        200_000_000,
        50_000_000,
    ]
    assert parameter_failures_of(result) == [0, 1, 0]
    assert max(_missing(result).values()) <= 3


def parameter_failures_of(result: MissionResult) -> list[int]:
    """Return by master how many recordings do not have the mission's parameters."""
    return [len(list(parameter_failures(log, result.parameters))) for log in result.master_logs]


@pytest.mark.slow
def test_station_missing_in_the_master_and_wrong_channel_lose_nothing(tmp_path: Path) -> None:
    """Backlogs arrive after the correction: of a station that the list lacked, and of all that heard no beacon."""

    async def edit(mission: Mission) -> None:
        await mission.sleep_until(6.0)
        await mission.edit_master(MasterEdit(without_station=2), 14.0)
        await mission.sleep_until(22.0)
        await mission.edit_master(MasterEdit(frequency_mhz=907.4), 32.0)

    result = run_linear_drive(tmp_path, edit, 50.0)
    assert check_invariants(result, replay=False) == []
    assert [len({m.station for m in log.measurements}) for log in result.master_logs[1::2]] == [2, 0]
    assert max(_missing(result).values()) <= 3


@pytest.mark.slow
def test_client_on_another_channel_or_prism_loses_nothing(tmp_path: Path) -> None:
    """The backlog of the wrong channel arrives; a client with another prism is told the right one by the master."""

    async def edit(mission: Mission) -> None:
        await mission.sleep_until(6.0)
        await mission.make_mistake(1, SetupMistake(frequency_mhz=907.4), 16.0)
        await mission.make_mistake(3, SetupMistake(prism=1), 28.0)

    result = run_linear_drive(tmp_path, edit, 50.0)
    assert check_invariants(result, replay=False) == []
    assert max(_missing(result).values()) <= 3


@pytest.mark.slow
def test_mistake_that_begins_late_ends_in_time(tmp_path: Path) -> None:
    """A suspended computer delays the restart that brings it: it must not last beyond the faults for that."""
    ends_s: list[float] = []

    async def edit(mission: Mission) -> None:
        await mission.sleep_until(4.0)
        suspension = asyncio.create_task(mission.suspend(1, 8.0))
        await asyncio.sleep(0.1)
        await mission.make_mistake(1, SetupMistake(frequency_mhz=907.4), 10.0)
        ends_s.append(mission.now_s)
        await suspension

    run_linear_drive(tmp_path, edit, 20.0)
    assert 12.0 < ends_s[0] < 18.0  # two restarts after the suspension


@pytest.mark.slow
def test_suspended_master_restarts(tmp_path: Path) -> None:
    """No pose and no time of its old timeline is published after it resumes; stations deliver what they measured meanwhile."""

    async def suspend(mission: Mission) -> None:
        await mission.sleep_until(10.0)
        await mission.suspend_master(8.0)

    # The kind gives the master a clock that can stand still; this seed draws none.
    result = run_linear_drive(tmp_path, suspend, 44.0, faults=frozenset({FaultKind.MASTER_SUSPEND}))
    assert not result.faults
    before, after = result.master_logs
    assert check_invariants(result) == []
    assert [event.event for event in after.events][:1] == ["computer_resumed"]
    assert max(_missing(result).values()) <= 3
    assert before.statuses[-1].stamp_ns < after.statuses[0].stamp_ns - 7_000_000_000
    assert after.valid_poses().stamp_ns.size > 300


@pytest.mark.slow
def test_master_that_resumes_on_a_full_disk_leaves_a_recording_that_ends_early(tmp_path: Path) -> None:
    """What it published before it was suspended waits for the disk, and is lost with its run; measurements are delivered again."""

    async def suspend(mission: Mission) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(_fill_disk(mission, 9.5, 24.0))
            await mission.sleep_until(10.0)
            await mission.suspend_master(8.0)

    result = run_linear_drive(tmp_path, suspend, 44.0, faults=frozenset({FaultKind.MASTER_SUSPEND}))
    before, after = result.master_logs
    path = before.recording()
    assert path is not None
    assert len(load_recording(path).measurements) < len(before.measurements)
    assert check_invariants(result) == []
    assert after.valid_poses().stamp_ns.size > 300


def _violated(result: MissionResult) -> list[str]:
    """Without the numbers of outstanding measurements, which include those that wait for the disk."""
    return [each.check for each in check_invariants(result) if "outstanding" not in each.detail]


@pytest.mark.slow
def test_disk_that_is_full_for_longer_than_lines_can_wait(tmp_path: Path) -> None:
    """Lines are lost, poses among them; measurements are delivered again, so that each is in the recording once."""
    kept = 150
    with patch("tsgt.master.daemon.Recorder", partial(Recorder, max_pending_lines=kept)):
        result = run_linear_drive(tmp_path, lambda mission: _fill_disk(mission, 6.0, 20.0), 36.0)
    (log,) = result.master_logs
    status, path = log.statuses[-1].recording, log.recording()
    assert status is not None
    assert path is not None
    assert status.lost_lines > 100
    with patch("tsgt.simulation.checks.recorded_lines.MAX_PENDING_LINES", kept):
        assert _violated(result) == []
    assert _violated(result) == ["recording"]  # only 150 of 100,000 were waiting
    recorded = [(m.station, m.sequence) for m in load_recording(path).measurements]
    assert len(recorded) == len(set(recorded))
    read = sum(len(station.true_times_ns) for station in result.station_logs.values())
    assert len(recorded) >= read - 9


def test_long_faults_come_in_missions_of_hours() -> None:
    """A mission of ten hours has disks that are full for an hour."""
    rng = np.random.default_rng(1)
    drawn = draw_faults([FaultKind.LONG_DISK_FULL], rng, duration_s=36_000.0, stations=(1, 2, 3))
    assert max(fault.duration_s for fault in drawn) == pytest.approx(3600.0)
