"""Calibration of station frames, latencies and prism positions. Sans-I/O.

In: points with covariances in two frames, or polar measurements of a moving robot. Out: rigid transforms, latencies and
prism positions with covariances, rejected points, and the directions that the data leave unobservable.
"""

from tsgt.geometry.calibration.frame_fit import FrameFit, PointName, PointPairs, PointSet, fit_frame
from tsgt.geometry.calibration.hypotheses import Hypothesis, HypothesisKind
from tsgt.geometry.calibration.motion import MotionCalibration, calibrate_motion
from tsgt.geometry.calibration.motion_initialisation import frames_from_motion
from tsgt.geometry.calibration.observability import UnobservableDirection, unobservable_directions
from tsgt.geometry.calibration.refinement import HypothesisEvidence, RefinedSetup, refine_setup
from tsgt.geometry.calibration.setup_parameters import INSTRUMENT_ERRORS, Setup, SetupParameters
from tsgt.geometry.calibration.setup_prior import SetupPrior, calibrated_covariance, factor_of
from tsgt.geometry.calibration.station_frames import (
    CONSISTENCY,
    Check,
    checks,
    station_frames,
    unweighted_frames,
)
from tsgt.geometry.calibration.target_calibration import (
    ErrorEstimate,
    FitQuality,
    NetworkCalibration,
    calibrate_network,
)
from tsgt.geometry.calibration.target_causes import Cause, CauseKind, rejected_targets
from tsgt.geometry.calibration.target_network import (
    DATA_SHEET_SIGMA,
    ERRORS,
    Column,
    InstrumentError,
    TargetReadings,
)
from tsgt.geometry.calibration.targets import (
    BODY_LIMITS,
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
    "BODY_LIMITS",
    "CONSISTENCY",
    "DATA_SHEET_SIGMA",
    "ERRORS",
    "FALSE_ALARM_RATE",
    "INSTRUMENT_ERRORS",
    "MIN_POINTS",
    "STATION_LIMITS",
    "Cause",
    "CauseKind",
    "Check",
    "Column",
    "ErrorEstimate",
    "FitQuality",
    "FrameCalibration",
    "FrameFit",
    "Hypothesis",
    "HypothesisEvidence",
    "HypothesisKind",
    "InstrumentError",
    "MotionCalibration",
    "NetworkCalibration",
    "PointName",
    "PointPairs",
    "PointSet",
    "PrismCalibration",
    "RefinedSetup",
    "Setup",
    "SetupParameters",
    "SetupPrior",
    "TargetReadings",
    "UnobservableDirection",
    "WeakAxis",
    "calibrate_frame",
    "calibrate_motion",
    "calibrate_network",
    "calibrate_prisms",
    "calibrated_covariance",
    "checks",
    "factor_of",
    "fit_frame",
    "frames_from_motion",
    "refine_setup",
    "rejected_targets",
    "station_frames",
    "unobservable_directions",
    "unweighted_frames",
]
