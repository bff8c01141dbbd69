"""A whole mission in virtual time, from its start to its end: the same seed gives the same one."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config.radio import SuperframeMasterConfig
from tsgt.simulation.checks.memory_bounds import overgrown
from tsgt.simulation.faults.catalogue import CALM_S, draw_faults
from tsgt.simulation.faults.injection import act, see_to_instruments
from tsgt.simulation.kernel.event_loop import run_virtual
from tsgt.simulation.kernel.timeline import VirtualTimeline
from tsgt.simulation.mission.mission import DRAIN_S, START_UNIX_NS, Mission

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from pathlib import Path

    from tsgt.config import ScenarioConfig
    from tsgt.model import Parameters
    from tsgt.simulation.faults.catalogue import FaultKind
    from tsgt.simulation.mission.run_log import Session, StationWitness
    from tsgt.simulation.options import Options, Outage
    from tsgt.simulation.world import World


MEMORY_CHECK_S = 60
"""How often the memory of the daemons is looked at."""


@dataclass(frozen=True, slots=True)
class Run:
    """A mission that is over.

    Attributes
    ----------
    parameters
        What the master knew of the set-up: the exact truth.
    world
        The truth; its instants count from the start of the run.
    duration_s
        How long it measured, without the drain.
    sessions
        What the master sent out, one entry for each time that it was started.
    witnesses
        What was read from the instruments, by station number.
    airtime_s
        How long there was a packet on the air, of whomever.
    superframe
        Whether that protocol was spoken.
    outages
        When who did not hear whom.
    faults
        How many of each kind there were.
    calm_s
        When they were over, in s from the start; None: there were none.
    rate_hz
        How often each instrument measures, by station number.
    overgrown
        What was longer in memory than it should be.
    start_ns
        Unix time of the start on the master's clock, in ns.
    """

    parameters: Parameters
    world: World
    duration_s: float
    sessions: list[Session]
    witnesses: dict[int, StationWitness]
    airtime_s: float
    superframe: bool
    outages: tuple[Outage, ...] = ()
    faults: Counter[FaultKind] = field(default_factory=Counter)
    calm_s: float | None = None
    rate_hz: dict[int, float] = field(default_factory=dict)
    overgrown: tuple[str, ...] = ()
    start_ns: int = START_UNIX_NS

    @property
    def end_ns(self) -> int:
        """Unix time of the end on the master's clock, in ns; the drain comes after it."""
        return self.start_ns + round(self.duration_s * 1e9)


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
            *([mission.be_foreign()] if options.foreign_per_s else []),
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
