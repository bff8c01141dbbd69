"""The folder of a demonstration: configuration files as a mission has them, for simulated radios and instruments."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.config import scenario_parameters

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.config import ScenarioConfig

INITIAL_CYCLES = 8
"""Fewer than the paper's 50, which take half a minute: nobody wants to wait so long for a demonstration."""


@dataclass(frozen=True, slots=True)
class DemoFiles:
    """What stands where in the folder of a demonstration.

    Attributes
    ----------
    folder
        Everything lies in here: configuration, sockets, logs, journals and recordings.
    socket
        UNIX socket of the pose stream.
    stations
        Numbers of the stations.
    """

    folder: Path
    socket: Path
    stations: tuple[int, ...]

    @property
    def air_socket(self) -> Path:
        """UNIX socket of the air."""
        return self.folder / "air.sock"

    @property
    def master_config(self) -> Path:
        """Configuration of the master."""
        return self.folder / "master.toml"

    @property
    def recordings(self) -> Path:
        """Folder of the master's recordings."""
        return self.folder / "recordings"

    def client_config(self, station: int) -> Path:
        """Return the configuration of a station's client."""
        return self.folder / f"client{station}.toml"

    def instrument_socket(self, station: int) -> Path:
        """Return the UNIX socket of a station's simulated instrument."""
        return self.folder / f"instrument{station}.sock"

    def journals(self, station: int) -> Path:
        """Return the folder of a station's journals."""
        return self.folder / f"journals{station}"


def write_demo_files(folder: Path, scenario: ScenarioConfig, socket: Path) -> DemoFiles:
    """Write all configuration and set-up files of a scenario into a folder.

    Parameters
    ----------
    folder
        Exists.
    scenario
        Stations, prisms and limits.
    socket
        Where the poses are to go.
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
    files.master_config.write_text(_master(files, scenario))
    for station in scenario.stations:
        files.client_config(station.station).write_text(
            _client(files, scenario, station.station, station.prism)
        )
    return files


def _master(files: DemoFiles, scenario: ScenarioConfig) -> str:
    stations = "\n".join(
        f"[[stations]]\nstation = {station.station}\nprism = {station.prism}\n"
        f"prism_constant_mm = {station.prism_constant_mm!r}\n"
        f"noise = {{ {_inline(station.noise.model_dump())} }}\n"
        for station in scenario.stations
    )
    pipeline = "\n".join(
        f"{key} = {json.dumps(value)}" for key, value in scenario.pipeline.model_dump().items()
    )
    return f"""\
kind = "master"

[setup]
station_frames = "station_frames.toml"
prism_layout = "prism_layout.toml"

{_radio(scenario, "master")}
[protocol]
kind = "classic"        # the paper's; the only one so far
initial_cycles = {INITIAL_CYCLES}      # the paper's 50 take half a minute

[pipeline]
{pipeline}

[stream]
socket = {json.dumps(str(files.socket))}

[recording]
directory = "{files.recordings.name}"

{stations}"""


def _client(files: DemoFiles, scenario: ScenarioConfig, station: int, prism: int) -> str:
    return f"""\
kind = "client"
station = {station}
prism = {prism}
status_socket = "client{station}.sock"

[instrument]
kind = "simulated"
socket = "{files.instrument_socket(station).name}"

{_radio(scenario, f"station{station}")}
[protocol]
kind = "classic"

[journal]
directory = "{files.journals(station).name}"
"""


def _radio(scenario: ScenarioConfig, name: str) -> str:
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
"""


def _inline(values: dict[str, float]) -> str:
    return ", ".join(f"{key} = {value!r}" for key, value in values.items())
