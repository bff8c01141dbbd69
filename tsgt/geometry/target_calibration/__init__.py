"""Station frames, instrument errors and prism positions from measured targets: one network adjustment. Sans-I/O.

In: polar readings of targets by each station, or points with covariances in two frames. Out: rigid transforms, instrument
errors and prism positions with their joint covariance, checks of the fit, and the causes of misfit with what would repair them.
"""

from tsgt.geometry.target_calibration.adjustment import (
    ErrorEstimate,
    FitQuality,
    NetworkCalibration,
    calibrate_network,
)
from tsgt.geometry.target_calibration.causes import Cause, CauseKind
from tsgt.geometry.target_calibration.frame_fit import FrameFit, PointName, PointPairs, PointSet, fit_frame
from tsgt.geometry.target_calibration.network import (
    DATA_SHEET_SIGMA,
    ERRORS,
    Column,
    InstrumentError,
    TargetReadings,
)
from tsgt.geometry.target_calibration.prisms import (
    FALSE_ALARM_RATE,
    MIN_POINTS,
    WEAK_BODY_RAD,
    FrameCalibration,
    PrismCalibration,
    WeakAxis,
    calibrate_prisms,
)
from tsgt.geometry.target_calibration.sights import AIM, MOVED, READINGS, SightError, sight_error
from tsgt.geometry.target_calibration.station_frames import (
    CONSISTENCY,
    WEAK_STATION_RAD,
    Check,
    checks,
    station_frames,
    unweighted_frames,
)

__all__ = [
    "AIM",
    "CONSISTENCY",
    "DATA_SHEET_SIGMA",
    "ERRORS",
    "FALSE_ALARM_RATE",
    "MIN_POINTS",
    "MOVED",
    "READINGS",
    "WEAK_BODY_RAD",
    "WEAK_STATION_RAD",
    "Cause",
    "CauseKind",
    "Check",
    "Column",
    "ErrorEstimate",
    "FitQuality",
    "FrameCalibration",
    "FrameFit",
    "InstrumentError",
    "NetworkCalibration",
    "PointName",
    "PointPairs",
    "PointSet",
    "PrismCalibration",
    "SightError",
    "TargetReadings",
    "WeakAxis",
    "calibrate_network",
    "calibrate_prisms",
    "checks",
    "fit_frame",
    "sight_error",
    "station_frames",
    "unweighted_frames",
]
