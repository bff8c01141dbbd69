"""Station frames, latencies, instrument errors and prism positions from a moving robot. Sans-I/O.

In: polar measurements of a drive and the covariance of the set-up as calibrated. Out: a refined set-up with its covariance,
the evidence for each hypothesis, and the directions that the data leave unobservable; or the causes, drifts among them, that
explain what is wrong with it.
"""

from tsgt.geometry.motion_calibration.calibration import MotionCalibration, calibrate_motion
from tsgt.geometry.motion_calibration.cause_selection import (
    AMBIGUITY,
    CauseHypothesis,
    CauseSelection,
    SelectedCause,
    SetupCause,
    cause_hypotheses,
)
from tsgt.geometry.motion_calibration.hypotheses import Hypothesis, HypothesisKind
from tsgt.geometry.motion_calibration.initialisation import frames_from_motion
from tsgt.geometry.motion_calibration.observability import unobservable_directions
from tsgt.geometry.motion_calibration.refinement import HypothesisEvidence, RefinedSetup, refine_setup
from tsgt.geometry.motion_calibration.setup_errors import LinearisedSetup, SetupErrors, linearise_setup
from tsgt.geometry.motion_calibration.setup_parameters import INSTRUMENT_ERRORS, Setup, SetupParameters
from tsgt.geometry.motion_calibration.setup_prior import SetupPrior, calibrated_covariance, factor_of

__all__ = [
    "AMBIGUITY",
    "INSTRUMENT_ERRORS",
    "CauseHypothesis",
    "CauseSelection",
    "Hypothesis",
    "HypothesisEvidence",
    "HypothesisKind",
    "LinearisedSetup",
    "MotionCalibration",
    "RefinedSetup",
    "SelectedCause",
    "Setup",
    "SetupCause",
    "SetupErrors",
    "SetupParameters",
    "SetupPrior",
    "calibrate_motion",
    "calibrated_covariance",
    "cause_hypotheses",
    "factor_of",
    "frames_from_motion",
    "linearise_setup",
    "refine_setup",
    "unobservable_directions",
]
