"""Trajectory of a whole recording: fit, hyperparameters, noise of each station, rest as a state of the motion. Sans-I/O.

:func:`fit_trajectory` is the entry; :func:`tune` estimates process noise and noise scales, :func:`find_rest` intervals of rest.
The factors and the solver are those of ``geometry.trajectory``.
"""

from tsgt.geometry.batch.fit import TrajectoryFit, fit_trajectory
from tsgt.geometry.batch.hyperparameters import NOISE_FLOOR_SHARE, tune, with_noise_floor
from tsgt.geometry.batch.noise_scales import overall_scale, scale_noise
from tsgt.geometry.batch.rest import RestInterval, in_rest
from tsgt.geometry.batch.rest_detection import Series, find_rest, find_rest_in_series

__all__ = [
    "NOISE_FLOOR_SHARE",
    "RestInterval",
    "Series",
    "TrajectoryFit",
    "find_rest",
    "find_rest_in_series",
    "fit_trajectory",
    "in_rest",
    "overall_scale",
    "scale_noise",
    "tune",
    "with_noise_floor",
]
