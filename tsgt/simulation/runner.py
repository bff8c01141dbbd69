"""A whole mission in virtual time, from its start to its end: the same seed gives the same one."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import SuperframeMasterConfig
from tsgt.simulation.checks import overgrown
from tsgt.simulation.faults import CALM_S, act, draw_faults, see_to_instruments
from tsgt.simulation.kernel import VirtualTimeline, run_virtual
from tsgt.simulation.mission import DRAIN_S, Mission, Run

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from pathlib import Path

    from tsgt.config import ScenarioConfig
    from tsgt.simulation.options import Options


MEMORY_CHECK_S = 60
"""How often the memory of the daemons is looked at."""


def simulate(
    scenario: ScenarioConfig,
    options: Options,
    *,
    folder: Path,
    progress: Callable[[float], None] = lambda now_s: None,  # noqa: ARG005 (nobody looks)
    script: Callable[[Mission], Coroutine[None, None, None]] | None = None,
) -> Run:
    """Run a mission on virtual time; the same scenario, options and script give the same run.

    Parameters
    ----------
    scenario, options
        What happens.
    folder
        An empty folder for recordings, journals and sockets.
    progress
        Told of the virtual time in s, each virtual second.
    script
        Runs beside the daemons: kills and starts them, steps clocks.

    Raises
    ------
    ExceptionGroup
        A daemon has ended with an error.
    """
    timeline = VirtualTimeline()

    async def run() -> Run:
        mission = Mission(scenario, options, folder=folder, timeline=timeline)
        for station in scenario.stations:
            mission.start_station(station.station)
        mission.start_master()
        faults = draw_faults(
            options.faults,
            np.random.default_rng([options.seed, 0xFA]),  # whatever else is drawn
            duration_s=options.duration_s,
            stations=list(mission.witnesses),
        )
        acts = [
            *([script(mission)] if script is not None else []),
            *(mission.interrupt(outage) for outage in options.outages),
            *(mission.restart(restart.station, restart.at_s) for restart in options.restarts),
            *(act(mission, fault) for fault in faults),
            *([mission.be_foreign()] if options.interference_rate_hz else []),
            *([see_to_instruments(mission, options.duration_s - CALM_S)] if faults else []),
        ]
        acting = [asyncio.create_task(each) for each in acts]
        grown: set[str] = set()
        try:
            for second in range(1, math.ceil(options.duration_s) + 1):
                await mission.until(min(second, options.duration_s))
                progress(mission.now_s)
                if second % MEMORY_CHECK_S == 0:
                    grown.update(overgrown())
            airtime_s = mission.air.airtime_ns / 1e9
            await mission.until(options.duration_s + DRAIN_S)
            if script is not None:
                await acting[0]
            for acted in acting:
                if acted.done():
                    acted.result()
        finally:
            for acted in acting:
                acted.cancel()
            await asyncio.gather(*acting, return_exceptions=True)
            await mission.end()
        return Run(
            parameters=mission.parameters,
            world=mission.world,
            duration_s=options.duration_s,
            sessions=mission.sessions,
            witnesses=mission.witnesses,
            airtime_s=airtime_s,
            superframe=isinstance(options.protocol, SuperframeMasterConfig),
            outages=options.outages,
            faults=Counter(fault.kind for fault in faults),
            calm_s=options.duration_s - CALM_S if faults else None,
            rate_hz={station.station: station.rate_hz for station in scenario.stations},
            overgrown=tuple(sorted(grown)),
        )

    return run_virtual(run, timeline, alone=True)
