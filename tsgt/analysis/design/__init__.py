"""Planning before the field: where to put prisms and stations, and what noise does to poses.

Comes in: a prism layout or an envelope, stations with their noise, robot poses. Goes out: pose covariances and their
summary, the same with an IMU and fewer stations, the optimal layout, Monte Carlo error statistics.
"""

from tsgt.analysis.design.inertial_study import DrivenPath, InertialAccuracy, inertial_accuracy
from tsgt.analysis.design.layout_search import Criterion, LayoutProblem, optimal_layout
from tsgt.analysis.design.layout_study import (
    HEADING_COUNT,
    PoseAccuracy,
    RobotPoses,
    Station,
    pose_covariances,
    station_arrangements,
)
from tsgt.analysis.design.perturbation import (
    Perturbation,
    equivalent_noise,
    first_order_sigmas,
    perturbation_study,
    perturbed,
)

__all__ = [
    "HEADING_COUNT",
    "Criterion",
    "DrivenPath",
    "InertialAccuracy",
    "LayoutProblem",
    "Perturbation",
    "PoseAccuracy",
    "RobotPoses",
    "Station",
    "equivalent_noise",
    "first_order_sigmas",
    "inertial_accuracy",
    "optimal_layout",
    "perturbation_study",
    "perturbed",
    "pose_covariances",
    "station_arrangements",
]
