"""What merged times are worth: missions with an outage, their journals merged, every added time against the truth.

Rates of the clocks go up and down by 0.5 ppm a minute, the first station's from 20 ppm fast on, the second's from 20 ppm
slow on; stamps of the radios jitter by 20 us. Over ``classic`` the outage ends before the mission, over ``superframe``
with it, for otherwise everything would be delivered afterwards. ``--json`` prints the figures for a machine.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Stopwatch

from tsgt.analysis.merge import merge
from tsgt.config import ClassicMasterConfig, ScenarioConfig, SuperframeMasterConfig
from tsgt.log import configure_logging
from tsgt.recording import MergedRecord, decode_line, read_lines
from tsgt.simulation.options import Outage, SimulationOptions
from tsgt.simulation.runner import simulate

AROUND_S = 300.0


def main() -> None:
    """Print a row for each protocol and outage."""
    parser = argparse.ArgumentParser(description="Errors and bounds of merged times.")
    parser.add_argument("--json", action="store_true", help="figures for a machine")
    parser.add_argument("--seed", type=int, default=0, help="of the missions (default 0)")
    parser.add_argument("--minutes", type=float, nargs="*", default=[2.0, 10.0], help="of the outage")
    arguments = parser.parse_args()
    configure_logging("error")
    found = [
        figures(protocol, minutes, arguments.seed)
        for protocol in ("classic", "superframe")
        for minutes in arguments.minutes
    ]
    if arguments.json:
        print(json.dumps(found, indent=1))
        return
    print("| protocol | outage | added | error p50 | max | bound p50 | max | broken | merging |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in found:
        print(
            f"| `{row['protocol']}` | {row['outage_min']:g} min | {row['added']} | {row['error_ms']['p50']:.3f} "
            f"| {row['error_ms']['max']:.3f} | {row['bound_ms']['p50']:.2f} | {row['bound_ms']['max']:.2f} "
            f"| {row['broken']} | {row['seconds']:.2f} s |"
        )


def figures(protocol: str, outage_min: float, seed: int) -> dict[str, Any]:
    """Simulate a mission, merge, and compare; times in ms."""
    classic = protocol == "classic"
    after_s = AROUND_S if classic else 0.0
    outage_s = 60 * outage_min
    with tempfile.TemporaryDirectory() as name:
        run = simulate(
            ScenarioConfig(),
            SimulationOptions(
                duration_s=AROUND_S + outage_s + after_s,
                drift_ppm=20.0,
                drift_ramp_ppm_per_min=0.5,
                stamp_jitter_us=20.0,
                seed=seed,
                protocol=ClassicMasterConfig(kind="classic")
                if classic
                else SuperframeMasterConfig(kind="superframe"),
                outages=(Outage((1, 2, 3), AROUND_S, outage_s + (0.0 if classic else 60.0)),),
            ),
            folder=Path(name),
        )
        path = run.master_logs[0].recording()
        assert path is not None  # noqa: S101 (the master has recorded)
        journals = [journal for station_log in run.station_logs.values() for journal in station_log.journals]
        with Stopwatch() as stopwatch:
            merged = merge(path, journals)
        added = [
            decode_line(MergedRecord, line, path).measurement
            for line in read_lines(path)
            if line.type == "merged"
        ]
    errors_ns = np.abs(
        [
            m.stamp_ns - run.start_ns - run.station_logs[m.station].true_times_ns[m.host_time_ns or 0]
            for m in added
        ]
    )
    bounds_ns = np.array([m.stamp_bound_ns or 0 for m in added])
    return {
        "protocol": protocol,
        "outage_min": outage_min,
        "added": merged.added,
        "error_ms": {"p50": float(np.median(errors_ns)) / 1e6, "max": float(errors_ns.max()) / 1e6},
        "bound_ms": {"p50": float(np.median(bounds_ns)) / 1e6, "max": float(bounds_ns.max()) / 1e6},
        "broken": int(np.count_nonzero(errors_ns > bounds_ns)),
        "seconds": stopwatch.wall_s,
    }
