"""The operator's page under planted faults: how soon the verdict follows, and whether a stale pose is ever shown as live.

The daemons of a demonstration run as processes; `tsgt web` serves real browsers of three sizes. Faults: a station, the master's radio, the
disk, the master (halted, killed), and a fence that the robot crosses. Needs root for the disk, which is a small one in memory, and chromium.

    python benchmarks/run.py web_faults [--screenshots FOLDER]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from harness.readers.browser import CHROMIUM, browser

from tsgt.clock import SystemClock
from tsgt.config import ScenarioConfig
from tsgt.recording.conditions import MAX_AGE_S, MAX_UNASKED_S
from tsgt.simulation.demo import Demo, DemoFiles, write_demo_files

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

    from harness.readers.browser import Tab

SIZES = ((1280, 800), (800, 1280), (390, 844))
SCHEMES = ("light", "dark")
DURATION_S = 240.0
FENCE_AFTER_S = 120.0
"""The other faults come before."""

DISK_MB = 600
"""Above what the page calls nearly full."""

GOOD_TIMEOUT_S = 60.0
FOLLOWS_S = 20.0
SETTLE_S = 4.0
SAMPLE_S = 0.1
STALE_S = 2.0

STATE = """[...["words", "cause"].map((id) => document.getElementById(id)?.textContent ?? ""),
document.getElementById("map")?.getAttribute("aria-label") ?? "",
[...document.querySelectorAll("#alarms li")].map((each) => each.textContent).join(" | ")]"""


@dataclass(frozen=True)
class Fault:
    """What happens, what the stream says of it, and what the page then says."""

    name: str
    plant: Callable[[], Awaitable[None]]
    repair: Callable[[], Awaitable[None]]
    told: Callable[[bytes], bool]
    shown: str
    settle_s: float = SETTLE_S


@dataclass
class Watch:
    """What the stream and the pages say, with times on one clock."""

    told: Callable[[bytes], bool] = field(default=lambda _: False)
    told_s: float | None = None
    valid_s: float = -np.inf
    """When the last valid live pose came."""
    samples: int = 0
    stale: list[str] = field(default_factory=list)
    """What was shown as live without one."""

    def expect(self, told: Callable[[bytes], bool]) -> None:
        """Note when the stream says something."""
        self.told, self.told_s = told, None

    def line(self, line: bytes) -> None:
        """Take a line of the stream."""
        now_s = time.monotonic()
        if b'"kind":"predicted"' in line and b'"valid":true' in line:
            self.valid_s = now_s
        if self.told_s is None and self.told(line):
            self.told_s = now_s

    async def look(self, tab: Tab) -> str:
        """Return the verdict that a page shows, with its alarms."""
        words, cause, label, alarms = await tab.run(STATE)
        self.samples += 1
        age_s = time.monotonic() - self.valid_s
        if age_s > STALE_S and (label.startswith("Map: robot at") or words in {"GOOD", "CARE"}):
            self.stale.append(f"{words}, {label}, {age_s:.1f} s after the last valid pose")
        return f"{words}: {cause}{' | ' if alarms else ''}{alarms}"


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--screenshots", type=Path, help="folder for screenshots of each fault at each size")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if CHROMIUM is None or os.geteuid() != 0:
        sys.exit("needs chromium (apt install chromium), and root for the small disk")
    if options.screenshots is not None:
        options.screenshots.mkdir(parents=True, exist_ok=True)
    asyncio.run(measure(options.seed, options.screenshots))


async def measure(seed: int, screenshots: Path | None) -> None:
    """Plant one fault after the other."""
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="wf-")))
        scenario = ScenarioConfig()
        files = write_demo_files(folder, scenario, folder / "poses.sock")
        disk = stack.enter_context(small_disk(files.recordings))
        demo = Demo(scenario, files, duration_s=DURATION_S, seed=seed, clock=SystemClock())
        radio = Cable(folder / "air-master.sock", files.air_socket)
        configure(files, radio, demo)
        watch = Watch()
        mission = asyncio.create_task(demo.run(watch.line))
        stack.push_async_callback(stopped, mission)
        await radio.plug()
        stack.push_async_callback(radio.unplug)
        url = await stack.enter_async_context(web(files.socket))
        window = await stack.enter_async_context(browser())
        tabs = [await stack.enter_async_context(window.tab(url, *size)) for size in SIZES]
        if screenshots is not None:
            await shown(tabs, watch, "GOOD|CARE", GOOD_TIMEOUT_S)
            await asyncio.sleep(SETTLE_S)
            await photograph(tabs, screenshots, "well")
        print(f"{'fault':<18} {'after it':>9} {'after the stream says so':>26}  verdict at last")
        for fault in faults(demo, radio, disk):
            await show(fault, watch, tabs, screenshots)
        print(f"{watch.samples} looks at the pages, {len(watch.stale)} with a stale pose as live")
        print("\n".join(watch.stale[:5]))


def faults(demo: Demo, radio: Cable, disk: Path) -> list[Fault]:
    """Return the faults in their order."""
    clients, master = demo.processes[:-1], demo.processes[-1]

    async def send(process: Any, number: signal.Signals) -> None:
        os.kill(process.pid, number)

    async def fill() -> None:
        await asyncio.to_thread(fill_disk, disk)

    async def free() -> None:
        await asyncio.to_thread(disk.unlink)

    async def nothing() -> None:
        pass

    return [
        Fault(
            "station lost", lambda: send(clients[1], signal.SIGSTOP), lambda: send(clients[1], signal.SIGCONT),
            silent, "(CARE|NO POSE): .*station 2.*silent",
        ),
        Fault("radio lost", radio.unplug, radio.plug, event("radio_failed"), "(CARE|NO POSE): the radio of the master failed"),
        Fault("disk full", fill, free, event("disk_full", "disk_failed"), "(CARE|NO POSE): .*(disk is full|nothing has been recorded)"),
        Fault(
            "master halted", lambda: send(master, signal.SIGSTOP), lambda: send(master, signal.SIGCONT),
            lambda _: False, "STREAM STOPPED: the master has sent nothing",
        ),
        Fault(
            "master killed", lambda: send(master, signal.SIGKILL), nothing, lambda _: False,
            "STREAM STOPPED: the stream has ended", 0.0,
        ),
        Fault(
            "fence crossed", nothing, nothing, lambda line: event("geofence_exited")(line) and b"beyond its limit" in line,
            "(CARE|NO POSE): .*\\b(outside|beyond the limit of) the geofence yard( |$)",
        ),
    ]  # fmt: skip


def fill_disk(path: Path) -> None:
    """Write a file until nothing more fits."""
    with path.open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(1 << 20))


def silent(line: bytes) -> bool:
    """Return whether a status says that nothing comes from station 2, as `tsgt status` judges."""
    if not line.startswith(b'{"type":"status"'):
        return False
    station = next(each for each in json.loads(line)["stations"] if each["id"] == 2)
    heard_s = station["last_heard_s"] or 0.0
    return heard_s > MAX_AGE_S and (not station["answering"] or heard_s > MAX_UNASKED_S)


def event(*names: str) -> Callable[[bytes], bool]:
    """Return whether a line is one of these events."""
    return lambda line: line.startswith(b'{"type":"event"') and json.loads(line)["event"] in names


async def show(fault: Fault, watch: Watch, tabs: list[Tab], screenshots: Path | None) -> None:
    """Plant a fault, wait until all pages show it, and repair it."""
    waits_for_truth = fault.name == "fence crossed"
    await shown(tabs, watch, f"(?!{fault.shown})(GOOD|CARE|NO POSE)", GOOD_TIMEOUT_S)
    watch.expect(fault.told)
    planted_s = time.monotonic()
    await fault.plant()
    try:
        at_s = await shown(tabs, watch, fault.shown, DURATION_S if waits_for_truth else FOLLOWS_S)
    except TimeoutError:
        print(f"{fault.name}: not shown, but {[await watch.look(tab) for tab in tabs]}")
        at_s = np.nan
    end_s = time.monotonic() + fault.settle_s
    while time.monotonic() < end_s:
        for tab in tabs:
            await watch.look(tab)
        await asyncio.sleep(SAMPLE_S)
    at_last = await watch.look(tabs[0])
    if screenshots is not None:
        await photograph(tabs, screenshots, fault.name.replace(" ", "-"))
    after = "-" if waits_for_truth else f"{at_s - planted_s:.1f} s"
    told = "-" if watch.told_s is None else f"{max(0.0, at_s - watch.told_s):.1f} s"
    print(f"{fault.name:<18} {after:>9} {told:>26}  {at_last}", flush=True)
    await fault.repair()


async def shown(tabs: list[Tab], watch: Watch, pattern: str, timeout_s: float) -> float:
    """Wait until all pages show a verdict; return when the last one did."""

    async def wait(tab: Tab) -> float:
        while not re.match(pattern, await watch.look(tab)):  # noqa: ASYNC110 (the page sends no events)
            await asyncio.sleep(SAMPLE_S)
        return time.monotonic()

    async with asyncio.timeout(timeout_s):
        return max(await asyncio.gather(*map(wait, tabs)))


async def photograph(tabs: list[Tab], folder: Path, name: str) -> None:
    """Write what the pages show, light and dark."""
    for scheme in SCHEMES:
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        for tab in tabs:
            await tab.call("Emulation.setEmulatedMedia", features=features)
        await asyncio.sleep(0.3)
        for tab, (width, height) in zip(tabs, SIZES, strict=True):
            (folder / f"{name}-{width}x{height}-{scheme}.png").write_bytes(await tab.screenshot())


def configure(files: DemoFiles, radio: Cable, demo: Demo) -> None:
    """Give the master a radio with a cable, and a fence that the robot crosses."""
    text = files.master_config.read_text().replace('"air.sock"', f'"{radio.path.name}"')
    files.master_config.write_text(f"{text}\n{fence(demo)}")


def fence(demo: Demo) -> str:
    """Return a fence that the robot leaves for the first time after :data:`FENCE_AFTER_S`: a line across its way."""
    times_s = np.arange(0.0, FENCE_AFTER_S + 100.0, 0.5)
    positions = demo.world.pose_at(times_s)[:, :2, 3]
    before = times_s < FENCE_AFTER_S
    best = (0.0, 0.0, 0.0)
    for angle in np.linspace(0, 2 * np.pi, 72, endpoint=False):
        along = positions @ (np.cos(angle), np.sin(angle))
        most = along[before].max()
        best = max(best, (along[~before].max() - most, angle, most))
    beyond, angle, most = best
    if beyond < 3.0:
        sys.exit("the robot stays where it was; choose another --seed")
    ahead, left = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    edge = ahead * (most + 1.5) + left * np.mean(positions @ left)
    corners = [
        edge + 500 * left,
        edge + 500 * left - 900 * ahead,
        edge - 500 * left - 900 * ahead,
        edge - 500 * left,
    ]
    polygon = [[round(float(x), 2) for x in corner] for corner in corners]
    return f'[[geofences]]\nname = "yard"\npolygon_m = {json.dumps(polygon)}\n'


class Cable:
    """Between the master and its radio."""

    def __init__(self, path: Path, air: Path) -> None:
        self.path = path
        self._air = air
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()

    async def plug(self) -> None:
        """Connect them."""
        self._server = await asyncio.start_unix_server(self._serve, self.path)

    async def unplug(self) -> None:
        """Cut the connection; nothing answers at the socket."""
        if self._server is not None:
            self._server.close()
        self.path.unlink(missing_ok=True)
        for writer in list(self._writers):
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_unix_connection(self._air)
        self._writers |= {writer, far_writer}
        await asyncio.gather(_copy(reader, far_writer), _copy(far_reader, writer))
        self._writers -= {writer, far_writer}


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(65_536):
            writer.write(data)
            await writer.drain()
    writer.close()


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """Mount a small disk; give the path of a file on it that may fill it."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", folder], check=True)  # noqa: S607
    try:
        yield folder / "ballast"
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)  # noqa: S607


@asynccontextmanager
async def web(stream: Path) -> AsyncIterator[str]:
    """Start the page; give its address."""
    command = (sys.executable, "-m", "tsgt", "web", "--port", "0", "--socket", str(stream))
    program = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
    try:
        assert program.stderr is not None  # noqa: S101 (it is a pipe)
        while not (found := re.match(rb"the page is at (\S+)", line := await program.stderr.readline())):
            if not line:
                sys.exit("tsgt web has ended")
        drain = asyncio.create_task(program.stderr.read())
        yield found[1].decode()
        drain.cancel()
    finally:
        program.kill()
        await program.wait()


async def stopped(task: asyncio.Task[None]) -> None:
    """End a task."""
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task


if __name__ == "__main__":
    sys.exit("run it by its name: python benchmarks/run.py web_faults")
