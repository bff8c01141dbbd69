"""Faults drawn from a seed: reproducible, over before the end, and without violated invariants."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.missions.missions import QUICK, SUPERFRAME, run_mission

from tsgt.config import ScenarioConfig
from tsgt.errors import ConfigError
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.faults import (
    FAULT_FREE_START_S,
    FAULT_FREE_TAIL_S,
    FIELD_DAY_FAULTS,
    IMU_FAULTS,
    ODOMETRY_FAULTS,
    FaultKind,
    draw_faults,
    imu_conditions,
    odometry_conditions,
    parse_faults,
)
from tsgt.simulation.imu import Knock

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.mission import Mission
    from tsgt.simulation.mission.computer import Computer

DURATION_S = 60.0


def test_same_seed_gives_the_same_faults() -> None:
    """Another seed gives others."""
    one, same, other = (
        draw_faults(FaultKind, np.random.default_rng(seed), duration_s=3600.0, stations=[1, 2, 3])
        for seed in (1, 1, 2)
    )
    assert one == same != other
    assert list(one) == sorted(one)


def test_faults_end_before_the_fault_free_tail() -> None:
    """The start is free of faults as well."""
    faults = draw_faults(FaultKind, np.random.default_rng(0), duration_s=3600.0, stations=[1, 2, 3])
    assert min(fault.at_s for fault in faults) >= FAULT_FREE_START_S
    assert max(fault.at_s + fault.duration_s for fault in faults) <= 3600.0 - FAULT_FREE_TAIL_S + 1e-9


def test_single_kind_is_never_omitted() -> None:
    """A kind that is requested alone always occurs."""
    for kind in FaultKind:
        faults = draw_faults(
            [kind],
            np.random.default_rng(0),
            duration_s=36_000.0,
            stations=[1, 2, 3],
            imu=True,
            odometry=True,
        )
        assert {fault.kind for fault in faults} == {kind}


def test_faults_of_the_imu_leave_the_others_as_they_are() -> None:
    """Without an IMU there are none; with one, all others stay the same, bit for bit."""
    without, with_imu = (
        draw_faults(FaultKind, np.random.default_rng(1), duration_s=3600.0, stations=[1, 2, 3], imu=imu)
        for imu in (False, True)
    )
    assert without == tuple(fault for fault in with_imu if fault.kind not in IMU_FAULTS)
    assert IMU_FAULTS.isdisjoint(fault.kind for fault in without)
    assert len(with_imu) > len(without)


def test_faults_of_the_wheels_leave_the_others_as_they_are() -> None:
    """Without odometry there are none; with it, all others stay the same, bit for bit."""
    without, with_wheels = (
        draw_faults(
            FaultKind,
            np.random.default_rng(1),
            duration_s=3600.0,
            stations=[1, 2, 3],
            imu=True,
            odometry=odometry,
        )
        for odometry in (False, True)
    )
    assert without == tuple(fault for fault in with_wheels if fault.kind not in ODOMETRY_FAULTS)
    assert len(with_wheels) > len(without)
    conditions = odometry_conditions(with_wheels)
    wheels = [fault for fault in with_wheels if fault.kind in ODOMETRY_FAULTS]
    assert [condition.at_s for condition in conditions] == [fault.at_s for fault in wheels]


def test_faults_of_the_imu_become_conditions() -> None:
    """Each has the time and duration of its fault, and a knock its size."""
    faults = draw_faults(IMU_FAULTS, np.random.default_rng(3), duration_s=36_000.0, stations=[], imu=True)
    conditions = imu_conditions(faults)
    assert [condition.at_s for condition in conditions] == [fault.at_s for fault in faults]
    for condition, fault in zip(conditions, faults, strict=True):
        assert getattr(condition, "duration_s", 0.0) == fault.duration_s
        if isinstance(condition, Knock):
            assert np.degrees(np.linalg.norm(condition.rotation_rad)) == pytest.approx(1.0)
            assert np.linalg.norm(condition.displacement_m) == pytest.approx(0.020)
    assert len({type(condition) for condition in conditions}) >= 5


def test_kinds_are_parsed() -> None:
    """None, all, or names; an unknown name is rejected."""
    assert parse_faults("none") == frozenset()
    assert parse_faults("all") == frozenset(FaultKind) - FIELD_DAY_FAULTS
    assert parse_faults("loss,disk-full") == {FaultKind.LOSS, FaultKind.DISK_FULL}
    with pytest.raises(ConfigError, match="there is no such fault"):
        parse_faults("loss,gremlins")


@pytest.mark.slow
def test_daemon_killed_during_shutdown_counts_as_stopped(tmp_path: Path) -> None:
    """Its final write is torn, in its own task or another; any other error during shutdown is raised."""

    async def write_last(computer: Computer, fails: type[Exception] | None) -> None:
        write = computer.new_writer().write
        assert computer.disk_writer is not None
        computer.disk_writer.tear_next_write(0.0, lambda: None)
        try:
            await asyncio.Event().wait()
        finally:
            if fails is not None:
                raise fails
            write(-1, memoryview(b"line"))

    async def write_in_task(computer: Computer) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(write_last(computer, None))

    async def end_programs(run: Mission) -> None:
        await run.stop("station1")
        computer = run.computers["station1"]
        for program in (write_last(computer, None), write_in_task(computer)):
            computer.start(program)
            await run.sleep_until(run.now_s + 0.1)
            await computer.stop()
        computer.start(write_last(computer, OSError))
        await run.sleep_until(run.now_s + 0.1)
        with pytest.raises(OSError):  # noqa: PT011 (it has no text)
            await computer.stop()

    run_mission(tmp_path, duration_s=1.0, script=end_programs)


@pytest.mark.slow
def test_crash_window_ends_at_the_kill(tmp_path: Path) -> None:
    """Later activity of the killed client's tasks does not extend the window."""
    killed_s = []

    async def crash(run: Mission) -> None:
        await run.sleep_until(10.2)
        run.instruments[1].blocked = True  # while it searches, it answers late
        await run.sleep_until(13.2)
        killed_s.append(run.now_s)
        await run.crash("station1", down_s=1.0)

    ((_, crash_windows_ns),) = (
        run_mission(tmp_path, duration_s=15.0, script=crash).station_logs[1].crash_windows_ns
    )
    assert crash_windows_ns / 1e9 == pytest.approx(killed_s[0], abs=1e-6)


@pytest.mark.parametrize(
    ("protocol", "estimator", "seed"),
    [
        (QUICK, "linear", 12),
        (SUPERFRAME, "continuous", 13),
    ],
    ids=lambda value: getattr(value, "kind", str(value)),
)
@pytest.mark.slow
def test_invariants_hold_under_all_faults(tmp_path: Path, protocol: Any, estimator: str, seed: int) -> None:
    """With faults of all kinds no invariant is violated."""
    plain = ScenarioConfig()
    pipeline = plain.pipeline.model_copy(update={"estimator": estimator})
    scenario = plain.model_copy(update={"pipeline": pipeline})
    run = run_mission(
        tmp_path,
        scenario,
        protocol=protocol,
        duration_s=DURATION_S,
        seed=seed,
        faults=frozenset(FaultKind),
    )
    assert sum(run.faults.values()) > 3
    assert check_invariants(run) == []
