"""The operator's page with five browsers: processor time and memory of `tsgt web`, and what it costs the stream's server.

A recording's lines are served on a socket at their pace, again and again, first without `tsgt web`, then with it, five readers of the page and one
that stalls. All readers are in a process of their own. With --chromium they are real browsers that show the page; the sixth is stopped (SIGSTOP) in the
second half. With --foxglove a Foxglove app reads everything instead of them.

    tsgt simulate dynamic --duration 180 --seed 1 --output R.jsonl
    python benchmarks/run.py web R.jsonl --seconds 600 [--chromium | --foxglove]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import socket
import statistics
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import AsyncExitStack
from itertools import count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import aiohttp
from harness.readers.browser import CHROMIUM, browser
from harness.readers.foxglove import app

from tsgt.master.stream_server import StreamServer
from tsgt.recording import HelloRecord, encode_line
from tsgt.web.recorded import index_of

if TYPE_CHECKING:
    from collections.abc import Callable

BROWSERS = 5
STAMP = re.compile(rb'("stamp_ns":)(\d+)')
BASELINE_S = 60.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
START_S = 60.0
REST_S = 5.0
"""After the sixth browser is stopped, until the others' messages count for the second half."""

Gaps = dict[str, list[float]]
"""Times between messages of the page, in s, by what happened meanwhile."""
ALL_RUN, ONE_STOPPED = "all run", "one is stopped"

WATCH = """
window.arrivals = [];
window.EventSource = class extends EventSource {
  constructor(url) { super(url); this.addEventListener("message", () => window.arrivals.push(performance.now() / 1000)); }
};
"""
"""Notes when the page gets its messages."""


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--chromium", action="store_true", help="real browsers (apt install chromium)")
    parser.add_argument("--foxglove", action="store_true", help="a Foxglove app instead (extra foxglove)")
    options = parser.parse_args()
    if options.chromium and CHROMIUM is None:
        sys.exit("chromium is not installed: apt install chromium")
    readers_of = follow if options.foxglove else show_all if options.chromium else read_all
    with ProcessPoolExecutor(1) as pool:
        asyncio.run(measure(options.recording, options.seconds, pool, readers_of))


async def measure(
    recording: Path, seconds: float, pool: ProcessPoolExecutor, readers_of: Callable[[str, float], Gaps]
) -> None:
    """Serve the stream, without the page and with it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.sock"
        async with StreamServer(path, encode_line(HelloRecord())) as server:
            play = asyncio.create_task(serve(server, recording))
            baseline_s = min(BASELINE_S, seconds)
            before = await share(os.getpid(), baseline_s)
            program = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "tsgt",
                "web",
                "--socket",
                str(path),
                "--port",
                "0",
                *(["--foxglove"] if readers_of is follow else []),
                stderr=asyncio.subprocess.PIPE,
            )
            try:
                url = await address(program)
                found = asyncio.get_running_loop().run_in_executor(pool, readers_of, url, seconds)
                await asyncio.sleep(1)
                with_page, page = await asyncio.gather(
                    share(os.getpid(), seconds - 2), share(program.pid, seconds - 2)
                )
                peak_mb, now_mb = memory_mb(program.pid)
                gaps = await found
            finally:
                program.kill()
                await program.wait()
                play.cancel()
                await asyncio.gather(play, return_exceptions=True)
    readers = "a Foxglove app" if readers_of is follow else f"{BROWSERS} readers and a stalled one"
    print(f"{seconds:.0f} s, {readers}")
    print(f"tsgt web: {100 * page:.2f} % of a core, {now_mb:.1f} MB, at most {peak_mb:.1f} MB")
    print(f"server of the stream: {100 * before:.2f} % of a core without it, {100 * with_page:.2f} % with it")
    for when, each in gaps.items():
        ordered = sorted(each)
        print(
            f"{when}: {len(each)} messages, gaps median {1e3 * statistics.median(each):.0f} ms, "
            f"99 % {1e3 * ordered[int(0.99 * len(ordered))]:.0f} ms, most {1e3 * ordered[-1]:.0f} ms"
        )


async def address(program: asyncio.subprocess.Process) -> str:
    """Return where the page is, as the program prints it."""
    while program.stderr is not None and (line := await program.stderr.readline()):
        if found := re.match(r"the page is at (\S+)", line.decode()):
            return found[1]
    sys.exit("tsgt web has ended")


async def serve(server: StreamServer, recording: Path) -> None:
    """Publish the lines of a recording at their pace, again and again, with times that go on."""
    index = index_of(recording)
    server.publish(next(line for _, line in index.lasting if line.startswith(b'{"type":"setup"')).strip())
    start_s = time.monotonic()
    for number in count():
        played_s = number * index.length_s
        for at_s, line in index.lines(0.0):
            if played_s + at_s > (now_s := time.monotonic() - start_s):
                await asyncio.sleep(played_s + at_s - now_s)
            if line.startswith((b'{"type":"recording"', b'{"type":"parameters"', b'{"type":"setup"')):
                continue
            server.publish(later(line.strip(), round(played_s * 1e9)))


def later(line: bytes, by_ns: int) -> bytes:
    """Return a line with a later time."""
    return STAMP.sub(lambda found: b"%s%d" % (found[1], int(found[2]) + by_ns), line, count=1)


async def share(process: int, seconds: float) -> float:
    """Return the share of a core that a process takes."""
    before, start_s = cpu_s(process), time.monotonic()
    await asyncio.sleep(seconds)
    return (cpu_s(process) - before) / (time.monotonic() - start_s)


def cpu_s(process: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def memory_mb(process: int) -> tuple[float, float]:
    """Return the largest and the present resident memory of a process."""
    text = Path(f"/proc/{process}/status").read_text()
    peak, now = (int(re.findall(rf"{name}:\s+(\d+)", text)[0]) / 1024 for name in ("VmHWM", "VmRSS"))
    return peak, now


def read_all(url: str, seconds: float) -> Gaps:
    """Return the times between messages, as five readers get them, beside one that stalls."""
    return asyncio.run(_read_all(url, seconds))


async def _read_all(url: str, seconds: float) -> Gaps:
    host = urlsplit(url)
    stalled = socket.socket()
    stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    stalled.connect((host.hostname, host.port))
    stalled.send(f"GET /stream HTTP/1.1\r\nHost: {host.netloc}\r\n\r\n".encode())
    async with aiohttp.ClientSession() as session:
        found = await asyncio.gather(*(_read(session, url, seconds) for _ in range(BROWSERS)))
    stalled.close()
    return {ONE_STOPPED: [gap for gaps in found for gap in gaps]}


async def _read(session: aiohttp.ClientSession, url: str, seconds: float) -> list[float]:
    times: list[float] = []
    end_s = time.monotonic() + seconds
    async with session.get(f"{url}stream", timeout=aiohttp.ClientTimeout()) as response:
        while time.monotonic() < end_s:
            line = await response.content.readuntil(b"\n\n")
            if "view" in json.loads(line.removeprefix(b"data: ")):
                times.append(time.monotonic())
    return [b - a for a, b in pairwise(times)]


def show_all(url: str, seconds: float) -> Gaps:
    """Return the times between messages, as the page gets them in five browsers; a sixth is stopped halfway."""
    return asyncio.run(_show_all(url, seconds))


async def _show_all(url: str, seconds: float) -> Gaps:
    end_s = time.monotonic() + seconds
    gaps: Gaps = {}
    async with AsyncExitStack() as stack:
        windows = [await stack.enter_async_context(browser()) for _ in range(BROWSERS + 1)]
        tabs = [await stack.enter_async_context(window.tab(url, first=WATCH)) for window in windows]
        sixth, last = tabs.pop(), windows.pop()
        for tab in (*tabs, sixth):
            await tab.wait("window.arrivals?.length > 10", START_S)
        for when, until_s in ((ALL_RUN, end_s - seconds / 2), (ONE_STOPPED, end_s)):
            if when == ONE_STOPPED:
                last.freeze()
                await asyncio.sleep(REST_S)
            for tab in tabs:
                await tab.run("window.arrivals = []")
            await asyncio.sleep(until_s - time.monotonic())
            times = [await tab.run("window.arrivals") for tab in tabs]
            gaps[when] = [b - a for each in times for a, b in pairwise(each)]
        last.thaw()
        await sixth.wait("window.arrivals.length > 0", START_S)
    return gaps


def follow(url: str, seconds: float) -> Gaps:
    """Return the times between poses, as a Foxglove app gets them that has subscribed to everything."""
    return asyncio.run(_follow(url, seconds))


async def _follow(url: str, seconds: float) -> Gaps:
    times: list[float] = []
    end_s = time.monotonic() + seconds
    async with app(f"{url}foxglove") as one:
        await one.subscribe(*one.channels)
        while time.monotonic() < end_s:
            if (await one.message())[0] == "/tsgt/pose":
                times.append(time.monotonic())
    return {"poses": [b - a for a, b in pairwise(times)]}


if __name__ == "__main__":
    sys.exit("run it by its name: python benchmarks/run.py web")
