"""Kill -9 again and again: three clients and a master as processes, and what they have left behind at the end.

Run it with ``python benchmarks/run.py kill_loop --kills 200``. Daemons, sockets, serial lines (pseudo-terminals), files and
time are real, radios and instruments simulated, as in ``tsgt demo``. Each daemon is killed at a random age, half of the
time within its first five seconds, one time in ten all at once, and started again a second later. A kill hardly ever
tears a line, so every third time half a line is put behind the last one of the newest file, as a write that did not
come to its end leaves it. At the end the instruments are unplugged, and the stations have to deliver all they have.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from harness.missions.kill_checks import FileReport, check_files_after_kills

from tsgt.clock import SystemClock
from tsgt.config import ScenarioConfig
from tsgt.log import configure_logging
from tsgt.simulation.checks import Violation
from tsgt.simulation.demo import Demo, write_demo_files
from tsgt.simulation.instrument import PtyLine, SimulatedTotalStation
from tsgt.simulation.kernel import LoopTimeline
from tsgt.simulation.lora import AirServer, scenario_link

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.simulation.demo.processes import Process

YOUNG_S = 5.0
OLD_S = 30.0
YOUNG_SHARE = 0.5
TOGETHER_SHARE = 0.1
TORN_SHARE = 1 / 3
HALF_HEADER = b'{"type":"recording","version":1,"softw'
LAST_MEASUREMENTS = 5
"""Each station makes this many after the last kill."""
POLL_S = 0.01
DRAIN_LIMIT_S = 120.0
WORLD_S = 7200.0


def main() -> None:
    """Kill, check, print a table; fail if anything was not as it must be."""
    parser = argparse.ArgumentParser(description="Kill daemons at random and check what they leave behind.")
    parser.add_argument("--kills", type=int, default=200, help="how many, or up to three more (default 200)")
    parser.add_argument("--seed", type=int, default=0, help="of the instants (default 0)")
    parser.add_argument(
        "--oldest",
        type=float,
        default=OLD_S,
        help="age at which each is killed at the latest, in s (default 30)",
    )
    parser.add_argument("--json", action="store_true", help="the result as JSON")
    arguments = parser.parse_args()
    configure_logging("error")
    folder = Path(tempfile.mkdtemp(prefix="tsgt-kills-"))
    begun_s = time.monotonic()
    loop = KillLoop(folder, kills=arguments.kills, seed=arguments.seed, oldest_s=arguments.oldest)
    found = asyncio.run(loop.run())
    counts = {**loop.counts, **found.counts, "seconds": round(time.monotonic() - begun_s)}
    if arguments.json:
        violations = [violation._asdict() for violation in found.violations]
        print(json.dumps({"folder": str(folder), "counts": counts, "violations": violations}))
    else:
        print("| what | how many |\n|---|---|")
        for name, count in counts.items():
            print(f"| {name} | {count} |")
        print(f"\n{len(found.violations)} violations; everything is in {folder}")
        for violation in found.violations:
            print(f"{violation.check}: {violation.detail}")
    if found.violations:
        sys.exit(1)


class KillLoop:
    """The daemons of a demonstration and who kills them."""

    def __init__(self, folder: Path, *, kills: int, seed: int, oldest_s: float) -> None:
        self._kills = kills
        self._oldest_s = oldest_s
        self._random = random.Random(seed)  # noqa: S311 (instants, not secrets)
        self._seed = seed
        self._scenario = ScenarioConfig()
        self._files = write_demo_files(folder, self._scenario, folder / "poses.sock")
        self._demo = Demo(self._scenario, self._files, duration_s=WORLD_S, seed=seed, clock=SystemClock())
        self._folders = {"master": self._files.recordings} | {
            f"client {number}": self._files.journals(number) for number in self._files.stations
        }
        self._torn: set[Path] = set()
        self._killed: Counter[str] = Counter()
        self._pids: set[int] = set()
        self._problems: list[Violation] = []
        self.counts: Counter[str] = Counter()

    async def run(self) -> FileReport:
        """Run it all; return what was found."""
        air_rng, *instrument_rngs = np.random.default_rng(self._seed).spawn(1 + len(self._files.stations))
        timeline = LoopTimeline(asyncio.get_running_loop())
        places = {f"station{s.station}": s.position_m for s in self._scenario.stations}
        places["master"] = self._scenario.motion.area_centre_m
        link = scenario_link(self._scenario.radio, places, air_rng)
        instruments, lines = {}, []
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(AirServer(self._files.air_socket, link, air_rng))
            for station, rng in zip(self._scenario.stations, instrument_rngs, strict=True):
                instrument = SimulatedTotalStation(
                    station, self._scenario, self._demo.world, timeline, rng, start_ns=self._demo.start_ns
                )
                instruments[station.station] = instrument
                line = PtyLine(instrument, self._files.instrument_port(station.station))
                lines.append(await stack.enter_async_context(line))
            tasks = [asyncio.create_task(process.keep_running()) for process in self._demo.processes]
            try:
                await asyncio.gather(*(self._keep_killing(process) for process in self._demo.processes))
                queued = await self._drain(lines)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.wait(tasks)
        self._look_at_ends()
        found = check_files_after_kills(
            sorted(self._files.recordings.glob("*.jsonl")),
            {number: self._files.journals(number) for number in self._files.stations},
            {number: instrument.reported_distances for number, instrument in instruments.items()},
            queued,
        )
        found.violations[:0] = self._problems
        return found

    # --- Killing ----------------------------------------------------------------------------------------------

    async def _keep_killing(self, process: Process) -> None:
        while self._killed.total() < self._kills:
            await _until(lambda: process.pid is not None)
            young = self._random.random() < YOUNG_SHARE
            oldest_s = min(YOUNG_S, self._oldest_s) if young else self._oldest_s
            pid, age_s = process.pid, self._random.uniform(0.0, oldest_s)
            await asyncio.sleep(age_s)
            if process.pid == pid and self._killed.total() < self._kills:
                together = self._random.random() < TOGETHER_SHARE
                self.counts["times all were killed at once"] += together
                self.counts["kills within 5 s of the start"] += age_s < YOUNG_S
                await asyncio.gather(*map(self._kill, self._demo.processes if together else [process]))

    async def _kill(self, process: Process) -> None:
        pid = process.pid
        if pid is None or pid in self._pids:
            return
        self._pids.add(pid)
        os.kill(pid, signal.SIGKILL)
        self._killed[process.name] += 1
        self.counts["kills"] += 1
        self.counts[f"kills of {process.name}"] += 1
        print(f"{self.counts['kills']:4} {process.name}", file=sys.stderr, flush=True)
        await _until(lambda: process.pid != pid)
        if self._random.random() < TORN_SHARE:
            self._tear(self._folders[process.name])

    def _tear(self, folder: Path) -> None:
        """Put half a line behind the last one."""
        newest = max(folder.glob("*.jsonl"), key=lambda path: path.stat().st_mtime_ns, default=None)
        if newest is None or newest in self._torn:
            return
        *_, line = [HALF_HEADER, *newest.read_bytes().splitlines()]
        with newest.open("ab") as file:
            file.write(line[: self._random.randrange(1, len(line))])
        self._torn.add(newest)
        self.counts["torn by this program"] += 1

    # --- Afterwards -------------------------------------------------------------------------------------------

    async def _drain(self, lines: list[PtyLine]) -> dict[int, int]:
        """Let the daemons come back, unplug the instruments, and wait until the stations have delivered everything."""
        queued: dict[int, int] = dict.fromkeys(self._files.stations, -1)
        with suppress(TimeoutError):
            async with asyncio.timeout(DRAIN_LIMIT_S):
                for number in queued:
                    while await self._status(number, "measurements") < LAST_MEASUREMENTS:  # noqa: ASYNC110 (as below)
                        await asyncio.sleep(10 * POLL_S)
                for line in lines:
                    line.unplug()
                await asyncio.sleep(1.0)  # what was read before is in the journal and the queue by then
                while any(queued.values()):
                    await asyncio.sleep(10 * POLL_S)
                    queued = {number: await self._status(number, "queued") for number in queued}
        for number, left in queued.items():
            if left:
                detail = f"station {number}: {left} measurements not delivered within {DRAIN_LIMIT_S:g} s (-1: no status)"
                self._problems.append(Violation("liveness", detail))
        return queued

    async def _status(self, station: int, key: str) -> int:
        """Ask a client; -1 where it does not answer."""
        try:
            reader, writer = await asyncio.open_unix_connection(self._files.status_socket(station))
            line = await reader.readline()
            writer.close()
            return int(json.loads(line)[key])
        except (OSError, ValueError, TypeError):
            return -1

    def _look_at_ends(self) -> None:
        key = self._files.key.read_bytes().strip()
        for path in self._files.folder.rglob("*"):
            if path.is_file() and path != self._files.key and _holds(path, key):
                self._problems.append(Violation("key", f"{path} holds the key"))
        for process in self._demo.processes:
            if process.starts != self._killed[process.name] + 1:
                detail = (
                    f"{process.name} was started {process.starts} times and killed {self._killed[process.name]} times; "
                    f"see {process.log_path}"
                )
                self._problems.append(Violation("ended", detail))
            if b"Traceback" in process.log_path.read_bytes():
                self._problems.append(Violation("ended", f"{process.log_path} has a traceback"))


async def _until(condition: Callable[[], bool]) -> None:
    while not condition():  # noqa: ASYNC110 (neither time nor processes signal an event)
        await asyncio.sleep(POLL_S)


def _holds(path: Path, key: bytes) -> bool:
    content = path.read_bytes()
    return key in content.lower() or bytes.fromhex(key.decode()) in content
