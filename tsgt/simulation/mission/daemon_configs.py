"""Configurations of a mission's daemons, as files would state them; radios and instruments are handed over directly."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from tsgt.config import (
    ClassicConfig,
    ClassicMasterConfig,
    ClientConfig,
    ImuConfig,
    JournalConfig,
    LeicaInstrumentConfig,
    MasterConfig,
    OdometryConfig,
    RecordingConfig,
    SetupConfig,
    SimulatedRadioConfig,
    StationConfig,
    StreamConfig,
    SuperframeConfig,
)
from tsgt.simulation.mission.authors_node import AUTHORS_TIMESTAMP_DELAY_MS
from tsgt.simulation.mission.computer import MASTER
from tsgt.simulation.wheel_odometry import ODOMETRY_DELAY_S

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.config import Baud, ScenarioConfig, SimulatedStation
    from tsgt.simulation.options import SimulationOptions

STATUS_SOCKET = "client.sock"

_NO_FSYNC_S = 1e6  # a simulated power failure loses nothing that was written


def station_name(station: int) -> str:
    """Return the name of a station's radio and daemon."""
    return f"station{station}"


def radio_config(scenario: ScenarioConfig, name: str, folder: Path) -> SimulatedRadioConfig:
    """Return the configuration of a daemon's radio."""
    radio = scenario.radio
    return SimulatedRadioConfig(
        kind="simulated",
        air_socket=folder / "air.sock",
        name=name,
        frequency_mhz=radio.frequency_mhz,
        spreading_factor=radio.spreading_factor,
        bandwidth_khz=radio.bandwidth_khz,
        coding_rate=radio.coding_rate,
        power_dbm=radio.power_dbm,
    )


def master_config(scenario: ScenarioConfig, options: SimulationOptions, folder: Path) -> MasterConfig:
    """Return the master's configuration; recording and socket are in ``folder``."""
    return MasterConfig(
        kind="master",
        # Not read: the daemon gets the parameters directly.
        setup=SetupConfig(station_frames=folder / "frames.toml", prism_layout=folder / "layout.toml"),
        stations=tuple(
            StationConfig(
                station=s.station,
                prism=s.prism,
                prism_constant_mm=s.prism_constant_mm,
                timestamp_delay_ms=AUTHORS_TIMESTAMP_DELAY_MS
                if options.station_software == "authors"
                else 0.0,
                noise=s.noise,
            )
            for s in scenario.stations
        ),
        radio=radio_config(scenario, MASTER, folder),
        protocol=options.protocol,
        imu=_imu_config(scenario),
        odometry=_odometry_config(scenario),
        pipeline=scenario.pipeline,
        reference_point=scenario.reference_point,
        stream=StreamConfig(socket=folder / "poses.sock"),
        recording=RecordingConfig(directory=folder, fsync_interval_s=_NO_FSYNC_S),
    )


def _imu_config(scenario: ScenarioConfig) -> ImuConfig | None:
    imu = scenario.imu
    if imu.model == "none":
        return None
    return ImuConfig(
        command=("simulated-imu",),  # not run: the mission starts the program
        position_m=imu.position_m,
        orientation_xyzw=imu.orientation_xyzw,
        latitude_deg=imu.latitude_deg,
        height_m=imu.height_m,
    )


def has_odometry(scenario: ScenarioConfig) -> bool:
    """Whether the robot has wheel odometry, which is used with an IMU."""
    return scenario.odometry and scenario.imu.model != "none"


def _odometry_config(scenario: ScenarioConfig) -> OdometryConfig | None:
    if not has_odometry(scenario):
        return None
    return OdometryConfig(
        command=("simulated-odometry",),  # not run either
        latency_ms=1e3 * ODOMETRY_DELAY_S,
    )


def client_config(
    scenario: ScenarioConfig,
    entry: SimulatedStation,
    options: SimulationOptions,
    folder: Path,
    *,
    other_protocol: bool = False,
) -> ClientConfig:
    """Return a client's configuration; journal and socket are in ``folder``. ``other_protocol``: than that of the mission."""
    classic = isinstance(options.protocol, ClassicMasterConfig) != other_protocol
    return ClientConfig(
        kind="client",
        station=entry.station,
        prism=entry.prism,
        instrument=instrument_config(entry, folder / "instrument.tty"),
        radio=radio_config(scenario, station_name(entry.station), folder),
        protocol=ClassicConfig(kind="classic") if classic else SuperframeConfig(kind="superframe"),
        journal=JournalConfig(directory=folder, fsync_interval_s=_NO_FSYNC_S),
        status_socket=folder / STATUS_SOCKET,
    )


def instrument_config(
    entry: SimulatedStation, port: Path, *, prism_constant_mm: float = 0.0
) -> LeicaInstrumentConfig:
    """Return the instrument configuration of a client, matching the simulated instrument.

    The instrument adds no prism constant, unless one is given by mistake; the master does.
    """
    model = entry.instrument
    return LeicaInstrumentConfig(
        kind="leica",
        port=port,
        baud=cast("Baud", model.baud),
        prism_type="user",
        prism_constant_mm=prism_constant_mm,
        latency_ms=model.processing_min_ms,
        angle_delay_ms=model.angle_delay_ms,
    )
