"""The trajectory with an IMU online: a window of knots that moves with time, and prediction to now. Sans-I/O.

In: samples and measurements as they arrive, late ones too. Out: predicted and smoothed states with covariances, and whether the IMU
is used (`health`, `saturation`). `start_search` finds a trajectory, `fixed_lag` updates its window (`window`) from `held_samples`;
`window_trajectory` gives its states at any time; `prediction` integrates from its newest knot, and `rate_prediction` goes on where
samples end; `known_rotation` carries a rotation over a loss.
"""

from tsgt.geometry.inertial.live.fixed_lag import InertialFixedLagSmoother
from tsgt.geometry.inertial.live.health import (
    DISAGREES_WITH_PRISMS,
    SHOCK,
    judge_magnitudes,
    usable_samples,
)
from tsgt.geometry.inertial.live.saturation import SaturationMonitor

__all__ = [
    "DISAGREES_WITH_PRISMS",
    "SHOCK",
    "InertialFixedLagSmoother",
    "SaturationMonitor",
    "judge_magnitudes",
    "usable_samples",
]
