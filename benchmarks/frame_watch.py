"""How small a movement of a tripod the live alarm finds, and whether it cries without one.

    python benchmarks/run.py frame_watch

The figures stand in docs/how-to/calibrate.md, section "The live alarm".
"""

from __future__ import annotations

import dataclasses
import logging
import math
import statistics
from typing import TYPE_CHECKING

import numpy as np
import structlog
from measuring import simulated

from tsgt.config import ClassicMasterConfig, FrameWatchConfig, ScenarioConfig
from tsgt.estimation import LiveEstimator
from tsgt.geometry import exp_so3, transform_from
from tsgt.master.layout_monitor import LayoutMonitor
from tsgt.recording import PoseRecord, load_recording
from tsgt.simulation.options import SimulationOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry import FloatArray
    from tsgt.model import Measurement, Parameters
    from tsgt.recording import EventRecord
    from tsgt.simulation.options import StationSoftware

    Drive = tuple[Parameters, Sequence[Measurement]]

DURATION_S = 600.0
SEEDS = (1, 2, 3)


def drive(seed: int, node: StationSoftware) -> Drive:
    """Run the reference scenario with the paper's protocol at its modem settings; what the master received."""
    classic = ClassicMasterConfig(kind="classic")
    options = SimulationOptions(duration_s=DURATION_S, seed=seed, station_software=node, protocol=classic)
    with simulated(ScenarioConfig(), options) as result:
        path = result.master_logs[-1].recording()
        assert path is not None  # noqa: S101 (the master has recorded)
        return result.parameters, load_recording(path).measurements


def with_moved(parameters: Parameters, station: int, movement: FloatArray) -> Parameters:
    """Put a station's frame in force off by a movement: turned about its own place, then shifted."""
    stations = []
    for each in parameters.stations:
        if each.station != station:
            stations.append(each)
            continue
        T = np.array(each.T_station1_station)
        T[:3, :3] = movement[:3, :3] @ T[:3, :3]
        T[:3, 3] += movement[:3, 3]
        a, b, c, d = ((float(w), float(x), float(y), float(z)) for w, x, y, z in T)
        stations.append(dataclasses.replace(each, T_station1_station=(a, b, c, d)))
    return dataclasses.replace(parameters, stations=tuple(stations))


def alarms(parameters: Parameters, measurements: Sequence[Measurement]) -> list[EventRecord]:
    """Run the live pipeline and its watch."""
    feed, watch = LiveEstimator(parameters), LayoutMonitor(FrameWatchConfig(), parameters.pipeline.period_ns)
    records = (record for measurement in measurements for record in feed.measurement(measurement))
    return [
        event
        for record in records
        if isinstance(record, PoseRecord)
        for event in watch.pose(record, record.stamp_ns)
        if event.event == "layout_residual_high"
    ]


def report(what: str, drives: list[Drive], moves: list[FloatArray]) -> None:
    """Run each movement with the stations and drives in turn, and print what was found and when."""
    found, right, seconds = 0, 0, []
    for number, movement in enumerate(moves):
        station = number % 3 + 1
        parameters, measurements = drives[number % len(drives)]
        events = alarms(with_moved(parameters, station, movement), measurements)
        if events:
            found += 1
            right += events[0].station == station
            seconds.append((events[0].stamp_ns - measurements[0].stamp_ns) / 1e9)
    when = f"after {statistics.median(seconds):.0f} s, at most {max(seconds):.0f} s" if seconds else ""
    print(f"  {what}: alarm in {found} of {len(moves)}, station right in {right} {when}")


def main() -> None:
    """Print all figures."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    node: StationSoftware
    for node in ("ours", "authors"):
        drives = [drive(seed, node) for seed in SEEDS]
        counts = [len(measurements) / 3 / DURATION_S for _, measurements in drives]
        print(f"{node}: {statistics.mean(counts):.2f} Hz per station, {DURATION_S:.0f} s")
        report("nothing moved", drives, [np.eye(4)] * len(drives))
        for shift_mm in (10, 15, 20):
            bearings = [2 * math.pi * k / 12 for k in range(12)]
            shifts = [shift_mm / 1e3 * np.array([math.cos(b), math.sin(b), 0.0]) for b in bearings]
            report(f"{shift_mm} mm in plan", drives, [transform_from(np.eye(3), shift) for shift in shifts])
        for turn_mrad in (0.1, 0.2):
            turns = [np.array([0.0, 0.0, sign * turn_mrad / 1e3]) for sign in (1, 1, 1, -1, -1, -1)]
            report(
                f"{turn_mrad} mrad of heading",
                drives,
                [transform_from(exp_so3(turn), np.zeros(3)) for turn in turns],
            )
