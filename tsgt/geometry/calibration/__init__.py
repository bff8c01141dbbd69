"""Calibration of station frames, latencies and prism positions. Sans-I/O.

In: points with covariances in two frames, or polar measurements of a moving robot. Out: rigid transforms, latencies and
prism positions with covariances, rejected points, and the directions that the data leave unobservable.
"""

from tsgt.geometry.calibration.frame_fit import FrameFit, PointName, PointPairs, PointSet, fit_frame
from tsgt.geometry.calibration.motion import MotionCalibration, calibrate_motion
from tsgt.geometry.calibration.motion_initialisation import frames_from_motion
from tsgt.geometry.calibration.observability import UnobservableDirection, unobservable_directions
from tsgt.geometry.calibration.setup_parameters import Setup, SetupParameters
from tsgt.geometry.calibration.setup_prior import SetupPrior, calibrated_covariance
from tsgt.geometry.calibration.targets import (
    FALSE_ALARM_RATE,
    MIN_POINTS,
    STATION_LIMITS,
    FrameCalibration,
    PrismCalibration,
    WeakAxis,
    calibrate_frame,
    calibrate_prisms,
)

__all__ = [
    "FALSE_ALARM_RATE",
    "MIN_POINTS",
    "STATION_LIMITS",
    "FrameCalibration",
    "FrameFit",
    "MotionCalibration",
    "PointName",
    "PointPairs",
    "PointSet",
    "PrismCalibration",
    "Setup",
    "SetupParameters",
    "SetupPrior",
    "UnobservableDirection",
    "WeakAxis",
    "calibrate_frame",
    "calibrate_motion",
    "calibrate_prisms",
    "calibrated_covariance",
    "fit_frame",
    "frames_from_motion",
    "unobservable_directions",
]
