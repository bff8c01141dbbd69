"""Relay and page in a mission: they pass the stream on as it is, also when the master is killed."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from harness.missions.missions import run_linear_drive
from harness.missions.passed_on import PassedOn

from tsgt.simulation.mission import MASTER

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.mission import Mission


@pytest.mark.slow
def test_relay_and_page_get_the_stream_of_both_masters(tmp_path: Path) -> None:
    """Two connections each; a changed line is told."""
    passed_on = PassedOn()

    async def crash(mission: Mission) -> None:
        await mission.sleep_until(7.0)
        await mission.crash(MASTER, down_s=1.0)

    async def script(mission: Mission) -> None:
        await asyncio.gather(passed_on.follow(mission, tmp_path, 15.0), crash(mission))

    result = run_linear_drive(tmp_path / "m", script, 15.0)
    assert list(passed_on.failures(result)) == []
    assert len(passed_on.relayed.connections) == 2
    assert len(passed_on.page.lines.connections) == 2
    assert passed_on.page.looks > 5
    passed_on.relayed.connections[1][-2] += 1
    assert len(list(passed_on.failures(result))) == 1
