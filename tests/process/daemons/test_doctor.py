"""``tsgt doctor`` as a process, with a simulated instrument on a pseudo-terminal, in real time."""

from __future__ import annotations

import asyncio
import json
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
from harness.hardware.fake_machine import CLIENT

from tsgt.config import ScenarioConfig
from tsgt.simulation.instrument import PtyLine, SimulatedTotalStation
from tsgt.simulation.kernel import LoopTimeline
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from pathlib import Path


async def _examined(folder: Path) -> tuple[int | None, Any]:
    scenario, rng = ScenarioConfig(), np.random.default_rng(0)
    timeline = LoopTimeline(asyncio.get_running_loop())
    instrument = SimulatedTotalStation(
        scenario.stations[0],
        scenario,
        scenario_world(scenario, 60.0, rng),
        timeline,
        rng,
        start_ns=timeline.now_ns(),
    )
    async with PtyLine(instrument, folder / "instrument"):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "tsgt", "doctor", str(folder / "client.toml"), "--json", stdout=-1
        )
        out, _ = await process.communicate()
    return process.returncode, json.loads(out)["checks"]


def test_doctor_identifies_an_instrument_on_a_real_line(tmp_path: Path) -> None:
    """The findings name what this machine lacks: a radio, a key."""
    lines = ['port = "instrument"' if line.startswith("port =") else line for line in CLIENT.splitlines()]
    (tmp_path / "client.toml").write_text("\n".join(lines))
    code, checks = asyncio.run(_examined(tmp_path))
    assert code == 3
    for name in (
        "configuration",
        "serial_port",
        "serial_port_free",
        "instrument",
        "licence",
        "battery",
        "level",
    ):
        assert checks[name]["ok"] is True, checks[name]
    assert checks["key"]["ok"] is False
