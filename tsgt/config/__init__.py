"""Configuration and set-up files: TOML in, checked models out, and from these the parameters in SI units.

Each file says by its top-level key ``kind`` what it is: ``master``, ``station_frames``, ``prism_layout`` or
``scenario``. A path inside a file is relative to the folder of that file.
"""

from tsgt.config.files import json_schema, load, load_any, load_prism_layout, load_station_frames
from tsgt.config.models import (
    KINDS,
    MasterConfig,
    Model,
    MotionConfig,
    NoiseConfig,
    PipelineConfig,
    PrismLayoutFile,
    ScenarioConfig,
    StationConfig,
    StationFramesFile,
)
from tsgt.config.parameters import parameters, scenario_parameters

__all__ = [
    "KINDS",
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
    "parameters",
    "scenario_parameters",
]
