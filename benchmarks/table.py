"""Run the quick benchmarks one after the other, and write their results as one page of the documentation.

    python benchmarks/run.py table [NAME ...]

Writes docs/reference/benchmarks.md: the machine and its load, the commit, and for each benchmark the command, its CPU time and what
it printed. Without names all quick ones run; `make bench` does that.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "reference" / "benchmarks.md"
QUICK = {
    "process": "post-processing of one hour",
    "continuous": "the estimator `continuous`, batch and live",
    "alignment": "poses from prisms",
    "air": "messages of the radio",
    "simulation_speed": "simulated missions",
    "instrument": "driver of the instrument",
    "clock_scenarios": "clock offsets",
}
ARGUMENTS = {"continuous": ["1"]}
HEADER = """# Benchmarks

Results of the quick benchmarks as `python benchmarks/run.py table {names}` wrote them (`make bench`: all quick ones): machine {machine}, {cores} cores, load \
{load:.1f} at the start; Python {python}; commit `{commit}`, {date}. On a loaded machine CPU times are up to twice those of an \
idle one; ratios within one run hold. `python benchmarks/run.py` lists all benchmarks, and \
[peers](../explanation/peers.md) compares other estimators.

| what | command | CPU s | status |
|---|---|---|---|
"""


def machine() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def commit() -> str:
    """Return the commit that was measured, with a plus sign if files differ from it."""
    described = ["git", "-C", str(HERE), "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(described, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


def run(arguments: list[str]) -> tuple[float, str, bool]:
    """Run a benchmark; return its CPU time in s, what it printed, and whether it ended well."""
    before = os.times()
    found = subprocess.run(
        [sys.executable, str(HERE / "run.py"), *arguments], capture_output=True, text=True, check=False
    )
    after = os.times()
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    well = found.returncode == 0
    return cpu_s, (found.stdout if well else found.stdout + found.stderr[-500:]).rstrip(), well


def main() -> int:
    """Write the page; return 1 if a benchmark failed."""
    names = sys.argv[1:] or list(QUICK)
    unknown = [name for name in names if name not in QUICK]
    if unknown:
        sys.exit(f"not a quick benchmark: {', '.join(unknown)}; there are {', '.join(QUICK)}")
    page = HEADER.format(
        names=" ".join(names),
        machine=machine(),
        cores=os.cpu_count(),
        load=os.getloadavg()[0],
        python=platform.python_version(),
        commit=commit(),
        date=time.strftime("%Y-%m-%d", time.gmtime()),
    )
    outputs, failed = "", False
    for name in names:
        arguments = [name, *ARGUMENTS.get(name, [])]
        command = f"python benchmarks/run.py {' '.join(arguments)}"
        print(command, flush=True)
        cpu_s, printed, well = run(arguments)
        failed |= not well
        page += f"| {QUICK[name]} | `{command}` | {cpu_s:.0f} | {'done' if well else 'failed'} |\n"
        outputs += f"\n## {QUICK[name].capitalize()}\n\n`{command}`\n\n```text\n{printed}\n```\n"
    PAGE.write_text(page + outputs)
    return int(failed)
