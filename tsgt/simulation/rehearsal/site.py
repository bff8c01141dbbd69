"""The site: daemons as processes, simulated instruments with a helper each, a robot that waits, and things that go wrong."""

from __future__ import annotations

import asyncio
import math
import os
import signal
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import numpy as np

from tsgt.simulation.demo import write_demo_files
from tsgt.simulation.demo.processes import Process
from tsgt.simulation.instrument import PtyLine, SimulatedTotalStation
from tsgt.simulation.kernel import LoopTimeline
from tsgt.simulation.lora import AirServer, scenario_link
from tsgt.simulation.rehearsal.helper import Helper
from tsgt.simulation.rehearsal.scenario import MOVED_TRIPOD, REGION, SCENARIO, TARGETS
from tsgt.simulation.rehearsal.scripts import ORDERS, write_scripts
from tsgt.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.clock import Clock

DURATION_S = 3600.0
"""Longest time that the robot drives; it stands before and afterwards."""

_LOOK_S = 0.05

_LOW_BATTERY, _FRESH_BATTERY = 15.0, 95.0


class _WaitingWorld(World):
    """A world whose robot stands until :attr:`start_s`, in s from the start of the site."""

    start_s = math.inf

    def pose_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the poses as :meth:`World.pose_at`, later by the wait."""
        times_s = np.asarray(times_s, dtype=np.float64)
        waited_s = times_s - self.start_s if math.isfinite(self.start_s) else np.zeros_like(times_s)
        return super().pose_at(np.clip(waited_s, 0.0, self.duration_s))


def _tolerate_a_busy_computer(master_config: Path) -> None:
    """Give stations more time for their slots: all daemons share one computer here."""
    text = master_config.read_text()
    slots = "start_jitter_ms = 25.0  # five daemons share a computer\nturnaround_ms = 25.0\n"
    master_config.write_text(text.replace("[protocol]\n", f"[protocol]\n{slots}", 1))


class Site:
    """A site in real time; :meth:`open` runs it.

    Attributes
    ----------
    files
        Configuration of the daemons in the folder, written here, without station frames.
    start_ns
        CLOCK_MONOTONIC at the start of the world.
    instruments
        By station.
    """

    def __init__(self, folder: Path, *, seed: int, clock: Clock) -> None:
        self._clock = clock
        self.files = write_demo_files(folder, SCENARIO, folder / "poses.sock", region=REGION)
        (folder / "station_frames.toml").unlink()
        _tolerate_a_busy_computer(self.files.master_config)
        write_scripts(folder)
        self._folder = folder
        world_rng, self._air_rng, *self._instrument_rngs = np.random.default_rng(seed).spawn(
            2 + len(SCENARIO.stations)
        )
        prisms_m = np.array([prism.position_m for prism in SCENARIO.prisms])
        self.world = _WaitingWorld(SCENARIO.motion, prisms_m, DURATION_S, world_rng)
        self.start_ns = clock.monotonic_ns()
        self.instruments: dict[int, SimulatedTotalStation] = {}
        self._helpers: dict[int, Helper] = {}
        self._stations = {station.station: station for station in SCENARIO.stations}
        self.master = Process(
            "master", "main_master", ("--config", str(self.files.master_config)), folder / "master.log"
        )
        self._clients = [
            Process(
                f"client {station}",
                "main_client",
                ("--config", str(self.files.client_config(station))),
                folder / f"client{station}.log",
            )
            for station in self.files.stations
        ]
        self._running: dict[str, asyncio.Task[None]] = {}

    def now_s(self) -> float:
        """Return the time since the start of the world."""
        return (self._clock.monotonic_ns() - self.start_ns) / 1e9

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[None]:
        """Run channel, instruments, helpers and daemons; raises StreamError if a socket cannot be created."""
        timeline = LoopTimeline(asyncio.get_running_loop())
        async with AsyncExitStack() as stack:
            positions_m = {f"station{s.station}": s.position_m for s in SCENARIO.stations}
            positions_m["master"] = SCENARIO.motion.area_centre_m
            link = scenario_link(SCENARIO.radio, positions_m, self._air_rng)
            await stack.enter_async_context(AirServer(self.files.air_socket, link, self._air_rng))
            for station, rng in zip(SCENARIO.stations, self._instrument_rngs, strict=True):
                number = station.station
                instrument = SimulatedTotalStation(
                    station, SCENARIO, self.world, timeline, rng, start_ns=self.start_ns
                )
                self.instruments[number] = instrument
                self._helpers[number] = Helper(instrument, number, station.prism, self._folder, TARGETS)
                await stack.enter_async_context(PtyLine(instrument, self.files.instrument_port(number)))
            for process in (*self._clients, self.master):
                self._start(process)
            helping = asyncio.create_task(self._help())
            orders = self._open_orders()
            try:
                yield
            finally:
                self._close_orders(orders)
                helping.cancel()
                for task in self._running.values():
                    task.cancel()
                await asyncio.wait([helping, *self._running.values()])

    # --- What happens ------------------------------------------------------------------------------------------

    def start_driving(self) -> None:
        """Let the robot drive from now on."""
        self.world.start_s = self.now_s()
        for number, instrument in self.instruments.items():
            instrument.set_up_at(self._stations[number])  # it has looked ahead at a robot that stands

    def hide_prism(self, station: int) -> None:
        """Park something in the line of sight, until the helper clears it."""
        self.instruments[station].blocked = True

    def drain_battery(self, station: int) -> None:
        """Leave little charge in the battery of an instrument; it warns, as its client asks every minute."""
        self.instruments[station].battery_percent = _LOW_BATTERY

    def switch_off(self, station: int) -> None:
        """Let the battery of an instrument end, until the helper changes it."""
        self.instruments[station].switch_off()

    def move_tripod(self) -> None:
        """Let somebody lift a tripod out of his way and put it back."""
        self._stations[MOVED_TRIPOD.station] = MOVED_TRIPOD
        self.instruments[MOVED_TRIPOD.station].set_up_at(MOVED_TRIPOD)

    async def order(self, words: str) -> None:
        """Do what a script in the folder asks for; what makes no sense is ignored."""
        verb, *rest = words.split() or [""]
        numbers = [int(word) for word in rest if word.isdecimal()]
        station = self.instruments.get(numbers[0]) if numbers else None
        match verb:
            case "start":
                self._start(self.master)
            case "stop":
                await self._stop(self.master)
            case "reload" if self.master.pid is not None:
                os.kill(self.master.pid, signal.SIGUSR1)
            case "aim" if station is not None and len(numbers) == 2 and 1 <= numbers[1] <= TARGETS:
                self._helpers[numbers[0]].aim(numbers[1])
            case "clear" if station is not None:
                station.blocked = False
            case "battery" if station is not None:
                station.battery_percent = _FRESH_BATTERY
                station.switch_on()

    # --- How -------------------------------------------------------------------------------------------------

    def _start(self, process: Process) -> None:
        if process.name not in self._running:
            self._running[process.name] = asyncio.create_task(process.keep_running())

    async def _stop(self, process: Process) -> None:
        if (task := self._running.pop(process.name, None)) is not None:
            task.cancel()
            await asyncio.wait([task])

    async def _help(self) -> None:
        while True:
            for helper in self._helpers.values():
                helper.look(self.now_s())
            await asyncio.sleep(_LOOK_S)

    def _open_orders(self) -> int:
        path = self._folder / ORDERS
        os.mkfifo(path, 0o600)
        # Open for writing as well: else it ends with each writer.
        orders = os.open(path, os.O_RDWR | os.O_NONBLOCK)
        tasks: set[asyncio.Task[None]] = set()

        def read() -> None:
            for line in os.read(orders, 4096).decode(errors="replace").splitlines():
                task = asyncio.create_task(self.order(line))
                tasks.add(task)
                task.add_done_callback(tasks.discard)

        asyncio.get_running_loop().add_reader(orders, read)
        return orders

    def _close_orders(self, orders: int) -> None:
        asyncio.get_running_loop().remove_reader(orders)
        os.close(orders)
        (self._folder / ORDERS).unlink()
