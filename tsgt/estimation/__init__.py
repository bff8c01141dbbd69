"""Measurements to poses, live and from a recording. Sans-I/O; knows neither radio nor files.

In: raw measurements and the parameters in force. Out: poses with covariance, validity and reason, as records or arrays.
`linear` and `continuous` are the estimators, `live` puts measurements and poses in the order of the stream; `tracks` and
`observations` apply latency, constants, frames and noise, `inertial` takes the robot's IMU and wheels; `pose_batch` and `pose_output`
hold and validate poses; `reference_point` carries them to another point of the robot.
"""

from tsgt.estimation.inertial import (
    MAX_SHOCKS,
    MOVE_CAUSES,
    SHOCK_INTERVAL_NS,
    UNWATCHED_NS,
    ImuSetupMonitor,
    OdometryState,
    SampleConverter,
    StartCheck,
    check_recorded_setup,
    inertial_samples,
    start_now,
    unconfirmed_covariance,
    wheel_samples,
)
from tsgt.estimation.linear import LinearEstimator
from tsgt.estimation.live import LiveEstimator
from tsgt.estimation.noise_scales import noise_scales, with_noise_scales
from tsgt.estimation.observations import build_observations, centroid_m, instrument_time_sigma_s
from tsgt.estimation.pose_batch import Degradation, Kind, PoseBatch, Reason
from tsgt.estimation.pose_output import ContinuousPoseOutput, MeasurementHistory
from tsgt.estimation.pose_quality import sigma_limits_of
from tsgt.estimation.reference_point import (
    POINT_COMMENT,
    centroid_at_point,
    centroid_point,
    named_point,
    parse_reference_point,
    point_label,
    point_place,
    poses_at,
    records_at,
    reference_point_text,
    transform_between,
    transform_of,
)
from tsgt.estimation.setup_uncertainty import (
    InertialSetupUncertainty,
    parameter_names,
    setup_jacobian,
    uncertain_setup,
    with_setup,
)
from tsgt.estimation.tracks import (
    MAX_DISTANCE_M,
    Track,
    build_tracks,
    has_plausible_time,
    measured_at_ns,
    usable,
)

__all__ = [
    "MAX_DISTANCE_M",
    "MAX_SHOCKS",
    "MOVE_CAUSES",
    "POINT_COMMENT",
    "SHOCK_INTERVAL_NS",
    "UNWATCHED_NS",
    "ContinuousPoseOutput",
    "Degradation",
    "ImuSetupMonitor",
    "InertialSetupUncertainty",
    "Kind",
    "LinearEstimator",
    "LiveEstimator",
    "MeasurementHistory",
    "OdometryState",
    "PoseBatch",
    "Reason",
    "SampleConverter",
    "StartCheck",
    "Track",
    "build_observations",
    "build_tracks",
    "centroid_at_point",
    "centroid_m",
    "centroid_point",
    "check_recorded_setup",
    "has_plausible_time",
    "inertial_samples",
    "instrument_time_sigma_s",
    "measured_at_ns",
    "named_point",
    "noise_scales",
    "parameter_names",
    "parse_reference_point",
    "point_label",
    "point_place",
    "poses_at",
    "records_at",
    "reference_point_text",
    "setup_jacobian",
    "sigma_limits_of",
    "start_now",
    "transform_between",
    "transform_of",
    "uncertain_setup",
    "unconfirmed_covariance",
    "usable",
    "wheel_samples",
    "with_noise_scales",
    "with_setup",
]
