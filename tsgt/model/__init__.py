"""Records that all layers share: measurements, and the parameters that turn them into poses.

Frozen dataclasses, SI units and radians, times as integers in nanoseconds. Recordings and the stream have exactly these
fields under exactly these names; docs/explanation/conventions.md defines units, frames and signs.
"""

from tsgt.model.measurements import (
    ClockSample,
    ImuSamples,
    Measurement,
    OdometrySamples,
    PointMeasurement,
    PolarMeasurement,
    Status,
)
from tsgt.model.newest_measurement import NO_MEASUREMENT, NewestMeasurement
from tsgt.model.parameters import Parameters, SetupCovariance
from tsgt.model.pipeline import MotionPrior, PipelineParameters
from tsgt.model.robot import (
    ROBOT_ORIGIN,
    ImuNoise,
    ImuParameters,
    OdometryParameters,
    PrismPosition,
    ReferencePoint,
)
from tsgt.model.stations import (
    TARGET_NOISE,
    TRACKING_NOISE,
    InstrumentNoise,
    StationParameters,
    TargetResidual,
)
from tsgt.model.values import (
    ARCSECOND_RAD,
    IDENTITY4,
    MAX_COORDINATE_M,
    MAX_INSTANT_NS,
    MAX_NUMBER,
    MIN_PRISMS,
    ROBOT_FRAME,
    WORLD_FRAME,
    FiniteNumbers,
    Matrix4,
    Row4,
    Vector3,
    check_finite,
    check_instants,
)

__all__ = [
    "ARCSECOND_RAD",
    "IDENTITY4",
    "MAX_COORDINATE_M",
    "MAX_INSTANT_NS",
    "MAX_NUMBER",
    "MIN_PRISMS",
    "NO_MEASUREMENT",
    "ROBOT_FRAME",
    "ROBOT_ORIGIN",
    "TARGET_NOISE",
    "TRACKING_NOISE",
    "WORLD_FRAME",
    "ClockSample",
    "FiniteNumbers",
    "ImuNoise",
    "ImuParameters",
    "ImuSamples",
    "InstrumentNoise",
    "Matrix4",
    "Measurement",
    "MotionPrior",
    "NewestMeasurement",
    "OdometryParameters",
    "OdometrySamples",
    "Parameters",
    "PipelineParameters",
    "PointMeasurement",
    "PolarMeasurement",
    "PrismPosition",
    "ReferencePoint",
    "Row4",
    "SetupCovariance",
    "StationParameters",
    "Status",
    "TargetResidual",
    "Vector3",
    "check_finite",
    "check_instants",
]
