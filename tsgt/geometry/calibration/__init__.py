"""TODO face."""

from tsgt.geometry.calibration.frame_fit import Fit, Name, Pairs, PointSet, fit_frame
from tsgt.geometry.calibration.motion import MotionCalibration, calibrate_motion
from tsgt.geometry.calibration.motion_initialisation import frames_from_motion
from tsgt.geometry.calibration.motion_parameters import Setup, Unknowns
from tsgt.geometry.calibration.observability import Undetermined, undetermined
from tsgt.geometry.calibration.targets import (
    FALSE_ALARM,
    MIN_POINTS,
    STATION_LIMITS,
    FrameCalibration,
    PrismCalibration,
    WeakAxis,
    calibrate_frame,
    calibrate_prisms,
)

__all__ = [
    "FALSE_ALARM",
    "MIN_POINTS",
    "STATION_LIMITS",
    "Fit",
    "FrameCalibration",
    "MotionCalibration",
    "Name",
    "Pairs",
    "PointSet",
    "PrismCalibration",
    "Setup",
    "Undetermined",
    "Unknowns",
    "WeakAxis",
    "calibrate_frame",
    "calibrate_motion",
    "calibrate_prisms",
    "fit_frame",
    "frames_from_motion",
    "undetermined",
]
