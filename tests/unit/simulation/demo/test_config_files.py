"""The configuration files of a demo are complete and match the scenario."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tsgt.cli.composition import radio_key
from tsgt.clock import SystemClock
from tsgt.config import (
    ClientConfig,
    LeicaInstrumentConfig,
    MasterConfig,
    PipelineConfig,
    ReferencePointConfig,
    ScenarioConfig,
    SimulatedImu,
    load,
    parameters,
    scenario_parameters,
)
from tsgt.imu import HelloLine, SamplesLine, decode_program_line
from tsgt.simulation.demo import Demo, write_demo_files
from tsgt.simulation.demo.imu import ImuServer, imu_command
from tsgt.simulation.imu import IMU_MODELS, ImuProgram, simulate_imu
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.demo.config_files import Protocol


def test_master_setup_equals_the_scenario(tmp_path: Path) -> None:
    """The parameters read from the files are those of the scenario."""
    lidar = ReferencePointConfig(
        name="lidar", position_m=(0.1, 0.2, 1.3), orientation_xyzw=(0.0, 0.6, 0.0, 0.8)
    )
    scenario = ScenarioConfig(reference_point=lidar)
    files = write_demo_files(tmp_path, scenario, tmp_path / "poses.sock")
    assert parameters(load(files.master_config, MasterConfig)) == scenario_parameters(scenario)


@pytest.mark.parametrize(
    "pipeline",
    [PipelineConfig(lag_s=0.5), PipelineConfig(lag_s=2.0, smoothed_delays_s=(0.5, 1.5), estimator="linear")],
)
def test_master_has_the_pipeline_of_the_scenario(tmp_path: Path, pipeline: PipelineConfig) -> None:
    """What the scenario leaves to its default stays one: a short lag drops default delays, but rejects stated ones."""
    scenario = ScenarioConfig(pipeline=pipeline)
    files = write_demo_files(tmp_path, scenario, tmp_path / "poses.sock")
    config = load(files.master_config, MasterConfig)
    assert config.pipeline == pipeline
    assert parameters(config) == scenario_parameters(scenario)


async def test_master_has_the_imu_of_the_robot(tmp_path: Path) -> None:
    """As it is simulated; its program prints what comes from the socket of the demonstration."""
    scenario = ScenarioConfig(imu=SimulatedImu(model="industrial"))
    files = write_demo_files(tmp_path, scenario, tmp_path / "poses.sock")
    demo = Demo(scenario, files, duration_s=1.0, seed=0, clock=VirtualClock(0))
    config = load(files.master_config, MasterConfig)
    assert parameters(config) == demo.parameters
    assert demo.parameters.imu is not None
    assert config.imu is not None
    assert config.imu.command[-1] == str(files.imu_socket)


@pytest.mark.slow
def test_program_prints_the_lines_of_the_socket(tmp_path: Path) -> None:
    """Those from when it is started on, as often as it is; in real time, because the program is a process."""
    asyncio.run(_lines_of_the_socket(tmp_path / "imu.sock"))


async def _lines_of_the_socket(path: Path) -> None:
    clock = SystemClock()
    start_s = clock.monotonic_ns() / 1e9
    world = scenario_world(ScenarioConfig(), 20.0, np.random.default_rng(0))
    run = simulate_imu(SimulatedImu(model="industrial"), world.motion_at, 15.0, seed=[0])
    samples = replace(run.samples, arrival_s=run.samples.arrival_s + start_s)
    program = ImuProgram(IMU_MODELS["industrial"], samples, clock)
    async with ImuServer(path, program, clock):
        for _ in range(2):
            process = await asyncio.create_subprocess_exec(*imu_command(path), stdout=asyncio.subprocess.PIPE)
            try:
                assert process.stdout is not None
                hello, first = await process.stdout.readline(), await process.stdout.readline()
                assert isinstance(decode_program_line(hello), HelloLine)
                line = decode_program_line(first)
                assert isinstance(line, SamplesLine)
                assert line.host_time_ns is not None
                assert clock.monotonic_ns() >= line.host_time_ns[-1]
            finally:
                process.terminate()
                await process.wait()


@pytest.mark.parametrize("protocol", ["superframe", "classic"])
@pytest.mark.parametrize("station", [1, 2, 3])
def test_clients_match_the_master(tmp_path: Path, station: int, protocol: Protocol) -> None:
    """Each client has its own instrument and journal, and the master's modem settings and protocol."""
    files = write_demo_files(tmp_path, ScenarioConfig(), tmp_path / "poses.sock", protocol)
    client = load(files.client_config(station), ClientConfig)
    master = load(files.master_config, MasterConfig)
    assert client.station == station
    assert isinstance(client.instrument, LeicaInstrumentConfig)
    assert client.instrument.port == files.instrument_port(station)
    assert client.journal.directory == files.journals(station)
    names = {"name"}
    assert client.radio.model_dump(exclude=names) == master.radio.model_dump(exclude=names)
    assert client.protocol.kind == master.protocol.kind == protocol
    assert radio_key(client.protocol) == radio_key(master.protocol)
    assert (radio_key(master.protocol) is not None) == (protocol == "superframe")
