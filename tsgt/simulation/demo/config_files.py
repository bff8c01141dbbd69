"""Configuration files of a demonstration, for simulated radios and instruments."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from tsgt.config import scenario_parameters
from tsgt.radio.key_file import write_key
from tsgt.simulation.demo.imu import imu_command
from tsgt.simulation.mission import instrument_config

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.config import ScenarioConfig, SimulatedStation
    from tsgt.model import ImuParameters

Protocol = Literal["superframe", "classic"]

DEMO_SYNC_CYCLES = 8
"""The paper's 50 cycles take half a minute, which is too long for a demonstration."""

_SUPERFRAME = """\
[protocol]
kind = "superframe"     # delivers every measurement; `tsgt demo --protocol classic` runs the paper's
key_file = "radio.key"  # shared by all radios
"""

_CLASSIC = """\
[protocol]
kind = "classic"        # the paper's protocol
"""


@dataclass(frozen=True, slots=True)
class DemoFiles:
    """Paths in the folder of a demonstration."""

    folder: Path  # configuration, sockets, logs, journals and recordings
    socket: Path  # UNIX socket of the pose stream
    stations: tuple[int, ...]

    @property
    def air_socket(self) -> Path:
        """UNIX socket of the simulated radio channel."""
        return self.folder / "air.sock"

    @property
    def master_config(self) -> Path:
        """Configuration of the master."""
        return self.folder / "master.toml"

    @property
    def key(self) -> Path:
        """Key of all radios; protocol ``superframe`` only."""
        return self.folder / "radio.key"

    @property
    def recordings(self) -> Path:
        """Folder of the master's recordings."""
        return self.folder / "recordings"

    @property
    def imu_socket(self) -> Path:
        """UNIX socket with the lines of the robot's IMU."""
        return self.folder / "imu.sock"

    def add_imu(self, imu: ImuParameters, noise: str) -> None:
        """Add an IMU, with the preset of its noise, to the configuration of the master."""
        with self.master_config.open("a") as file:
            file.write(
                f"""
[imu]
command = {json.dumps(imu_command(self.imu_socket.absolute()))}
position_m = {json.dumps(imu.position_m)}
orientation_xyzw = {json.dumps(imu.orientation_xyzw)}
latency_ms = {imu.latency_ns / 1e6!r}
gyro_matrix = {json.dumps(imu.gyro_matrix)}
gravity_mps2 = {imu.gravity_mps2!r}
noise = {{ preset = {json.dumps(noise)} }}
"""
            )

    def client_config(self, station: int) -> Path:
        """Return the configuration of a station's client."""
        return self.folder / f"client{station}.toml"

    def instrument_port(self, station: int) -> Path:
        """Return the serial port of a station's simulated instrument."""
        return self.folder / f"instrument{station}.tty"

    def status_socket(self, station: int) -> Path:
        """Return the UNIX socket of a client's status."""
        return self.folder / f"client{station}.sock"

    def journals(self, station: int) -> Path:
        """Return the folder of a station's journals."""
        return self.folder / f"journals{station}"


def write_demo_files(
    folder: Path,
    scenario: ScenarioConfig,
    socket: Path,
    protocol: Protocol = "superframe",
    *,
    region: str | None = None,
) -> DemoFiles:
    """Write the configuration and setup files of a scenario, and a key, into an existing folder.

    ``region``: whose law the simulated radios obey; None: none, as nothing is transmitted.
    """
    files = DemoFiles(folder, socket, tuple(station.station for station in scenario.stations))
    parameters = scenario_parameters(scenario)
    frames = [
        f"[stations.{station.station}]\nT_station1_station = {json.dumps(station.T_station1_station)}\n"
        for station in parameters.stations
    ]
    (folder / "station_frames.toml").write_text("\n".join(['kind = "station_frames"\n', *frames]))
    prisms = [
        f"[prisms.{prism.prism}]\nposition_m = {json.dumps(prism.position_m)}\n"
        for prism in parameters.prisms
    ]
    (folder / "prism_layout.toml").write_text("\n".join(['kind = "prism_layout"\n', *prisms]))
    if protocol == "superframe":
        write_key(files.key)
    law = "" if region is None else f'region = "{region}"\n'
    files.master_config.write_text(_master(files, scenario, protocol, law))
    for station in scenario.stations:
        files.client_config(station.station).write_text(_client(files, scenario, station, protocol, law))
    return files


def _master(files: DemoFiles, scenario: ScenarioConfig, protocol: Protocol, law: str) -> str:
    stations = "\n".join(
        f"[[stations]]\nstation = {station.station}\nprism = {station.prism}\n"
        f"prism_constant_mm = {station.prism_constant_mm!r}\n"
        f"noise = {{ {_inline(station.noise.model_dump())} }}\n"
        for station in scenario.stations
    )
    # A default that is written out counts as stated: a short lag drops default delays, but rejects stated ones.
    limits = scenario.pipeline.model_dump(mode="json", exclude_unset=True)
    motion = limits.pop("motion", {})
    pipeline = "\n".join(f"{key} = {json.dumps(value)}" for key, value in limits.items())
    classic = f"{_CLASSIC}initial_cycles = {DEMO_SYNC_CYCLES}      # the paper's 50 take half a minute\n"
    return f"""\
kind = "master"

[setup]
station_frames = "station_frames.toml"
prism_layout = "prism_layout.toml"

{_radio(scenario, "master", law)}
{_SUPERFRAME if protocol == "superframe" else classic}
[pipeline]
{pipeline}
motion = {{ {_inline(motion)} }}

[reference_point]
name = {json.dumps(scenario.reference_point.name)}
position_m = {json.dumps(scenario.reference_point.position_m)}
orientation_xyzw = {json.dumps(scenario.reference_point.orientation_xyzw)}

[stream]
socket = {json.dumps(str(files.socket))}

[recording]
directory = "{files.recordings.name}"

{stations}"""


def _client(
    files: DemoFiles, scenario: ScenarioConfig, station: SimulatedStation, protocol: Protocol, law: str
) -> str:
    number = station.station
    instrument = instrument_config(station, files.instrument_port(number))
    return f"""\
kind = "client"
station = {number}
prism = {station.prism}
status_socket = "{files.status_socket(number).name}"

[instrument]
kind = "leica"
port = "{files.instrument_port(number).name}"
baud = {instrument.baud}
prism_type = "{instrument.prism_type}"
prism_constant_mm = {instrument.prism_constant_mm!r}
latency_ms = {instrument.latency_ms!r}
angle_delay_ms = {instrument.angle_delay_ms!r}

{_radio(scenario, f"station{number}", law)}
{_SUPERFRAME if protocol == "superframe" else _CLASSIC}
[journal]
directory = "{files.journals(number).name}"
"""


def _radio(scenario: ScenarioConfig, name: str, law: str) -> str:
    radio = scenario.radio
    return f"""\
[radio]
kind = "simulated"
air_socket = "air.sock"
name = "{name}"
frequency_mhz = {radio.frequency_mhz!r}
spreading_factor = {radio.spreading_factor}  # 9 as in the paper; the authors' deployed nodes use 8
bandwidth_khz = {radio.bandwidth_khz!r}
coding_rate = {radio.coding_rate}
power_dbm = {radio.power_dbm}
{law}"""


def _inline(values: dict[str, float | list[float]]) -> str:
    return ", ".join(f"{key} = {value!r}" for key, value in values.items())
