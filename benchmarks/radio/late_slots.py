"""How often a station misses its slot while both cores are busy with something else, and what that costs.

Run it with ``python benchmarks/run.py late_slots [SECONDS]``; two minutes by default. The demonstration runs in
real time, three clients and a master as separate processes, with one process per core that does nothing but
count. Late slots are what the clients say of themselves, slots the beacons in the master's recording, and nothing may
be missing in it that a client has in its journal, but for what was under way when everything ended.
"""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from tsgt.recording import load_recording
from tsgt.recording.journal import load_journal

DEFAULT_DURATION_S = 120
STATIONS = (1, 2, 3)
SAMPLE_INTERVAL_S = 1.0
UNDER_WAY_NS = 3_000_000_000
"""What was measured so shortly before the last beacon may still be missing."""


def main() -> None:
    """Run the demonstration under load and print a table."""
    duration_s = int(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT_DURATION_S
    spinning = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"])
        for _ in range(len(os.sched_getaffinity(0)))
    ]
    try:
        folder, statuses = run_demo(duration_s)
    finally:
        for process in spinning:
            process.kill()
    (recording,) = (folder / "recordings").glob("*.jsonl")
    frames, last_ns = beacons(recording)
    delivered = {(m.station, m.sequence) for m in load_recording(recording).measurements}
    print(
        f"{duration_s} s of demonstration, {len(spinning)} cores busy, {frames} frames of "
        f"{1e3 * duration_s / max(1, frames):.0f} ms or so"
    )
    print(f"{'station':8}{'slots':>8}{'late':>6}{'part':>8}{'measured':>10}{'missing':>9}{'queued':>8}")
    for station in STATIONS:
        journals = sorted((folder / f"journals{station}").glob("*.jsonl"))
        # All processes share the clock of this machine.
        measured = [
            m
            for path in journals
            for m in load_journal(path).measurements
            if m.stamp_ns < last_ns - UNDER_WAY_NS
        ]
        missing = sum((station, m.sequence) not in delivered for m in measured)
        late = statuses[station]["missed_slots"]
        print(
            f"{station:<8}{frames:8}{late:6}{late / max(1, frames):8.2%}{len(measured):10}{missing:9}"
            f"{statuses[station]['queued']:8}"
        )


def run_demo(duration_s: float) -> tuple[Path, dict[int, dict[str, int]]]:
    """Run it to its end; return its folder, and what each client said of itself last."""
    command = [sys.executable, "-m", "tsgt", "demo", "--duration", str(duration_s), "--json"]
    statuses: dict[int, dict[str, int]] = {}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None  # noqa: S101 (we asked for a pipe)
        assert demo.stderr is not None  # noqa: S101 (as above)
        for line in demo.stderr:
            if match := re.search(r"^poses on +(.*)/poses\.sock", line):
                threading.Thread(target=_watch, args=(demo, Path(match[1]), statuses), daemon=True).start()
        result = json.loads(demo.stdout.read())
    if statuses.keys() < set(STATIONS):
        sys.exit(f"not all clients said how they do; see {result['folder']}")
    return Path(result["folder"]), statuses


def _watch(demo: subprocess.Popen[str], folder: Path, statuses: dict[int, dict[str, int]]) -> None:
    while demo.poll() is None:
        for station in STATIONS:
            with suppress(OSError, ValueError), socket.socket(socket.AF_UNIX) as connection:
                connection.connect(os.fspath(folder / f"client{station}.sock"))
                statuses[station] = json.loads(connection.makefile().readline())
        time.sleep(SAMPLE_INTERVAL_S)


def beacons(recording: Path) -> tuple[int, int]:
    """Count the beacons of a recording; return how many, and when the last one left, Unix time in ns."""
    count, last_ns = 0, 0
    with recording.open("rb") as file:
        for line in file:
            if line.startswith(b'{"type":"beacon"'):
                count, last_ns = count + 1, json.loads(line)["stamp_ns"]
    return count, last_ns
