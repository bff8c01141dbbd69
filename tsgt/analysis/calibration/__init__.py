"""Calibration from field files and recordings: station frames and prisms from targets, the whole set-up and the IMU from motion.

Comes in: target and prism files, a recording, the state of a target collection. Goes out: frames, prism positions and
latencies with residuals, the clock of imported IMU samples, a check whether a station has moved, the next target to measure. The solvers are in
``tsgt.geometry``: ``target_calibration``, ``motion_calibration`` and ``inertial_calibration``.
"""

from tsgt.analysis.calibration.imu import CalibratedImu, calibrate_recorded_imu
from tsgt.analysis.calibration.imu_clock import AlignedClock, align_recorded_clock
from tsgt.analysis.calibration.motion import CalibratedRecording, HeldOutComparison, calibrate_recording
from tsgt.analysis.calibration.station_check import StationCheck, check_station
from tsgt.analysis.calibration.target_collection import StationTarget, TargetCollection
from tsgt.analysis.calibration.target_notes import suspect_exclusions, target_notes, unidentified_text
from tsgt.analysis.calibration.targets import (
    Exclusion,
    TargetCalibration,
    check_repeats,
    layout_covariance,
    same_face_points,
    solve_prisms,
    solve_stations,
    target_residuals,
)

__all__ = [
    "AlignedClock",
    "CalibratedImu",
    "CalibratedRecording",
    "Exclusion",
    "HeldOutComparison",
    "StationCheck",
    "StationTarget",
    "TargetCalibration",
    "TargetCollection",
    "align_recorded_clock",
    "calibrate_recorded_imu",
    "calibrate_recording",
    "check_repeats",
    "check_station",
    "layout_covariance",
    "same_face_points",
    "solve_prisms",
    "solve_stations",
    "suspect_exclusions",
    "target_notes",
    "target_residuals",
    "unidentified_text",
]
