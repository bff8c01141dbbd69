"""Configuration and set-up files: TOML in, validated models and parameters in SI units out.

The top-level key ``kind`` of a file selects its model: ``client``, ``master``, ``station_frames``, ``prism_layout``,
``imu_mounting``, ``sensor_mounting`` or ``scenario``. A path in a file is relative to the folder of that file. ``files`` reads, the models validate,
``parameters`` converts, ``permissions`` rejects files that everybody can change.
"""

from tsgt.config.alarms import AlarmsConfig
from tsgt.config.base import Model, NoiseConfig
from tsgt.config.calibration import (
    ImuMounting,
    PrismLayout,
    StationCalibration,
    StationSetup,
    load_imu_mounting,
    load_prism_layout,
    load_station_calibration,
    setup_covariance,
)
from tsgt.config.client import (
    Baud,
    BridgeInstrumentConfig,
    ClientConfig,
    InstrumentConfig,
    JournalConfig,
    LeicaInstrumentConfig,
    PressureHpa,
    TcpAddress,
    TemperatureC,
)
from tsgt.config.files import (
    KINDS,
    find_problems,
    json_schema,
    load,
    load_any,
)
from tsgt.config.imu import IMU_NOISE, ImuConfig, ImuNoiseConfig, normal_gravity_mps2
from tsgt.config.master import (
    FrameWatchConfig,
    GeofenceConfig,
    MasterConfig,
    RecordingConfig,
    SetupConfig,
    StationConfig,
    StreamConfig,
)
from tsgt.config.odometry import OdometryConfig
from tsgt.config.parameters import level_frame, noise, parameters, scenario_parameters
from tsgt.config.permissions import check_permissions
from tsgt.config.pipeline import PipelineConfig, ReferencePointConfig
from tsgt.config.radio import (
    MAX_STATION_NUMBERS,
    ClassicConfig,
    ClassicMasterConfig,
    HardwareRadioConfig,
    MasterProtocolConfig,
    ModemConfig,
    ProtocolConfig,
    RadioConfig,
    SimulatedRadioConfig,
    SuperframeConfig,
    SuperframeMasterConfig,
    WiringConfig,
)
from tsgt.config.scenario import (
    InstrumentModelConfig,
    MotionConfig,
    OcclusionConfig,
    ScenarioConfig,
    ScenarioRadioConfig,
    SimulatedStation,
)
from tsgt.config.scenario_imu import ImuModelName, ImuSetupErrorConfig, ShakingConfig, SimulatedImu
from tsgt.config.setup import ImuMountingFile, PrismLayoutFile, SensorMountingFile, StationFramesFile

__all__ = [
    "IMU_NOISE",
    "KINDS",
    "MAX_STATION_NUMBERS",
    "AlarmsConfig",
    "Baud",
    "BridgeInstrumentConfig",
    "ClassicConfig",
    "ClassicMasterConfig",
    "ClientConfig",
    "FrameWatchConfig",
    "GeofenceConfig",
    "HardwareRadioConfig",
    "ImuConfig",
    "ImuModelName",
    "ImuMounting",
    "ImuMountingFile",
    "ImuNoiseConfig",
    "ImuSetupErrorConfig",
    "InstrumentConfig",
    "InstrumentModelConfig",
    "JournalConfig",
    "LeicaInstrumentConfig",
    "MasterConfig",
    "MasterProtocolConfig",
    "Model",
    "ModemConfig",
    "MotionConfig",
    "NoiseConfig",
    "OcclusionConfig",
    "OdometryConfig",
    "PipelineConfig",
    "PressureHpa",
    "PrismLayout",
    "PrismLayoutFile",
    "ProtocolConfig",
    "RadioConfig",
    "RecordingConfig",
    "ReferencePointConfig",
    "ScenarioConfig",
    "ScenarioRadioConfig",
    "SensorMountingFile",
    "SetupConfig",
    "ShakingConfig",
    "SimulatedImu",
    "SimulatedRadioConfig",
    "SimulatedStation",
    "StationCalibration",
    "StationConfig",
    "StationFramesFile",
    "StationSetup",
    "StreamConfig",
    "SuperframeConfig",
    "SuperframeMasterConfig",
    "TcpAddress",
    "TemperatureC",
    "WiringConfig",
    "check_permissions",
    "find_problems",
    "json_schema",
    "level_frame",
    "load",
    "load_any",
    "load_imu_mounting",
    "load_prism_layout",
    "load_station_calibration",
    "noise",
    "normal_gravity_mps2",
    "parameters",
    "scenario_parameters",
    "setup_covariance",
]
