"""How often an instrument that has lost its prism locks on another one that it cannot distinguish.

In the reference scenario the prism of station 1 is hidden repeatedly. Unless the telescope reacquires it, a fine adjustment in a
window of 5 degrees and a lock-in follow at once, where the telescope rests.

    python benchmarks/run.py other_prism [--narrow]
"""

from __future__ import annotations

import asyncio
import itertools
import sys
from collections import Counter

import numpy as np

from tsgt.config import InstrumentModelConfig, ScenarioConfig
from tsgt.simulation.instrument import Lock, SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.world import scenario_world

TIMES = 120
HIDDEN_S = (1.5, 3.0, 6.0)
PLAIN = InstrumentModelConfig(distinguishes_prisms=False)
SCENARIO = ScenarioConfig(
    stations=tuple(s.model_copy(update={"instrument": PLAIN}) for s in ScenarioConfig().stations)
)


async def hide(timeline: VirtualTimeline, hidden_s: float, *, narrow: bool) -> Counter[str]:
    """Hide the prism ``TIMES`` times for a duration; count which prism the telescope locks on."""
    world = scenario_world(SCENARIO, 2000.0, np.random.default_rng(1))
    station = SimulatedTotalStation(
        SCENARIO.stations[0], SCENARIO, world, timeline, np.random.default_rng(2), start_ns=timeline.now_ns()
    )
    port = await SimulatedLine(station, timeline, VirtualClock(0)).open(station.baud)
    numbers = itertools.count(1)

    async def succeeds(request: str) -> bool:
        rpc, _, parameters = request.partition(":")
        port.write(f"%R1Q,{rpc},{next(numbers)}:{parameters}\r\n".encode())
        return (await port.read()).data.endswith(b":0\r\n")

    await succeeds("9031:1")
    await succeeds(f"17037:{int(narrow)}")
    found: Counter[str] = Counter()
    while found.total() < TIMES:
        station.lock_manually(1)
        await asyncio.sleep(1.0)
        station.blocked = True
        await asyncio.sleep(hidden_s)
        station.blocked = False
        await asyncio.sleep(0.1)
        station.advance()
        if station.telescope.lock is not Lock.IN and not (
            await succeeds("9037:0.087,0.087,0") and await succeeds("9013:")
        ):
            found["none"] += 1
        else:
            found["right" if station.telescope.prism == 1 else "another"] += 1
    return found


def main() -> None:
    """Print a line for each duration."""
    for hidden_s in HIDDEN_S:
        timeline = VirtualTimeline()

        async def run(timeline: VirtualTimeline = timeline, hidden_s: float = hidden_s) -> Counter[str]:
            return await hide(timeline, hidden_s, narrow="--narrow" in sys.argv)

        found = run_virtual(run, timeline)
        print(
            f"hidden {hidden_s} s: "
            + ", ".join(f"{what} {found[what]}" for what in ("right", "another", "none"))
        )
