"""The continuous-time estimator: Gaussian-process regression of a trajectory on polar measurements. Sans-I/O.

States, factors and the Gauss-Newton solver that all estimators share; :class:`FixedLagSmoother` works online,
``geometry.batch`` fits whole recordings. docs/explanation/continuous-trajectory.md derives the equations.
"""

from tsgt.geometry.trajectory.fixed_lag import FixedLagSmoother, Predictions
from tsgt.geometry.trajectory.gauss_newton import (
    MIN_KNOT_SPACING_S,
    OUTLIER_THRESHOLD,
    Solution,
    knot_times,
    nearest_knots,
    solve,
)
from tsgt.geometry.trajectory.initialisation import initial_guess
from tsgt.geometry.trajectory.innovation_monitor import AMBIGUITY_MARGIN_S, NOT_BY_CHANCE_NIS, OWN_PRISM_M
from tsgt.geometry.trajectory.measurement_factors import (
    LinearisedMeasurements,
    Observations,
    line_of_sight_axes,
    linearise,
)
from tsgt.geometry.trajectory.measurement_window import MeasurementWindow
from tsgt.geometry.trajectory.query import (
    QueriedTrajectory,
    Trajectory,
    ros_covariance,
    state_at_point,
    with_second_order_terms,
)
from tsgt.geometry.trajectory.sensitivity import SetupJacobian, coupling
from tsgt.geometry.trajectory.states import POSE_DIM, STATE_DIM, States, concatenate_states

__all__ = [
    "AMBIGUITY_MARGIN_S",
    "MIN_KNOT_SPACING_S",
    "NOT_BY_CHANCE_NIS",
    "OUTLIER_THRESHOLD",
    "OWN_PRISM_M",
    "POSE_DIM",
    "STATE_DIM",
    "FixedLagSmoother",
    "LinearisedMeasurements",
    "MeasurementWindow",
    "Observations",
    "Predictions",
    "QueriedTrajectory",
    "SetupJacobian",
    "Solution",
    "States",
    "Trajectory",
    "concatenate_states",
    "coupling",
    "initial_guess",
    "knot_times",
    "line_of_sight_axes",
    "linearise",
    "nearest_knots",
    "ros_covariance",
    "solve",
    "state_at_point",
    "with_second_order_terms",
]
