"""Configuration and set-up files: TOML in, checked models out, and from these the parameters in SI units.

Each file says by its top-level key ``kind`` what it is: ``client``, ``master``, ``station_frames``, ``prism_layout`` or
``scenario``. A path inside a file is relative to the folder of that file.
"""

from tsgt.config.base import Model, NoiseConfig
from tsgt.config.client import ClientConfig
from tsgt.config.files import (
    json_schema,
    load,
    load_any,
    load_prism_layout,
    load_station_frames,
    load_station_latencies,
    load_target_residuals,
)
from tsgt.config.instrument_models import KINDS
from tsgt.config.master import MasterConfig, StationConfig
from tsgt.config.parameters import parameters, scenario_parameters
from tsgt.config.pipeline import PipelineConfig
from tsgt.config.scenario import MotionConfig, ScenarioConfig
from tsgt.config.setup import PrismLayoutFile, StationFramesFile

__all__ = [
    "KINDS",
    "ClientConfig",
    "MasterConfig",
    "Model",
    "MotionConfig",
    "NoiseConfig",
    "PipelineConfig",
    "PrismLayoutFile",
    "ScenarioConfig",
    "StationConfig",
    "StationFramesFile",
    "json_schema",
    "load",
    "load_any",
    "load_prism_layout",
    "load_station_frames",
    "load_station_latencies",
    "load_target_residuals",
    "parameters",
    "scenario_parameters",
]
