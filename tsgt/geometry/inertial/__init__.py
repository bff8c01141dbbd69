"""Inertial measurements in the trajectory: samples, preintegration, states, factors and strapdown integration. Sans-I/O.

In: samples of an IMU as arrays, its calibration, polar measurements of the prisms. Out: states of the IMU with covariances.
docs/explanation/imu.md derives the equations.
"""

from tsgt.geometry.inertial.anchor import InertialAnchor
from tsgt.geometry.inertial.initialisation import search_heading, states_on_tracks
from tsgt.geometry.inertial.live import (
    DISAGREES_WITH_PRISMS,
    SHOCK,
    InertialFixedLagSmoother,
    SaturationMonitor,
    judge_magnitudes,
    usable_samples,
)
from tsgt.geometry.inertial.odometry import WheelSamples, WheelsEstimate
from tsgt.geometry.inertial.preintegration import ContiguousSamples, Preintegrated, contiguous, preintegrate
from tsgt.geometry.inertial.query import InertialTrajectory
from tsgt.geometry.inertial.samples import InertialSamples, concatenate_samples
from tsgt.geometry.inertial.smoother import (
    InertialFit,
    WheelsFit,
    estimation_noise,
    fit_inertial_trajectory,
)
from tsgt.geometry.inertial.solver import (
    InertialSetup,
    InertialSolution,
    inertial_knot_times,
    solve_inertial,
)
from tsgt.geometry.inertial.states import (
    Gravity,
    InertialStates,
    Mounting,
)

__all__ = [
    "DISAGREES_WITH_PRISMS",
    "SHOCK",
    "ContiguousSamples",
    "Gravity",
    "InertialAnchor",
    "InertialFit",
    "InertialFixedLagSmoother",
    "InertialSamples",
    "InertialSetup",
    "InertialSolution",
    "InertialStates",
    "InertialTrajectory",
    "Mounting",
    "Preintegrated",
    "SaturationMonitor",
    "WheelSamples",
    "WheelsEstimate",
    "WheelsFit",
    "concatenate_samples",
    "contiguous",
    "estimation_noise",
    "fit_inertial_trajectory",
    "inertial_knot_times",
    "judge_magnitudes",
    "preintegrate",
    "search_heading",
    "solve_inertial",
    "states_on_tracks",
    "usable_samples",
]
