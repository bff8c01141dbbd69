"""Real-time endurance: the daemons of the demonstration for half an hour, with loss and restarts, and what they grow by.

Run it with ``python benchmarks/run.py endurance --minutes 30 --loss 0.05``. Air server, three clients and a master are
processes of their own, as are sockets, serial lines (pseudo-terminals), files and time real; radios and instruments are
simulated, as in ``tsgt demo``. The master is ended after one minute and killed after two, and then left alone; client 1
is killed and ended in turn every two minutes; the other clients and the air server run through. A reader follows the
stream, another one the relay, and a browser's connection the operator's page: both are processes of their own, too. At the end the instruments are unplugged, the stations have to deliver all they have, and files are checked.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from contextlib import AsyncExitStack, suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from harness.missions.kill_checks import check_files_after_kills

from missions.endurance_subscribers import Subscribers
from missions.endurance_watch import (
    Sample,
    Stream,
    beacons_ns,
    lossy_scenario,
    memory_slope,
)
from tsgt.clock import SystemClock
from tsgt.log import configure_logging
from tsgt.simulation.checks import Violation
from tsgt.simulation.demo import Demo, write_demo_files
from tsgt.simulation.instrument import PtyLine, SimulatedTotalStation
from tsgt.simulation.kernel import LoopTimeline

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.simulation.demo.processes import Process

WARM_UP_S = 300.0
"""What the daemons take in this time, or in a sixth of a shorter run, does not count as growth."""
SAMPLE_INTERVAL_S = 10.0
MASTER_ENDS_MINUTES = {1: signal.SIGTERM, 2: signal.SIGKILL}
CLIENT_ENDS_FROM_MINUTE = 3
"""Client 1's first end; every two minutes from then on."""
DRAIN_LIMIT_S = 120.0
JOIN_LIMIT_S = 60.0
LIMIT_BYTES = 1 << 20


def main() -> None:
    """Run it, print tables; fail if anything was not as it must be."""
    parser = argparse.ArgumentParser(description="Run the daemons for long and look at what they grow by.")
    parser.add_argument("--minutes", type=float, default=30.0, help="how long (default 30)")
    parser.add_argument("--loss", type=float, default=0.05, help="share of packets lost (default 0.05)")
    parser.add_argument("--seed", type=int, default=0, help="of drive, air and instruments (default 0)")
    parser.add_argument("--json", action="store_true", help="the result as JSON")
    arguments = parser.parse_args()
    configure_logging("error")
    folder = Path(tempfile.mkdtemp(prefix="tsgt-endurance-"))
    endurance = Endurance(folder, minutes=arguments.minutes, loss=arguments.loss, seed=arguments.seed)
    result = asyncio.run(endurance.run())
    (folder / "result.json").write_text(json.dumps(result))
    if arguments.json:
        print(json.dumps(result))
    else:
        _print(result)
        print(f"\neverything is in {folder}")
    if result["violations"]:
        sys.exit(1)


class Endurance:
    """The daemons, who ends them, and who watches."""

    def __init__(self, folder: Path, *, minutes: float, loss: float, seed: int) -> None:
        self._duration_s = 60 * minutes
        self._seed = seed
        self._loss = loss
        self._scenario = lossy_scenario(loss)
        self._files = write_demo_files(folder, self._scenario, folder / "poses.sock")
        world_s = self._duration_s + JOIN_LIMIT_S + DRAIN_LIMIT_S
        self._demo = Demo(self._scenario, self._files, duration_s=world_s, seed=seed, clock=SystemClock())
        self._instruments: dict[int, SimulatedTotalStation] = {}
        self._air_pid = 0
        self._began_s = 0.0
        self._samples: defaultdict[str, defaultdict[int, list[Sample]]] = defaultdict(
            lambda: defaultdict(list)
        )
        self._loads: list[float] = []
        self._streams: list[Stream] = []
        self._subscribers = Subscribers(folder, self._files.socket)
        self._ends: Counter[str] = Counter()
        self._said: defaultdict[int, dict[int, dict[str, Any]]] = defaultdict(dict)

    async def run(self) -> dict[str, Any]:
        """Run it all; return what was found."""
        instrument_rngs = np.random.default_rng(self._seed).spawn(len(self._files.stations))
        timeline = LoopTimeline(asyncio.get_running_loop())
        air = await asyncio.create_subprocess_exec(
            sys.executable,
            str(Path(__file__).with_name("endurance_watch.py")),
            *map(str, (self._files.air_socket, self._loss, self._seed)),
            stdin=asyncio.subprocess.PIPE,
        )
        self._air_pid = air.pid
        while not self._files.air_socket.exists():  # noqa: ASYNC110 (another process makes it)
            await asyncio.sleep(0.1)
        lines = []
        async with AsyncExitStack() as stack:
            stack.push_async_callback(air.communicate, b"")  # closes its standard input, and waits
            for station, rng in zip(self._scenario.stations, instrument_rngs, strict=True):
                instrument = SimulatedTotalStation(
                    station, self._scenario, self._demo.world, timeline, rng, start_ns=self._demo.start_ns
                )
                self._instruments[station.station] = instrument
                line = PtyLine(instrument, self._files.instrument_port(station.station))
                lines.append(await stack.enter_async_context(line))
            self._began_s = time.monotonic()
            daemons = [asyncio.create_task(process.keep_running()) for process in self._demo.processes]
            await stack.enter_async_context(self._subscribers)
            watching = [
                asyncio.create_task(each)
                for each in (
                    self._read(),
                    self._listen(),
                    self._sample(),
                    self._subscribers.follow_relay(),
                    self._subscribers.follow_page(),
                )
            ]
            ending = asyncio.create_task(self._end_daemons())
            try:
                done, _ = await asyncio.wait([ending, *watching], return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()  # what watches ends by an error alone
                for task in watching:
                    task.cancel()
                queued = await self._drain(lines)
                air_ended = air.returncode is not None
            finally:
                for task in (ending, *daemons, *watching):
                    task.cancel()
                await asyncio.wait([ending, *daemons, *watching])
        return self._result(queued, air_ended=air_ended)

    # --- While it runs ----------------------------------------------------------------------------------------

    async def _end_daemons(self) -> None:
        """End daemons as planned until the time is over."""
        client, master = self._demo.processes[0], self._demo.processes[-1]
        plan: list[tuple[float, Process, signal.Signals]] = [
            (60.0 * minute, master, how) for minute, how in MASTER_ENDS_MINUTES.items()
        ]
        client_ends_s = np.arange(60.0 * CLIENT_ENDS_FROM_MINUTE, self._duration_s - 30.0, 120.0)
        plan += [
            (float(at_s), client, signal.SIGTERM if number % 2 else signal.SIGKILL)
            for number, at_s in enumerate(client_ends_s)
        ]
        for at_s, process, how in plan:
            await self._show_until(at_s)
            if process.pid is not None:
                self._look(process.name, process.pid)
                os.kill(process.pid, how)
                self._ends[f"{process.name}: {how.name}"] += 1
        await self._show_until(self._duration_s)

    async def _show_until(self, until_s: float) -> None:
        """Show how far it has got, each second on a terminal and else each minute."""
        every_s = 1.0 if sys.stderr.isatty() else 60.0
        while (now_s := time.monotonic() - self._began_s) < until_s:
            done = round(30 * now_s / self._duration_s)
            memory = "  ".join(
                f"{name} {each[-1].rss_mb:.1f}"
                for name, lives in self._samples.items()
                for each in list(lives.values())[-1:]
            )
            line = f"[{'#' * done}{'.' * (30 - done)}] {now_s / 60:5.1f} min  load {os.getloadavg()[0]:4.1f}  MB: {memory}"
            print(f"\r{line}" if every_s == 1.0 else f"{line}\n", end="", file=sys.stderr, flush=True)
            await asyncio.sleep(min(every_s, until_s - now_s))

    async def _sample(self) -> None:
        while True:
            self._loads.append(os.getloadavg()[0])
            self._look("air server", self._air_pid)
            for name, pid in self._subscribers.pids.items():
                self._look(name, pid)
            for process in self._demo.processes:
                if process.pid is not None:
                    self._look(process.name, process.pid)
            await asyncio.sleep(SAMPLE_INTERVAL_S)

    def _look(self, name: str, pid: int) -> None:
        with suppress(OSError):
            sample = Sample.of(pid, time.monotonic() - self._began_s)
            self._samples[name][pid].append(sample)

    async def _listen(self) -> None:
        """Ask each client each second how it does; keep the first and the last word of each of its lives."""
        while True:
            for number, process in zip(self._files.stations, self._demo.processes, strict=False):
                said = await self._status(number)
                if said is not None:
                    life = self._said[number].setdefault(process.starts, {"first_ns": time.time_ns()})
                    life.update(said, last_ns=time.time_ns())
            await asyncio.sleep(1.0)

    async def _read(self) -> None:
        """Follow the stream, also of a master that was started again."""
        while True:
            with suppress(OSError):
                reader, writer = await asyncio.open_unix_connection(self._files.socket, limit=LIMIT_BYTES)
                self._streams.append(stream := Stream())
                try:
                    while line := await reader.readline():
                        stream.take(json.loads(line))
                finally:
                    writer.close()
            await asyncio.sleep(0.2)

    async def _drain(self, lines: Sequence[PtyLine]) -> dict[int, int]:
        """Unplug the instruments and wait until the stations have delivered everything; -1 without an answer."""
        for line in lines:
            line.unplug()
        await asyncio.sleep(1.0)  # what was read before is in the journal and the queue by then
        queued = dict.fromkeys(self._files.stations, -1)
        with suppress(TimeoutError):
            async with asyncio.timeout(DRAIN_LIMIT_S):
                while any(queued.values()):
                    await asyncio.sleep(0.1)
                    for number in queued:
                        said = await self._status(number)
                        queued[number] = -1 if said is None else said["queued"]
        return queued

    async def _status(self, station: int) -> dict[str, Any] | None:
        """Ask a client; None where it does not answer."""
        try:
            reader, writer = await asyncio.open_unix_connection(
                self._files.status_socket(station), limit=LIMIT_BYTES
            )
            try:
                said = json.loads(await reader.readline())
            finally:
                writer.close()
        except (OSError, ValueError):
            return None
        return {key: said[key] for key in ("missed_slots", "queued", "rate_hz", "measurements")}

    # --- Afterwards -------------------------------------------------------------------------------------------

    def _result(self, queued: dict[int, int], *, air_ended: bool) -> dict[str, Any]:
        recordings = sorted(self._files.recordings.glob("*.jsonl"))
        found = check_files_after_kills(
            recordings,
            {number: self._files.journals(number) for number in self._files.stations},
            {number: instrument.reported_distances for number, instrument in self._instruments.items()},
            queued,
        )
        found.violations += self._wrong_ends(queued)
        if air_ended:
            found.violations.append(Violation("ended", "the air server has ended"))
        read = sum(len(epochs) for each in self._streams for epochs in each.epochs_ns.values())
        found.violations += (
            Violation("passed on", what) for what in self._subscribers.failures(recordings, read)
        )
        stream, period_ns = self._streams[-1], round(1e9 / self._scenario.pipeline.rate_hz)
        return {
            "minutes": self._duration_s / 60,
            "load": {"mean": float(np.mean(self._loads)), "highest": max(self._loads)},
            "ends": dict(self._ends),
            "daemons": [self._grown(name, lives) for name, lives in self._samples.items()],
            "stations": [self._station(number, beacons_ns(recordings)) for number in self._files.stations],
            "stream": {
                "connections": len(self._streams),
                "away_s": [after.first_s - before.last_s for before, after in pairwise(self._streams)],
                "lines_lost": sum(each.lost for each in self._streams),
                "longest_pause_s": stream.longest_pause_s,
                "poses": {
                    kind: {
                        "valid_share": stream.valid[kind] / len(epochs_ns),
                        "count": len(epochs_ns),
                        "missing_epochs": stream.missing_epochs(kind, period_ns),
                    }
                    for kind, epochs_ns in stream.epochs_ns.items()
                },
                "invalid": {reason: count for reason, count in stream.reasons.items() if count},
            },
            "subscribers": self._subscribers.counts(),
            "counts": dict(found.counts),
            "violations": [violation._asdict() for violation in found.violations],
            "samples": {
                name: {
                    pid: [(s.at_s, s.rss_mb, s.cpu_s, s.files) for s in life] for pid, life in lives.items()
                }
                for name, lives in self._samples.items()
            },
        }

    def _wrong_ends(self, queued: dict[int, int]) -> list[Violation]:
        wrong = [
            Violation(
                "liveness",
                f"station {number}: {left} not delivered within {DRAIN_LIMIT_S:g} s (-1: no status)",
            )
            for number, left in queued.items()
            if left
        ]
        for process in self._demo.processes:
            ends = sum(count for what, count in self._ends.items() if what.startswith(process.name))
            if process.starts != ends + 1:
                detail = f"{process.name} was started {process.starts} times and ended {ends} times; see {process.log_path}"
                wrong.append(Violation("ended", detail))
            if b"Traceback" in process.log_path.read_bytes():
                wrong.append(Violation("ended", f"{process.log_path} has a traceback"))
        return wrong

    def _grown(self, name: str, lives: dict[int, list[Sample]]) -> dict[str, Any]:
        """Memory of a daemon that has run through since it was warm, and its slope; CPU of all its lives."""
        last = list(lives.values())[-1]
        warm_s = min(WARM_UP_S, self._duration_s / 6)
        through = last[0].at_s < warm_s
        warm = [each for each in last if each.at_s >= warm_s]
        half = [each for each in warm if each.at_s >= (warm_s + warm[-1].at_s) / 2]
        lived_s = sum(each[-1].at_s - each[0].at_s for each in lives.values())
        return {
            "name": name,
            "lives": len(lives),
            "age_min": (last[-1].at_s - last[0].at_s) / 60,
            "first_mb": warm[0].rss_mb,
            "last_mb": warm[-1].rss_mb,
            "slope_mb_per_h": memory_slope(warm) if through else None,
            "late_slope_mb_per_h": memory_slope(half) if through else None,
            "first_files": warm[0].files,
            "last_files": warm[-1].files,
            "cpu_share": sum(each[-1].cpu_s for each in lives.values()) / max(1.0, lived_s),
        }

    def _station(self, number: int, beacons_ns: Sequence[int]) -> dict[str, Any]:
        lives = self._said[number].values()
        slots = sum(life["first_ns"] <= at_ns <= life["last_ns"] for at_ns in beacons_ns for life in lives)
        late = sum(life["missed_slots"] for life in lives)
        ages_s = self._streams[-1].ages_s[number]
        return {
            "station": number,
            "slots": slots,
            "late": late,
            "late_share": late / max(1, slots),
            "late_by_master": self._streams[-1].late.get(number),
            "measured": sum(life["measurements"] for life in lives),
            "rate_hz": [life["rate_hz"] for life in lives][-1],
            "delivered_hz": len(ages_s) / (self._streams[-1].last_s - self._streams[-1].first_s),
            "age_p50_s": float(np.median(ages_s)),
            "age_p99_s": float(np.percentile(ages_s, 99)),
        }


def _print(result: dict[str, Any]) -> None:
    load, stream = result["load"], result["stream"]
    print(f"\n{result['minutes']:g} minutes, load average {load['mean']:.1f}, at most {load['highest']:.1f}")
    print("ended: " + ", ".join(f"{count} x {what}" for what, count in result["ends"].items()))
    print(
        "\n| daemon | lives | age min | MB then | MB at the end | slope MB/h | of the second half | files | CPU |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for each in result["daemons"]:
        slopes = [
            "" if each[key] is None else f"{each[key]:+.2f}"
            for key in ("slope_mb_per_h", "late_slope_mb_per_h")
        ]
        print(
            f"| {each['name']} | {each['lives']} | {each['age_min']:.1f} | {each['first_mb']:.1f} | "
            f"{each['last_mb']:.1f} | {slopes[0]} | {slopes[1]} | "
            f"{each['first_files']} to {each['last_files']} | {each['cpu_share']:.1%} |"
        )
    print(
        "\n| station | slots | late | share | late, says the master | measured | delivered Hz | age p50 / p99 ms |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for each in result["stations"]:
        print(
            f"| {each['station']} | {each['slots']} | {each['late']} | {each['late_share']:.2%} | "
            f"{each['late_by_master']} | {each['measured']} | {each['delivered_hz']:.2f} | "
            f"{1e3 * each['age_p50_s']:.0f} / {1e3 * each['age_p99_s']:.0f} |"
        )
    away = ", ".join(f"{each:.1f}" for each in stream["away_s"])
    print(
        f"\nstream: {stream['connections']} connections, {away} s from one to the next one's first pose; in the last one "
        f"{stream['longest_pause_s']:.2f} s without a line at most, {stream['lines_lost']} lines lost"
    )
    for kind, each in stream["poses"].items():
        print(
            f"  {kind}: {each['count']}, {each['valid_share']:.2%} valid, {each['missing_epochs']} epochs missing"
        )
    print(f"  invalid because: {stream['invalid'] or 'none was'}")
    print("subscribers: " + ", ".join(f"{count} {what}" for what, count in result["subscribers"].items()))
    print("files: " + ", ".join(f"{count} {what}" for what, count in result["counts"].items()))
    print(f"{len(result['violations'])} violations")
    for each in result["violations"]:
        print(f"{each['check']}: {each['detail']}")
