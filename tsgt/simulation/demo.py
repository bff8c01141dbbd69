"""The demonstration: a scenario in real time, its measurements through the live pipeline."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import scenario_parameters
from tsgt.master.feed import Feed
from tsgt.master.monitor import Monitor
from tsgt.master.stream_records import PoseRecord
from tsgt.simulation.stations import simulated_measurements
from tsgt.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.config import ScenarioConfig
    from tsgt.master.stream_records import StatusRecord
    from tsgt.model import Measurement, Parameters, PolarMeasurement

STATUS_PERIOD_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Run:
    """A scenario played from start to end: the truth, and what the master gets of it.

    Attributes
    ----------
    world
        The truth; its instants count from the start of the run.
    parameters
        What the master knows of the set-up.
    measurements
        All of them, in the order of arrival.
    start_ns, end_ns
        Unix time in ns.
    """

    world: World
    parameters: Parameters
    measurements: list[PolarMeasurement]
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class Step:
    """What one instant of a live run brings.

    Attributes
    ----------
    now_ns
        The instant, Unix time in ns.
    records
        For the stream and the recording, in this order.
    poses
        Those among the records.
    status
        That among the records, if there is one; the last step has one.
    """

    now_ns: int
    records: list[Measurement | PoseRecord | StatusRecord]
    poses: list[PoseRecord]
    status: StatusRecord | None


def play(scenario: ScenarioConfig, *, duration_s: float, seed: int, start_ns: int) -> Run:
    """Compute a whole run ahead of time; the same seed gives the same run, moved to the start given."""
    world_generator, station_generator = np.random.default_rng(seed).spawn(2)
    prisms_m = np.array([prism.position_m for prism in scenario.prisms])
    world = World(scenario.motion, prisms_m, duration_s, world_generator)
    return Run(
        world=world,
        parameters=scenario_parameters(scenario),
        measurements=simulated_measurements(scenario, world, station_generator, start_ns=start_ns),
        start_ns=start_ns,
        end_ns=start_ns + round(duration_s * 1e9),
    )


async def live(run: Run, clock: Clock, timeline: UnixTimeline) -> AsyncIterator[Step]:
    """Feed a run to the live pipeline at its own pace.

    Every record belongs to the instant that the run has planned for it, however late the machine is; so the records
    depend on the run alone, and a replay of the recording gives them again. When cancelled, it closes the run with
    a last step and ends.

    Parameters
    ----------
    run
        What is to arrive, and when.
    clock, timeline
        Set the pace.
    """
    feed = Feed(run.parameters)
    monitor = Monitor(station.station for station in run.parameters.stations)
    arrivals = iter(run.measurements)
    arrival = next(arrivals, None)
    status_ns = run.start_ns + STATUS_PERIOD_NS
    finished = False
    while not finished:
        due_ns = (arrival.received_ns if arrival else None, feed.next_deadline_ns(), status_ns, run.end_ns)
        now_ns = min(instant for instant in due_ns if instant is not None)
        try:
            await clock.sleep_until(timeline.monotonic_ns(now_ns))
            finished = now_ns >= run.end_ns
        except asyncio.CancelledError:
            now_ns = min(now_ns, timeline.unix_ns(clock.monotonic_ns()))
            finished = True

        records: list[Measurement | PoseRecord | StatusRecord] = []
        while arrival is not None and arrival.received_ns <= now_ns:
            records += feed.measurement(arrival)
            monitor.measurement(arrival)
            arrival = next(arrivals, None)
        records += feed.advance(now_ns)
        poses = [record for record in records if isinstance(record, PoseRecord)]
        for pose in poses:
            monitor.pose(valid=pose.valid)
        status = None
        if finished or now_ns >= status_ns:
            status = monitor.status(now_ns)
            status_ns = now_ns + STATUS_PERIOD_NS
            records.append(status)
        yield Step(now_ns, records, poses, status)
