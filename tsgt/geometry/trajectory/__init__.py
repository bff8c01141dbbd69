"""TODO face."""

from tsgt.geometry.trajectory.batch import Fit, fit
from tsgt.geometry.trajectory.fixed_lag import FixedLag
from tsgt.geometry.trajectory.gauss_newton import LEAST_STEP_S, Solution, knot_times, nearest, solve
from tsgt.geometry.trajectory.hyperparameters import CALMEST, at_least, scaled, tune
from tsgt.geometry.trajectory.initialisation import first_guess
from tsgt.geometry.trajectory.measurement_factors import Linearised, Observations, linearise
from tsgt.geometry.trajectory.query import Trajectory, of_point, ros_covariance, with_curvature
from tsgt.geometry.trajectory.states import STATE, Knots, joined

__all__ = [
    "CALMEST",
    "LEAST_STEP_S",
    "STATE",
    "Fit",
    "FixedLag",
    "Knots",
    "Linearised",
    "Observations",
    "Solution",
    "Trajectory",
    "at_least",
    "first_guess",
    "fit",
    "joined",
    "knot_times",
    "linearise",
    "nearest",
    "of_point",
    "ros_covariance",
    "scaled",
    "solve",
    "tune",
    "with_curvature",
]
