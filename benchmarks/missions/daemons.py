"""What the daemons cost: CPU and memory of three clients and a master while the demonstration runs in real time.

Run it with ``python benchmarks/run.py daemons [SECONDS]``; ten minutes by default. The figures are read from
/proc of each process, so they hold its start as well; the shares are of one core of this machine.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

DEFAULT_DURATION_S = 600
SAMPLE_INTERVAL_S = 0.5


def main() -> None:
    """Run the demonstration and print a table."""
    duration_s = int(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT_DURATION_S
    command = [sys.executable, "-m", "tsgt", "demo", "--duration", str(duration_s), "--json"]
    began_s = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None  # noqa: S101 (we asked for a pipe)
        assert demo.stderr is not None  # noqa: S101 (as above)
        pids: dict[str, int] = {}
        usage: dict[str, tuple[float, float]] = {}
        watching = threading.Thread(target=_watch, args=(demo, pids, usage), daemon=True)
        watching.start()
        for line in demo.stderr:
            if line.startswith("processes"):
                pids.update({name: int(pid) for name, pid in re.findall(r"(\w+(?: \d)?): (\d+)", line)})
        result = json.loads(demo.stdout.read())
    lived_s = time.monotonic() - began_s
    if not usage:
        sys.exit("the demonstration named no processes; see its output")
    master_cpu_s, _ = usage["master"]
    print(f"{duration_s} s of demonstration, {result['poses']} poses, {result['valid_poses']} valid")
    print(f"{'process':10}  {'CPU s':>7}  {'of a core':>9}  {'of the master':>13}  {'peak MB':>7}")
    for name, (cpu_s, peak_mb) in usage.items():
        share = f"{100 * cpu_s / lived_s:.1f} %"
        print(f"{name:10}  {cpu_s:7.1f}  {share:>9}  {cpu_s / master_cpu_s:13.2f}  {peak_mb:7.0f}")


def _watch(demo: subprocess.Popen[str], pids: dict[str, int], usage: dict[str, tuple[float, float]]) -> None:
    while demo.poll() is None:
        for name, pid in list(pids.items()):
            try:
                usage[name] = _usage(pid)
            except OSError:
                continue  # it has ended; its last sample stands
        time.sleep(SAMPLE_INTERVAL_S)


def _usage(pid: int) -> tuple[float, float]:
    """CPU time in s and peak of resident memory in MB."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks = int(fields[11]) + int(fields[12])  # utime and stime, proc(5)
    peak = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    return ticks / os.sysconf("SC_CLK_TCK"), int(peak[1]) / 1024 if peak else 0.0
