"""Clients over `classic` that are back within 0.75 s of a synchronisation, with a clock some milliseconds off.

In each run a master synchronises with one station a second time after 30 s. Shortly before, during or after that the client
is killed once or twice, is away for 0.5 to 0.75 s, and has a clock that is 1 to 6 ms off; up to half of the responses are
lost meanwhile. Prints the number of runs with a timestamp outside its bound, and the largest excess over it.

    python benchmarks/run.py classic_restarts [RUNS [FIRST_SEED]]
"""

from __future__ import annotations

import asyncio
import sys
from functools import partial
from random import Random

from harness.hardware.radios import MS
from harness.radio.single_station import SECOND, single_station

from tsgt.simulation.kernel import run_virtual

RUNS = 200
DURATION_S = 90.0
AROUND_S = (40.0, 46.0)  # the second synchronisation begins at about 42 s
LOSSY_BEFORE_S, LOSSY_AFTER_S = 2.0, 4.0


async def run(seed: int) -> tuple[int, int]:
    """Return the number of timestamps, and the largest excess of an error over its bound in ns; negative: within."""
    random = Random(seed)  # noqa: S311 (a simulation)
    kills_s = sorted(random.uniform(*AROUND_S) for _ in range(random.choice((1, 2))))
    first_s, loss = kills_s[0], random.choice((0.0, 0.2, 0.5))
    until_s = first_s + random.uniform(0.0, LOSSY_AFTER_S)
    async with single_station() as field:
        start_ns = field.clock.monotonic_ns()
        back_s: list[float] = []

        def before(_: bytes) -> int:
            now_s = (field.clock.monotonic_ns() - start_ns) / SECOND
            if field.station is None and now_s >= back_s[-1]:
                field.restart(round(random.choice((-1, 1)) * random.uniform(1.0, 6.0) * MS))
            elif field.station is not None and kills_s and now_s >= kills_s[0]:
                del kills_s[0]
                field.station = None
                back_s.append(now_s + random.uniform(0.5, 0.75))
            return 0

        def is_lost(_: bytes) -> bool:
            now_s = (field.clock.monotonic_ns() - start_ns) / SECOND
            return first_s - LOSSY_BEFORE_S < now_s < until_s and random.random() < loss

        field.before_request, field.is_lost = before, is_lost
        await asyncio.sleep(DURATION_S)
        beyond_ns = [abs(error_ns) - bound_ns for error_ns, bound_ns in field.timestamp_errors_ns]
    return len(beyond_ns), max(beyond_ns)


def main() -> None:
    """Print each run with a timestamp outside its bound, and their number."""
    chosen = [int(each) for each in sys.argv[1:]]
    runs, first = [*chosen, *(RUNS, 0)[len(chosen) :]]
    times, outside = 0, 0
    for seed in range(first, first + runs):
        count, beyond_ns = run_virtual(partial(run, seed))
        times += count
        if beyond_ns > 0:
            outside += 1
            print(f"seed {seed}: {beyond_ns / MS:.2f} ms beyond the bound", flush=True)
    print(f"{outside} of {runs} runs with a timestamp outside its bound; {times} timestamps")
