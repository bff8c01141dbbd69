"""Faults of optics and power in missions: what the instrument does, and that everything is as before when they are over."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.missions.missions import run_linear_drive

from tsgt.simulation.checks import check_invariants
from tsgt.simulation.faults import Fault, FaultKind, inject_fault
from tsgt.simulation.instrument import Lock

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.simulation.mission import Mission

AT_S = 8.0


def _fault(kind: FaultKind, duration_s: float, *, station: int | None = 1, seed: int = 1) -> Fault:
    return Fault(AT_S, kind, station, duration_s, seed)


@pytest.mark.slow
def test_other_robot_takes_the_lock_for_a_while(tmp_path: Path) -> None:
    """With one of some seeds; afterwards the instrument finds its own prism by itself."""
    followed: list[int | None] = []

    async def meet(mission: Mission) -> None:
        meetings = [
            inject_fault(mission, _fault(FaultKind.SECOND_ROBOT, 4.0, seed=seed)) for seed in range(6)
        ]
        others = [asyncio.create_task(each) for each in meetings]
        await mission.sleep_until(AT_S + 2.0)
        followed.append(mission.instruments[1].telescope.prism)
        await asyncio.gather(*others)
        await mission.sleep_until(AT_S + 14.0)
        telescope = mission.instruments[1].telescope
        assert (telescope.lock, telescope.prism) == (Lock.IN, 1)

    result = run_linear_drive(tmp_path, meet, AT_S + 15.0)
    assert followed[0] not in (1, 2, 3)
    assert {violation.check for violation in check_invariants(result, replay=False)} <= {"liveness"}


@pytest.mark.slow
def test_station_that_follows_another_robot_is_called_back(tmp_path: Path) -> None:
    """It drives away from the line of sight and stays in view: the master sends a direction that ends the lock."""

    async def part(mission: Mission) -> None:
        await mission.sleep_until(AT_S)
        instrument = mission.instruments[1]
        begin = mission.world.prism_at(np.array([AT_S]), 0)[0]

        def track(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
            away_m = np.clip(1.5 * (times_s - AT_S), 0.0, 12.0)
            points: NDArray[np.float64] = begin + away_m[:, None] * np.array([-0.6, 0.8, 0.0])
            return points

        assert instrument.take_over(instrument.add_prism(track, AT_S, 99.0, 1))
        await mission.sleep_until(AT_S + 5.0)
        assert instrument.telescope.prism not in mission.prisms.values()
        await mission.sleep_until(AT_S + 16.0)
        assert (instrument.telescope.lock, instrument.telescope.prism) == (Lock.IN, 1)

    result = run_linear_drive(tmp_path, part, AT_S + 17.0)
    assert {violation.check for violation in check_invariants(result, replay=False)} <= {"liveness"}


@pytest.mark.slow
def test_battery_runs_down_and_is_changed(tmp_path: Path) -> None:
    """Fewer measurements, an event, then none; with the new battery there are as many as before."""

    async def fade(mission: Mission) -> None:
        await inject_fault(mission, _fault(FaultKind.BATTERY_FADING, 30.0))
        assert mission.instruments[1].battery_percent > 90
        assert mission.instruments[1].telescope.lock is Lock.IN

    result = run_linear_drive(tmp_path, fade, 62.0)
    by_time = Counter(each.true_ns // 6_000_000_000 for each in result.station_logs[1].reported_distances)
    assert by_time[1] >= 12  # from 6 s on
    assert 3 <= by_time[4] < by_time[2]  # from 24 s on, and from 12 s on
    assert by_time[6] == 0  # from 36 s on
    assert by_time[9] >= 14  # from 54 s on
    assert {violation.check for violation in check_invariants(result, replay=False)} <= {"liveness"}


@pytest.mark.slow
def test_weather_is_over_with_its_fault(tmp_path: Path) -> None:
    """Shimmer, rain and multipath at once: distances are missed, all are true to the instrument, and nothing remains."""

    async def storm(mission: Mission) -> None:
        storms = [
            inject_fault(mission, _fault(kind, 8.0, seed=4))
            for kind in (FaultKind.SHIMMER, FaultKind.RAIN, FaultKind.WINDOW)
        ]
        tasks = [asyncio.create_task(each) for each in storms]
        await mission.sleep_until(AT_S + 4.0)
        assert len(mission.instruments[2].disturbances) == 2
        await asyncio.gather(*tasks)
        assert not any(each.disturbances or each.blocked for each in mission.instruments.values())

    result = run_linear_drive(tmp_path, storm, AT_S + 12.0)
    assert {violation.check for violation in check_invariants(result, replay=False)} <= {"liveness"}
