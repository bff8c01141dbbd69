"""Runs a mission on virtual time from start to end."""

from __future__ import annotations

import asyncio
import gc
import math
from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import SuperframeMasterConfig
from tsgt.simulation.checks import oversized_collections
from tsgt.simulation.faults import (
    FAULT_FREE_TAIL_S,
    IMU_FAULTS,
    ODOMETRY_FAULTS,
    FaultKind,
    draw_faults,
    imu_conditions,
    inject_fault,
    odometry_conditions,
    relock_instruments,
    rollovers,
)
from tsgt.simulation.kernel import VirtualTimeline, run_virtual
from tsgt.simulation.mission import DRAIN_S, Mission, MissionResult, Slew, has_odometry, listen_to_stream

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator
    from pathlib import Path

    from tsgt.config import ScenarioConfig
    from tsgt.simulation.options import SimulationOptions


REPORT_S = 25
"""Before the end: two status reports of a station, each once in 32 frames, have arrived by the end of the drain."""

MEMORY_CHECK_S = 60
"""Usual interval of the memory checks."""

GARBAGE_THRESHOLD = 10_000
"""New objects, less those that are gone, after which the garbage collector looks for cycles."""


def simulate(
    scenario: ScenarioConfig,
    options: SimulationOptions,
    *,
    folder: Path,
    progress: Callable[[float], None] = lambda now_s: None,  # noqa: ARG005 (default: not reported)
    script: Callable[[Mission], Coroutine[None, None, None]] | None = None,
    memory_check_s: int = MEMORY_CHECK_S,
) -> MissionResult:
    """Simulate a mission on virtual time in an empty folder; the same scenario, options and script give the same result.

    ``progress`` is called with the virtual time in s, every virtual second; ``script`` runs concurrently with the daemons;
    ``memory_check_s`` is the interval of the memory checks, each of which looks at all objects.

    Raises
    ------
    ExceptionGroup
        A daemon ended with an error.
    """
    timeline = VirtualTimeline()

    async def run() -> MissionResult:
        faults = draw_faults(
            options.faults,
            np.random.default_rng([options.seed, 0xFA]),  # independent of all other draws
            duration_s=options.duration_s,
            stations=[station.station for station in scenario.stations],
            imu=scenario.imu.model != "none",
            odometry=has_odometry(scenario),
        )
        mission = Mission(
            scenario,
            options,
            folder=folder,
            timeline=timeline,
            imu_conditions=imu_conditions(faults),
            odometry_conditions=odometry_conditions(faults),
            rollovers=(rolled := rollovers(faults)),
            master_sleeps=FaultKind.MASTER_SUSPEND in options.faults,
        )
        for station in scenario.stations:
            mission.start_station(station.station)
        mission.start_master()
        scenario_tasks = [
            *([script(mission)] if script is not None else []),
            listen_to_stream(mission),
            *(mission.apply_outage(outage) for outage in options.outages),
            *(mission.restart(restart.station, restart.at_s) for restart in options.restarts),
            *(
                inject_fault(mission, fault)
                for fault in faults
                if fault.kind not in IMU_FAULTS | ODOMETRY_FAULTS | {FaultKind.ROBOT_ROLLOVER}
            ),
            *([mission.run_interference()] if options.interference_rate_hz else []),
            *([relock_instruments(mission, options.duration_s - FAULT_FREE_TAIL_S)] if faults else []),
        ]
        fault_tasks = [asyncio.create_task(each) for each in scenario_tasks]
        oversized: set[str] = set()
        try:
            for second in range(1, math.ceil(options.duration_s) + 1):
                await mission.run_until(min(second, options.duration_s))
                progress(mission.now_s)
                if second == math.ceil(options.duration_s) - REPORT_S:
                    for station_log in mission.station_logs.values():
                        station_log.reportable_status = await station_log.client_status()
                if second % memory_check_s == 0:
                    oversized.update(oversized_collections())
            airtime_s = mission.air.airtime_ns / 1e9
            await mission.run_until(options.duration_s + DRAIN_S)
            if script is not None:
                await fault_tasks[0]
            for task in fault_tasks:
                if task.done():
                    task.result()
        finally:
            for task in fault_tasks:
                task.cancel()
            await asyncio.gather(*fault_tasks, return_exceptions=True)
            await mission.stop_all()
        return MissionResult(
            parameters=mission.first_parameters,
            world=mission.world,
            duration_s=options.duration_s,
            master_logs=[*mission.other_master_logs, *mission.master_logs],
            station_logs=mission.station_logs,
            airtime_s=airtime_s,
            superframe=isinstance(options.protocol, SuperframeMasterConfig),
            outages=options.outages,
            faults=Counter(fault.kind for fault in faults),
            slews=tuple(
                Slew(fault.station, fault.at_s, fault.at_s + fault.duration_s)
                for fault in faults
                if fault.kind == FaultKind.NTP_SLEW and fault.station is not None
            ),
            moves=tuple(mission.moves),
            rollovers=rolled,
            knocks_s=tuple(fault.at_s for fault in faults if fault.kind == FaultKind.IMU_KNOCK),
            faults_end_s=options.duration_s - FAULT_FREE_TAIL_S if faults else None,
            rate_hz={station.station: station.rate_hz for station in scenario.stations},
            oversized_collections=tuple(sorted(oversized)),
            imu=mission.imu,
            odometry=mission.odometry,
        )

    with _rare_garbage_collection():
        return run_virtual(run, timeline, isolated=True)


@contextmanager
def _rare_garbage_collection() -> Iterator[None]:
    """Let the garbage collector, and the memory checks, look only at what a mission creates, and less often."""
    thresholds = gc.get_threshold()
    gc.collect()
    gc.freeze()
    gc.set_threshold(GARBAGE_THRESHOLD, *thresholds[1:])
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()
