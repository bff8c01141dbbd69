"""The continuous-time estimator: Gaussian-process regression of a trajectory on polar measurements. Sans-I/O.

:func:`fit_trajectory` solves a whole recording, :class:`FixedLagSmoother` works online, :func:`tune` finds hyperparameters.
docs/explanation/continuous-trajectory.md derives the equations.
"""

from tsgt.geometry.trajectory.batch import TrajectoryFit, fit_trajectory
from tsgt.geometry.trajectory.fixed_lag import FixedLagSmoother
from tsgt.geometry.trajectory.gauss_newton import (
    MIN_KNOT_SPACING_S,
    Solution,
    knot_times,
    nearest_knots,
    solve,
)
from tsgt.geometry.trajectory.hyperparameters import NOISE_FLOOR_SHARE, tune, with_noise_floor
from tsgt.geometry.trajectory.initialisation import initial_guess
from tsgt.geometry.trajectory.measurement_factors import (
    LinearisedMeasurements,
    Observations,
    line_of_sight_axes,
    linearise,
)
from tsgt.geometry.trajectory.noise_scales import overall_scale, scale_noise
from tsgt.geometry.trajectory.query import Trajectory, ros_covariance, state_at_point, with_second_order_terms
from tsgt.geometry.trajectory.rest import RestInterval, in_rest
from tsgt.geometry.trajectory.rest_detection import Series, find_rest, find_rest_in_series
from tsgt.geometry.trajectory.sensitivity import SetupJacobian, coupling
from tsgt.geometry.trajectory.states import STATE_DIM, States, concatenate_states

__all__ = [
    "MIN_KNOT_SPACING_S",
    "NOISE_FLOOR_SHARE",
    "STATE_DIM",
    "FixedLagSmoother",
    "LinearisedMeasurements",
    "Observations",
    "RestInterval",
    "Series",
    "SetupJacobian",
    "Solution",
    "States",
    "Trajectory",
    "TrajectoryFit",
    "concatenate_states",
    "coupling",
    "find_rest",
    "find_rest_in_series",
    "fit_trajectory",
    "in_rest",
    "initial_guess",
    "knot_times",
    "line_of_sight_axes",
    "linearise",
    "nearest_knots",
    "overall_scale",
    "ros_covariance",
    "scale_noise",
    "solve",
    "state_at_point",
    "tune",
    "with_noise_floor",
    "with_second_order_terms",
]
