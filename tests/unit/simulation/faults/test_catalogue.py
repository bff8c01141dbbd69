"""Faults that are drawn from a seed: the same ones each time, over in time, and none of them does what must never be."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.missions import QUICK, SUPERFRAME, mission

from tsgt.config import ScenarioConfig
from tsgt.errors import ConfigError
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.faults import FAULT_FREE_START_S, FAULT_FREE_TAIL_S, FaultKind, draw_faults, parse_faults

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.mission import Mission
    from tsgt.simulation.mission.computer import Computer

DURATION_S = 60.0


def test_a_seed_gives_the_same_faults() -> None:
    """And another one others."""
    one, same, other = (
        draw_faults(FaultKind, np.random.default_rng(seed), duration_s=3600.0, stations=[1, 2, 3])
        for seed in (1, 1, 2)
    )
    assert one == same != other
    assert list(one) == sorted(one)


def test_all_are_over_before_the_end() -> None:
    """What they break has to work again by then."""
    faults = draw_faults(FaultKind, np.random.default_rng(0), duration_s=3600.0, stations=[1, 2, 3])
    assert min(fault.at_s for fault in faults) >= FAULT_FREE_START_S
    assert max(fault.at_s + fault.duration_s for fault in faults) <= 3600.0 - FAULT_FREE_TAIL_S + 1e-9


def test_each_kind_comes_alone() -> None:
    """One that is asked for by its name is never left out."""
    for kind in FaultKind:
        faults = draw_faults([kind], np.random.default_rng(0), duration_s=36_000.0, stations=[1, 2, 3])
        assert {fault.kind for fault in faults} == {kind}


def test_names_are_read() -> None:
    """None, all, or some."""
    assert parse_faults("none") == frozenset()
    assert parse_faults("all") == frozenset(FaultKind)
    assert parse_faults("loss,disk-full") == {FaultKind.LOSS, FaultKind.DISK_FULL}
    with pytest.raises(ConfigError, match="there is no such fault"):
        parse_faults("loss,gremlins")


def test_a_program_that_is_killed_while_it_ends_has_ended(tmp_path: Path) -> None:
    """What it writes last tears, alone or in a task of its own; a program that fails while it ends is told of."""

    async def write_last(computer: Computer, fails: type[Exception] | None) -> None:
        write = computer.new_writer()
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

    mission(tmp_path, duration_s=1.0, script=end_programs)


def test_a_crash_is_when_it_happens(tmp_path: Path) -> None:
    """What a client has just read need not be on its disk, however long its last breath takes."""
    killed_s = []

    async def crash(run: Mission) -> None:
        await run.sleep_until(10.2)
        run.instruments[1].blocked = True  # while it searches, it answers late
        await run.sleep_until(13.2)
        killed_s.append(run.now_s)
        await run.crash("station1", down_s=1.0)

    ((_, crash_windows_ns),) = (
        mission(tmp_path, duration_s=15.0, script=crash).station_logs[1].crash_windows_ns
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
def test_nothing_that_must_never_be(tmp_path: Path, protocol: Any, estimator: str, seed: int) -> None:
    """With faults of all kinds: nothing lost, altered, twice, mistimed, or stuck, and no pose called valid that is not."""
    plain = ScenarioConfig()
    pipeline = plain.pipeline.model_copy(update={"estimator": estimator})
    scenario = plain.model_copy(update={"pipeline": pipeline})
    run = mission(
        tmp_path,
        scenario,
        protocol=protocol,
        duration_s=DURATION_S,
        seed=seed,
        faults=frozenset(FaultKind),
    )
    assert sum(run.faults.values()) > 3
    assert check_invariants(run) == []
