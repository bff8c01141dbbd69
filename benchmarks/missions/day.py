"""A day in the field: 24 h of the whole system in virtual time, with two backlogs of six hours and all checks.

    python benchmarks/run.py day [--hours H] [--full] [--seed N] [--json FILE]

Three stations and a slow robot. Master and clients run all day. The instruments are switched on for five minutes of every hour.
Station 2 has no radio contact from hour 1 to hour 7, and station 3 from hour 9 to hour 15; the instrument of each measures
all that time, and the client of station 3 is restarted ten minutes before contact returns. With fewer hours all of it shrinks.

So that a day takes less than an hour of CPU on an idle machine, instruments measure at 1 Hz, radios use SF 11, and the poses of
`linear` are at 1 Hz. `--full`: 2.5 Hz, SF 9, 20 Hz.

A line for each twenty-fourth: simulated and CPU time, memory of this process, which holds daemons, logs and checkers. At the end
the counters, how the backlogs drained, and the violated invariants.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import resource
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tsgt.config import SuperframeMasterConfig
from tsgt.log import configure_logging
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.options import Outage, Restart, SimulationOptions
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from tsgt.config import ScenarioConfig
    from tsgt.simulation.mission import Mission, MissionResult

HOUR_S = 3600.0
WORK_SHARE = 1 / 12
"""Share of every hour in which all instruments are on."""

BOOT_S, RESTART_BEFORE_S = 7.0, 600.0
MEMORY_CHECK_S = 900
"""A look at all objects takes a second when the logs of a day are among them."""

OUTAGES_H = {2: (1.0, 7.0), 3: (9.0, 15.0)}
"""From when to when a station has no radio contact, in hours of a day of 24."""


def day_scenario(*, full: bool) -> ScenarioConfig:
    """Return the scenario ``dynamic`` with a slow robot; unless full, with fewer measurements, frames and poses."""
    scenario = find_scenario("dynamic")
    motion = scenario.motion.model_copy(
        update={
            "speeds_mps": (0.0, 0.05),
            "speed_weights": (1.0, 1.0),
            "yaw_rates_radps": (0.0, 0.01, -0.01),
            "tilt_rms_deg": 0.1,
            "heave_rms_mm": 1.0,
        }
    )
    pipeline: dict[str, object] = {"estimator": "linear", "smoothed_delays_s": ()}
    if full:
        return scenario.model_copy(
            update={"motion": motion, "pipeline": scenario.pipeline.model_copy(update=pipeline)}
        )
    pipeline |= {"rate_hz": 1.0, "outage_limit_s": 4.0, "transport_limit_s": 8.0}
    return scenario.model_copy(
        update={
            "motion": motion,
            "pipeline": scenario.pipeline.model_copy(update=pipeline),
            "radio": scenario.radio.model_copy(update={"spreading_factor": 11}),
            "stations": tuple(each.model_copy(update={"rate_hz": 1.0}) for each in scenario.stations),
        }
    )


async def switch_instruments(mission: Mission, outages: tuple[Outage, ...], hour_s: float) -> None:
    """Switch the instruments on at the start of every hour and off after the work, except during a station's outage."""
    for hour in range(24):
        await mission.sleep_until(hour * hour_s)
        off = [number for number, instrument in mission.instruments.items() if not instrument.on]
        for number in off:
            mission.instruments[number].switch_on()
        await asyncio.sleep(BOOT_S if off else 0)
        for number in off:
            mission.instruments[number].lock_manually(mission.prisms[number])
        await mission.sleep_until((hour + WORK_SHARE) * hour_s)
        for number, instrument in mission.instruments.items():
            if not any(number in each.stations and each.covers(mission.now_s) for each in outages):
                instrument.switch_off()


def report_progress(hour_s: float, began_s: float, now_s: float) -> None:
    """Print a line at the end of every hour."""
    if now_s % hour_s < 1.0:
        megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"{now_s / HOUR_S:6.2f} h, {time.process_time() - began_s:6.0f} s of CPU, {megabytes:5.0f} MB",
            flush=True,
        )


def counters(result: MissionResult) -> dict[str, float]:
    """Return how far the counters came; sequence numbers with those that restarts skipped."""
    master_log = result.master_logs[-1]
    newest = {each.station: each.sequence for each in master_log.measurements}
    return {
        "session_time_s": result.duration_s,
        "frames": master_log.frame_count,
        "frame_ms": round(master_log.frames_duration_ns / 1e6 / max(1, master_log.frame_count), 1),
        **{f"sequence of station {number}": sequence for number, sequence in sorted(newest.items())},
        "measurements": len(master_log.measurements),
        "valid poses": len(master_log.valid_poses().stamp_ns),
        "recording MB": round(
            sum(path.stat().st_size for path in master_log.folder.glob("*.jsonl")) / 1e6, 1
        ),
        "journals MB": round(
            sum(p.stat().st_size for each in result.station_logs.values() for p in each.journals) / 1e6, 1
        ),
    }


def drains(result: MissionResult) -> dict[str, dict[str, float]]:
    """Return of each outage how much was measured in it, and how long it took to arrive."""
    found = {}
    master_log = result.master_logs[-1]
    for outage in result.outages:
        start_ns, end_ns = (
            master_log.unix_at_zero_ns + round(at_s * 1e9) for at_s in (outage.start_s, outage.end_s)
        )
        arrived_ns = [
            arrived
            for each, arrived in zip(master_log.measurements, master_log.arrived_ns, strict=True)
            if each.station in outage.stations and start_ns <= each.stamp_ns < end_ns
        ]
        took_s = max(arrived_ns, default=0) / 1e9 - outage.end_s
        found[f"station {outage.stations[0]}, {outage.duration_s / HOUR_S:g} h"] = {
            "measurements": len(arrived_ns),
            "drained_s": round(took_s, 1),
            "per_s": round(len(arrived_ns) / took_s, 2) if took_s > 0 else 0.0,
        }
    return found


def main() -> int:
    """Run the day, check it and print what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    configure_logging("critical")
    logging.disable(logging.CRITICAL)
    hour_s = HOUR_S * arguments.hours / 24
    outages = tuple(
        Outage((station,), start * hour_s, (end - start) * hour_s)
        for station, (start, end) in OUTAGES_H.items()
    )
    options = SimulationOptions(
        duration_s=24 * hour_s,
        seed=arguments.seed,
        protocol=SuperframeMasterConfig(kind="superframe"),
        outages=outages,
        restarts=(Restart(3, outages[1].end_s - RESTART_BEFORE_S * hour_s / HOUR_S),),
    )
    began_s = time.process_time()
    with tempfile.TemporaryDirectory(prefix="tsgt-day-") as folder:
        result = simulate(
            day_scenario(full=arguments.full),
            options,
            folder=Path(folder),
            progress=partial(report_progress, hour_s, began_s),
            script=lambda mission: switch_instruments(mission, outages, hour_s),
            memory_check_s=MEMORY_CHECK_S,
        )
        simulated_cpu_s = time.process_time() - began_s
        violations = check_invariants(result, replay=True)
        report = {
            "counters": counters(result),
            "drains": drains(result),
            "cpu_s": round(simulated_cpu_s),
            "checks_cpu_s": round(time.process_time() - began_s - simulated_cpu_s),
            "memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
            "violations": [f"{each.check}: {each.detail}" for each in violations],
        }
    text = json.dumps(report, indent=1)
    print(text)
    if arguments.json is not None:
        arguments.json.write_text(text + "\n")
    return 3 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
