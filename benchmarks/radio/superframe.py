"""What the superframe carries, how old it is and how well it is timed, compared with the paper's protocol.

Run it with ``python benchmarks/run.py superframe``; about five minutes on two cores. Each row is one ``tsgt simulate``, whose
options stand in it, so that any row can be had alone.
"""

from __future__ import annotations

import json
import math
import os
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

HARD = "--drift-ppm 50 --drift-ramp-ppm-per-min 1 --stamp-jitter-us 20"
CASES = (
    *(f"--protocol superframe --loss {loss}" for loss in (0, 0.1, 0.2, 0.3)),
    *(f"--protocol superframe --loss 0.1 --seed {seed}" for seed in (1, 2)),
    *(f"--protocol classic --loss {loss}" for loss in (0, 0.1, 0.2, 0.3)),
    *(f"--protocol superframe --stations 8 --loss {loss}" for loss in (0, 0.1)),
    "--protocol superframe --stations 12",
    f"--protocol superframe {HARD}",
    f"--protocol superframe {HARD} --outage all:300:60",
    f"--protocol classic {HARD} --outage all:300:60",
    f"--protocol classic --clock-filter paper {HARD} --outage all:300:60",
    "--protocol superframe --loss 0.1 --outage 1:300:60",
    "--protocol superframe --loss 0.1 --outage all:300:60",
    "--protocol superframe --loss 0.1 --restart 2:200 --restart 3:400",
    "--protocol superframe --interference-rate-hz 0.5",
)


def main() -> None:
    """Run all cases and print a table."""
    print(
        "| options | rate Hz | delivered | within 2 s | age p50 / p99 ms | frame ms | time error p50 / p99 / max us |"
    )
    print("|---|---|---|---|---|---|---|")
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for case, result in zip(CASES, pool.map(simulate, CASES), strict=True):
            print(row(case, result), flush=True)


def simulate(case: str) -> dict[str, Any]:
    """Run one case; a violation is an error."""
    command = [sys.executable, "-m", "tsgt", "simulate", "dynamic", "--duration", "600", "--json"]
    done = subprocess.run(command + shlex.split(case), check=True, stdout=subprocess.PIPE)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def row(case: str, result: dict[str, Any]) -> str:
    """Write the figures of all stations together; the rate is that of the slowest, as is the share delivered."""
    stations, together = result["stations"].values(), result["all"]
    age, error = together["age_ms"], together["time_error_us"]
    cells = [
        f"`{case}`",
        f"{min(station['rate_hz'] for station in stations):.2f}",
        f"{math.floor(1000 * min(s['delivered'] / s['measured'] for s in stations)) / 10:g} %",
        f"{100 * together['within_2s']:.2f} %",
        f"{age['p50']:.0f} / {age['p99']:.0f}",
        f"{result['frame_ms']:.0f}" if "frame_ms" in result else "",
        f"{error['p50']:.0f} / {error['p99']:.0f} / {error['max']:.0f}",
    ]
    for outage in result["outages"]:
        within = outage["time_error_us"]
        if outage["drained_s"] is None:
            cells[0] += " (what was measured within the outage is lost)"
            continue
        cells[0] += (
            f" (drained {outage['drained_s']:.1f} s, live age p50 {outage['live_age_ms']['p50']:.0f} ms, "
            f"time error of what was measured within {within['p50']:.0f} / {within['p99']:.0f} / {within['max']:.0f})"
        )
    return f"| {' | '.join(cells)} |"
