"""What the endurance run is watched with: processes in /proc, the master's stream; and the air as a process of its own."""

from __future__ import annotations

import asyncio
import json
import os
import re
import sys
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.config import ScenarioConfig
from tsgt.log import configure_logging
from tsgt.simulation.lora import AirServer, scenario_link

if TYPE_CHECKING:
    from collections.abc import Sequence

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Sample:
    """One look at a process in /proc: seconds since the start, resident memory in MB, CPU time in s, open files."""

    at_s: float
    rss_mb: float
    cpu_s: float
    files: int

    @classmethod
    def of(cls, pid: int, at_s: float) -> Sample:
        """Take it; raise OSError where the process has ended."""
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])  # utime and stime, proc(5)
        resident = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
        files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        return cls(at_s, int(resident[1]) / 1024 if resident else 0.0, ticks / _TICKS_PER_S, files)


@dataclass(slots=True)
class Stream:
    """What one connection to the master's stream has brought.

    Attributes
    ----------
    first_s, last_s
        Arrival of its first pose and of its last line, CLOCK_MONOTONIC.
    longest_pause_s
        The longest time between two lines from the first pose on.
    epochs_ns
        Of all poses, by kind and delay, as they came.
    valid, reasons
        How many poses were valid, by kind and delay, and why others were not.
    ages_s
        By station: from the stamp of each measurement to its arrival here.
    late
        By station: how many late slots the master knew of at the end.
    lost
        Lines that this reader was too slow for.
    """

    first_s: float = 0.0
    last_s: float = 0.0
    longest_pause_s: float = 0.0
    epochs_ns: defaultdict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    valid: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    ages_s: defaultdict[int, list[float]] = field(default_factory=lambda: defaultdict(list))
    late: dict[int, int] = field(default_factory=dict)
    lost: int = 0

    def take(self, line: dict[str, Any]) -> None:
        """Take note of a line that has just come."""
        now_s = time.monotonic()
        if self.first_s:
            self.longest_pause_s = max(self.longest_pause_s, now_s - self.last_s)
        self.last_s = now_s
        match line["type"]:
            case "pose":
                self.first_s = self.first_s or now_s
                delay_s = line.get("delay_s")
                series = line["kind"] if delay_s is None else f"{line['kind']}_{delay_s:g}s"
                self.epochs_ns[series].append(line["stamp_ns"])
                self.valid[series] += line["valid"]
                self.reasons[line["reason"]] += not line["valid"]
            case "measurement":
                self.ages_s[line["station"]].append((time.time_ns() - line["stamp_ns"]) / 1e9)
            case "status":
                self.late = {each["id"]: each["missed_slots"] or 0 for each in line["stations"]}
            case "event" if line["event"] == "lines_lost":
                self.lost += line["count"]

    def missing_epochs(self, series: str, period_ns: int) -> int:
        """Return how many epochs between the first pose of a series and the last have none."""
        return sum(
            max(0, (after - before) // period_ns - 1) for before, after in pairwise(self.epochs_ns[series])
        )


def lossy_scenario(loss: float) -> ScenarioConfig:
    """Return the reference scenario with packet loss."""
    scenario = ScenarioConfig()
    return scenario.model_copy(update={"radio": scenario.radio.model_copy(update={"loss_probability": loss})})


async def serve_air(path: Path, loss: float, seed: int) -> None:
    """Be the air between the radios until standard input ends: with the program that has started this one."""
    scenario, rng = lossy_scenario(loss), np.random.default_rng(seed)
    places = {f"station{s.station}": s.position_m for s in scenario.stations}
    places["master"] = scenario.motion.area_centre_m
    async with AirServer(path, scenario_link(scenario.radio, places, rng), rng):
        await asyncio.to_thread(sys.stdin.read)


def memory_slope(samples: Sequence[Sample]) -> float:
    """Slope of resident memory in MB per hour, by least squares."""
    hours = np.array([each.at_s for each in samples]) / 3600
    slope, _ = np.polyfit(hours, [each.rss_mb for each in samples], 1)
    return float(slope)


def beacons_ns(recordings: Sequence[Path]) -> list[int]:
    """Return when the beacons of all recordings left, Unix time in ns."""
    return [
        json.loads(line)["stamp_ns"]
        for path in recordings
        for line in path.read_bytes().splitlines()
        if line.startswith(b'{"type":"beacon"')
    ]


if __name__ == "__main__":
    configure_logging("error")
    asyncio.run(serve_air(Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])))
