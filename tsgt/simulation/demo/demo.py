"""Runs the daemons as processes, with channel, instruments and robot simulated in this process.

Everything outside the daemons' radios and instruments is real: sockets, serial ports (pseudo-terminals), files, signals,
time. A daemon can be killed and restarted as in the field.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import scenario_parameters
from tsgt.errors import StreamError
from tsgt.recording import MAX_LINE_BYTES
from tsgt.simulation.demo.imu import ImuServer
from tsgt.simulation.demo.processes import Process
from tsgt.simulation.imu import IMU_MODELS, ImuProgram, simulate_imu
from tsgt.simulation.instrument import PtyLine, SimulatedTotalStation
from tsgt.simulation.kernel import LoopTimeline
from tsgt.simulation.lora import AirServer, scenario_link
from tsgt.simulation.world import is_shaken, scenario_world

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.config import ScenarioConfig
    from tsgt.simulation.demo.config_files import DemoFiles
    from tsgt.simulation.imu import DeviceSamples
    from tsgt.simulation.lora import LinkModel

STARTUP_TIMEOUT_S = 60.0
"""From the start of the daemons to the first pose; a slow machine takes five seconds."""

_SHAKING_SEED = 0x5A
_RECONNECT_DELAY_S = 0.2
_FINAL_READ_TIMEOUT_S = 2.0


class Demo:
    """A scenario in real time.

    Parameters
    ----------
    files
        Configuration of the daemons, already written.
    duration_s
        From the first pose to the end.
    clock
        CLOCK_MONOTONIC of this machine, which all processes share.

    Attributes
    ----------
    world
        Ground truth; its zero is ``start_ns``.
    parameters
        The master's parameters, which its configuration states.
    processes
        The clients in the order of the stations, then the master.
    """

    def __init__(
        self, scenario: ScenarioConfig, files: DemoFiles, *, duration_s: float, seed: int, clock: Clock
    ) -> None:
        self._scenario = scenario
        self._files = files
        self._duration_s = duration_s
        self._clock = clock
        world_rng, self._air_rng, *self._instrument_rngs = np.random.default_rng(seed).spawn(
            2 + len(scenario.stations)
        )
        self.world = scenario_world(scenario, duration_s + STARTUP_TIMEOUT_S + 10, world_rng)
        self.parameters = scenario_parameters(scenario)
        self._imu = None if scenario.imu.model == "none" else self._simulated_imu(duration_s, seed)
        self.start_ns = clock.monotonic_ns()  # CLOCK_MONOTONIC at the start of the world, in ns
        self.processes = [
            Process(
                f"client {station}",
                "main_client",
                ("--config", str(files.client_config(station))),
                files.folder / f"client{station}.log",
            )
            for station in files.stations
        ]
        self.processes.append(
            Process(
                "master",
                "main_master",
                ("--config", str(files.master_config)),
                files.folder / "master.log",
            )
        )
        self._first_pose = asyncio.Event()
        self._ending = False

    async def run(self, on_line: Callable[[bytes], None]) -> None:
        """Run to the end or until cancelled; stops the daemons in either case. ``on_line`` gets the lines of the master's stream.

        Raises
        ------
        StreamError
            A socket cannot be created, or no pose arrives.
        """
        timeline = LoopTimeline(asyncio.get_running_loop())
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(AirServer(self._files.air_socket, self._link(), self._air_rng))
            for station, rng in zip(self._scenario.stations, self._instrument_rngs, strict=True):
                instrument = SimulatedTotalStation(
                    station, self._scenario, self.world, timeline, rng, start_ns=self.start_ns
                )
                port = self._files.instrument_port(station.station)
                await stack.enter_async_context(PtyLine(instrument, port))
            if self._imu is not None:
                # The samples on CLOCK_MONOTONIC.
                samples = replace(self._imu, arrival_s=self._imu.arrival_s + self.start_ns / 1e9)
                program = ImuProgram(IMU_MODELS[self._scenario.imu.model], samples, self._clock)
                await stack.enter_async_context(ImuServer(self._files.imu_socket, program, self._clock))
            tasks = [asyncio.create_task(process.keep_running()) for process in self.processes]
            reading = asyncio.create_task(self._read(on_line))
            try:
                await self._wait_until_end()
            finally:
                self._ending = True
                for task in tasks:
                    task.cancel()
                await asyncio.wait(tasks)
                await asyncio.wait([reading], timeout=_FINAL_READ_TIMEOUT_S)
                reading.cancel()
                await asyncio.wait([reading])

    def _simulated_imu(self, duration_s: float, seed: int) -> DeviceSamples:
        """Shake the robot, simulate its IMU, and add that to the configuration of the master."""
        scenario = self._scenario
        if is_shaken(scenario):
            shaking_rng = np.random.default_rng([seed, _SHAKING_SEED])
            self.world.shake(scenario.shaking, np.array(scenario.imu.position_m), shaking_rng)
        run = simulate_imu(scenario.imu, self.world.motion_at, duration_s + STARTUP_TIMEOUT_S, seed=[seed])
        self.parameters = replace(self.parameters, imu=run.parameters)
        self._files.add_imu(run.parameters, scenario.imu.model)
        return run.samples

    def _link(self) -> LinkModel:
        """Return the scenario's link model; the robot's radio stays at the centre of its area."""
        positions_m = {f"station{s.station}": s.position_m for s in self._scenario.stations}
        positions_m["master"] = self._scenario.motion.area_centre_m
        return scenario_link(self._scenario.radio, positions_m, self._air_rng)

    async def _wait_until_end(self) -> None:
        try:
            async with asyncio.timeout(STARTUP_TIMEOUT_S):
                await self._first_pose.wait()
        except TimeoutError:
            raise StreamError(
                f"{self._files.folder}: no pose within {STARTUP_TIMEOUT_S:g} s; see the logs in this folder"
            ) from None
        await asyncio.sleep(self._duration_s)

    async def _read(self, on_line: Callable[[bytes], None]) -> None:
        """Read the stream until the end; reconnect after a restart of the master."""
        while not self._ending:
            with suppress(OSError):
                reader, writer = await asyncio.open_unix_connection(self._files.socket, limit=MAX_LINE_BYTES)
                try:
                    while line := await reader.readline():
                        if line.startswith(b'{"type":"pose"'):
                            self._first_pose.set()
                        on_line(line)
                finally:
                    writer.close()
            if not self._ending:
                await asyncio.sleep(_RECONNECT_DELAY_S)
