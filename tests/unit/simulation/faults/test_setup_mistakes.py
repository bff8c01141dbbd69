"""Mistakes of operators: others are not disturbed, nothing is lost, and the log or an event names them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from harness.missions.missions import run_linear_drive
from structlog.testing import capture_logs

from tsgt.simulation.checks import check_invariants
from tsgt.simulation.mission import SetupMistake

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.mission import Mission, MissionResult


def _delivered(result: MissionResult) -> dict[int, int]:
    found = dict.fromkeys(result.station_logs, 0)
    for measurement in result.master_logs[-1].measurements:
        found[measurement.station] += 1
    return found


@pytest.mark.slow
def test_client_with_another_key_or_number(tmp_path: Path) -> None:
    """Each says what is wrong; after the correction the backlog of the wrong key arrives."""

    async def mistakes(mission: Mission) -> None:
        await mission.sleep_until(8.0)
        await asyncio.gather(
            mission.make_mistake(1, SetupMistake(key=b"another1" * 4), 44.0),
            mission.make_mistake(2, SetupMistake(station=9), 44.0),
        )

    with capture_logs() as logs:
        result = run_linear_drive(tmp_path, mistakes, 100.0)
    assert check_invariants(result, replay=False) == []
    delivered, read = (
        _delivered(result),
        {n: len(log.true_times_ns) for n, log in result.station_logs.items()},
    )
    assert delivered[1] >= read[1] - 3
    assert delivered[3] >= read[3] - 3
    named = {log["event"] for log in logs if log["log_level"] == "warning"}
    assert {"beacon_authentication_failed", "no_valid_beacon", "no_slot"} <= named


@pytest.mark.slow
def test_stations_stay_with_their_master(tmp_path: Path) -> None:
    """Another one with the same key gets nothing, and nothing is lost."""

    async def switch_on(mission: Mission) -> None:
        await mission.sleep_until(10.0)
        await mission.run_second_master(16.0)

    result = run_linear_drive(tmp_path, switch_on, 30.0)
    other, _ = result.master_logs
    assert not other.measurements
    assert all(
        count >= len(result.station_logs[n].true_times_ns) - 3 for n, count in _delivered(result).items()
    )
