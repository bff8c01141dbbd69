"""What the configuration files of a mission's daemons would say; radios and instruments are handed to them anyway."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from tsgt.config import ClientConfig, MasterConfig
from tsgt.config.client import JournalConfig, LeicaInstrumentConfig
from tsgt.config.master import RecordingConfig, SetupConfig, StationConfig, StreamConfig
from tsgt.config.radio import (
    ClassicConfig,
    ClassicMasterConfig,
    SimulatedRadioConfig,
    SuperframeConfig,
)
from tsgt.simulation.authors_node import AUTHORS_STAMP_DELAY_MS
from tsgt.simulation.link import LinkModel, LogDistanceLoss
from tsgt.simulation.options import MASTER

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from tsgt.config import ScenarioConfig
    from tsgt.config.client import Baud
    from tsgt.config.scenario import ScenarioRadioConfig, SimulatedStation
    from tsgt.simulation.options import Options

STATUS_SOCKET = "client.sock"

_RARELY_S = 1e6  # of fsync, which a simulation has no use for


def station_name(station: int) -> str:
    """Return the name of a station's radio and daemon."""
    return f"station{station}"


def radio_config(scenario: ScenarioConfig, name: str, folder: Path) -> SimulatedRadioConfig:
    """Say of the radio what a file would; the radio itself is handed to the daemon."""
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


def master_config(scenario: ScenarioConfig, options: Options, folder: Path) -> MasterConfig:
    """Return the master's, with its recording and its socket in a folder."""
    return MasterConfig(
        kind="master",
        # Not read: the parameters are handed to the daemon.
        setup=SetupConfig(station_frames=folder / "frames.toml", prism_layout=folder / "layout.toml"),
        stations=tuple(
            StationConfig(
                station=s.station,
                prism=s.prism,
                prism_constant_mm=s.prism_constant_mm,
                stamp_delay_ms=AUTHORS_STAMP_DELAY_MS if options.node == "authors" else 0.0,
                noise=s.noise,
            )
            for s in scenario.stations
        ),
        radio=radio_config(scenario, MASTER, folder),
        protocol=options.protocol,
        pipeline=scenario.pipeline,
        stream=StreamConfig(socket=folder / "poses.sock"),
        recording=RecordingConfig(directory=folder, fsync_interval_s=_RARELY_S),
    )


def client_config(
    scenario: ScenarioConfig, entry: SimulatedStation, options: Options, folder: Path
) -> ClientConfig:
    """Return that of a station's client, with its journal and its socket in a folder."""
    classic = isinstance(options.protocol, ClassicMasterConfig)
    return ClientConfig(
        kind="client",
        station=entry.station,
        prism=entry.prism,
        instrument=instrument_config(entry, folder / "instrument.tty"),
        radio=radio_config(scenario, station_name(entry.station), folder),
        protocol=ClassicConfig(kind="classic") if classic else SuperframeConfig(kind="superframe"),
        journal=JournalConfig(directory=folder, fsync_interval_s=_RARELY_S),
        status_socket=folder / STATUS_SOCKET,
    )


def instrument_config(entry: SimulatedStation, port: Path) -> LeicaInstrumentConfig:
    """Return how a client sets its station's simulated instrument, of which it knows everything.

    The instrument adds no prism constant; the master does.
    """
    model = entry.instrument
    return LeicaInstrumentConfig(
        kind="leica",
        port=port,
        baud=cast("Baud", model.baud),
        prism_type="user",
        prism_constant_mm=0.0,
        latency_ms=model.processing_min_ms,
        angle_delay_ms=model.angle_delay_ms,
    )


def scenario_link(
    radio: ScenarioRadioConfig, places: dict[str, tuple[float, float, float]], rng: np.random.Generator
) -> LinkModel:
    """Make what lies between the radios of a scenario; ``places`` by radio, in m, may change meanwhile."""
    return LinkModel(
        path_loss=LogDistanceLoss(
            positions_m=places,
            exponent=radio.path_loss_exponent,
            shadowing_sigma_db=radio.shadowing_sigma_db,
            antenna_gain_db=radio.antenna_gain_db,
            seed=int(rng.integers(2**31)),
        ),
        rayleigh_fading=radio.rayleigh_fading,
        loss_probability=radio.loss_probability,
    )
