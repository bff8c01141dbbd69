"""How small a movement of a tripod the live alarm finds, and whether it cries without one.

    python benchmarks/run.py frame_watch
    python benchmarks/run.py frame_watch gaps

The second one has all stations silent for a time again and again, as a busy computer or a bad radio link, at the site of the
rehearsal. The figures stand in docs/how-to/calibrate.md, section "Layout monitor".
"""

from __future__ import annotations

import dataclasses
import logging
import math
import statistics
import sys
from typing import TYPE_CHECKING

import numpy as np
import structlog
from measuring import simulated

from tsgt.config import ClassicMasterConfig, FrameWatchConfig, ScenarioConfig
from tsgt.estimation import LiveEstimator
from tsgt.geometry import exp_so3, transform_from
from tsgt.master.monitors.layout import LayoutMonitor
from tsgt.recording import PoseRecord, load_recording
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.rehearsal import SCENARIO

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry import FloatArray
    from tsgt.model import Measurement, Parameters
    from tsgt.recording import EventRecord
    from tsgt.simulation.options import StationSoftware

    Drive = tuple[Parameters, Sequence[Measurement]]

DURATION_S = 600.0
SEEDS = (1, 2, 3)
GAPS_DURATION_S = 300.0
GAPS_S = ((math.inf, 0.0), (3.0, 2.0), (1.5, 3.0), (1.0, 5.0))
"""Mean durations of measurements and of gaps."""


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


def with_gaps(
    measurements: Sequence[Measurement], on_s: float, off_s: float, seed: int
) -> Sequence[Measurement]:
    """Leave out what all stations measure in gaps; their durations, and those between them, are exponential."""
    if not off_s:
        return measurements
    rng, start_ns = np.random.default_rng(seed), measurements[0].stamp_ns
    count = int(2 * GAPS_DURATION_S / (on_s + off_s))
    changes_s = np.cumsum(np.stack([rng.exponential(on_s, count), rng.exponential(off_s, count)], axis=1))
    return [m for m in measurements if np.searchsorted(changes_s, (m.stamp_ns - start_ns) / 1e9) % 2 == 0]


def report_gaps() -> None:
    """Print what is found at the site of the rehearsal."""
    pipeline = SCENARIO.pipeline.model_copy(update={"estimator": "linear"})
    drives = []
    for seed in SEEDS[:2]:
        with simulated(
            SCENARIO.model_copy(update={"pipeline": pipeline}),
            SimulationOptions(duration_s=GAPS_DURATION_S, seed=seed),
        ) as run:
            path = run.master_logs[-1].recording()
            assert path is not None  # noqa: S101 (the master has recorded)
            drives.append((run.parameters, load_recording(path).measurements))
    for on_s, off_s in GAPS_S:
        print(f"{on_s:g} s of measurements, then {off_s:g} s without any, on average")
        gapped = [
            (parameters, with_gaps(all_, on_s, off_s, seed)) for seed, (parameters, all_) in enumerate(drives)
        ]
        report("nothing moved", gapped, [np.eye(4)] * len(gapped))
        shifts = [
            0.036 * np.array([math.cos(b), math.sin(b), 0.0]) for b in (2 * math.pi * k / 6 for k in range(6))
        ]
        report("36 mm in plan", gapped, [transform_from(np.eye(3), shift) for shift in shifts])


def main() -> None:
    """Print all figures."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    if sys.argv[1:] == ["gaps"]:
        report_gaps()
        return
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
