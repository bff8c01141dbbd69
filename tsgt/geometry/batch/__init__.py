"""Trajectory of a whole recording: fit, hyperparameters, noise of each station. Sans-I/O.

:func:`fit_trajectory` is the entry; :func:`tune` estimates process noise and noise scales.
The factors and the solver are those of ``geometry.trajectory``.
"""

from tsgt.geometry.batch.fit import TrajectoryFit, TrajectoryInPieces, TrajectoryPiece, fit_trajectory
from tsgt.geometry.batch.hyperparameters import NOISE_FLOOR_SHARE, tune, with_noise_floor
from tsgt.geometry.batch.knots import shared_knot_times
from tsgt.geometry.batch.noise_scales import overall_scale, scale_noise

__all__ = [
    "NOISE_FLOOR_SHARE",
    "TrajectoryFit",
    "TrajectoryInPieces",
    "TrajectoryPiece",
    "fit_trajectory",
    "overall_scale",
    "scale_noise",
    "shared_knot_times",
    "tune",
    "with_noise_floor",
]
