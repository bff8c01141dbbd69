"""One hour of field work through `tsgt process`, from start-up to the TUM file, and `tsgt evaluate`: CPU time, peak memory.

The recording is what a master would have written: measurements of three stations at 2.5 Hz, the poses that it
streamed (which `process` reads past and computes again), and nothing else. For comparison, in the same run: what start-up
alone costs, and what reading every line of the file with the standard library's json costs.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from measuring import Stopwatch

from tsgt.config import ScenarioConfig, scenario_parameters
from tsgt.estimation import LinearEstimator
from tsgt.recording import RecordingHeader, RecordingWriter
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.mission import instrument_config
from tsgt.simulation.world import scenario_world
from tsgt.station.leica import LeicaInstrument
from tsgt.station.session import ClientSession

if TYPE_CHECKING:
    from tsgt.config import SimulatedStation
    from tsgt.model import PolarMeasurement

DURATION_S = 3600
START_NS = 1_700_000_000_000_000_000
REPEATS = 3


def main() -> None:
    """Print the table and the ratios."""
    with tempfile.TemporaryDirectory() as folder:
        recording, poses = Path(folder) / "hour.jsonl", Path(folder) / "hour.tum"
        # In a process of its own: a child's peak memory starts from that of the process it was forked from.
        with ProcessPoolExecutor(1) as pool:
            measurements = pool.submit(write_recording, recording).result()
        process_s, memory = best("-m", "tsgt", "process", str(recording), "--output", str(poses))
        evaluate_s, evaluate_memory = best("-m", "tsgt", "evaluate", str(recording))
        start_s, start_memory = best(
            "-c", "import tsgt.analysis.processing, tsgt.analysis.formats.export, tsgt.cli.desk.process"
        )
        json_s = min(read_with_json(recording) for _ in range(REPEATS))
        pose_lines = len(poses.read_text().splitlines())
        size_mb = recording.stat().st_size / 1e6

    print(f"recording: {measurements} measurements, {size_mb:.0f} MB; {pose_lines} poses in the TUM file")
    print(f"{'':34}{'CPU s':>8}{'peak MB':>9}")
    print(f"{'tsgt process to TUM, all of it':34}{process_s:8.2f}{memory:9.0f}")
    print(f"{'  of this start-up (imports)':34}{start_s:8.2f}{start_memory:9.0f}")
    print(f"{'tsgt evaluate, all of it':34}{evaluate_s:8.2f}{evaluate_memory:9.0f}")
    print(f"{'json.loads of every line':34}{json_s:8.2f}")
    print(f"one hour of field work / CPU time of process: {DURATION_S / process_s:.0f}")
    print(f"process / json.loads of every line: {process_s / json_s:.2f}")


def write_recording(path: Path) -> int:
    """Write the hour as a master would have; return the number of measurements."""
    scenario = ScenarioConfig()
    parameters = scenario_parameters(scenario)
    timeline = VirtualTimeline()
    unsorted = run_virtual(lambda: measured(scenario, timeline), timeline)
    measurements = sorted(unsorted, key=lambda m: m.stamp_ns)
    pipeline = LinearEstimator(parameters)
    with RecordingWriter(path) as writer:
        writer.write(RecordingHeader(software="benchmark", created_ns=START_NS, source="simulation"))
        writer.write(parameters)
        for measurement in measurements:
            pipeline.add(measurement)
            writer.write(measurement)
        for pose in pipeline.advance(START_NS + DURATION_S * 1_000_000_000).records():
            writer.write(pose)
    return len(measurements)


async def measured(scenario: ScenarioConfig, timeline: VirtualTimeline) -> list[PolarMeasurement]:
    """Let all stations of a scenario track their prisms for the hour."""
    world_rng, *rngs = np.random.default_rng(1).spawn(1 + len(scenario.stations))
    world, clock = scenario_world(scenario, DURATION_S, world_rng), VirtualClock(START_NS)

    async def one(station: SimulatedStation, rng: np.random.Generator) -> list[PolarMeasurement]:
        far_end = SimulatedTotalStation(station, scenario, world, timeline, rng)
        line = SimulatedLine(far_end, timeline, clock)
        instrument = LeicaInstrument(instrument_config(station, Path()), line.open, clock)
        await instrument.connect()
        await instrument.track(station.prism)
        session = ClientSession(station.station, station.prism)
        readings = []
        while clock.monotonic_ns() < DURATION_S * 1_000_000_000:
            reading = await instrument.read()
            readings.append(session.measurement(reading, START_NS + reading.at_ns))
        await instrument.close()
        return readings

    stations = zip(scenario.stations, rngs, strict=True)
    return list(chain.from_iterable(await asyncio.gather(*(one(station, rng) for station, rng in stations))))


def best(*arguments: str) -> tuple[float, float]:
    """Least CPU time in s of several runs of Python with these arguments, and the peak memory in MB."""
    runs = []
    for _ in range(REPEATS):
        process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{' '.join(arguments)} failed with {process.returncode}")
        runs.append((usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3))
    return min(runs)


def read_with_json(path: Path) -> float:
    """CPU time in s of parsing every line."""
    with Stopwatch() as stopwatch, path.open("rb") as file:
        for line in file:
            json.loads(line)
    return stopwatch.cpu_s
