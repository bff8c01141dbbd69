"""How lively a robot must be taken to be, whatever its measurements show of it. Pure.

Driving is not Gaussian: straight for minutes, then a bend. A motion prior that was tuned to the straights calls the bend
impossible. While all prisms are seen the measurements overrule it; while one is hidden they do not.
docs/explanation/continuous-trajectory.md has what follows from that, and what was measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.motion_prior import axis_sigmas, axis_times_s, prior_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import MotionPrior

CALMEST = 1.0 / 3.0
"""No axis of a tuned prior is calmer than this share of the configured one's."""

OUTAGE_S = 2.0
"""A prism that was not measured for longer is hidden."""

_LEAST_PRISMS = 3

_PACE_RADPS = 1.0
"""To speed up and to brake, or to turn there and back, takes about six seconds."""


def at_least(prior: MotionPrior, other: MotionPrior, share: float = 1.0) -> MotionPrior:
    """Make a prior livelier where it is calmer than another.

    What a robot may do unseen is the power of its acceleration at the pace of manoeuvres, ``sigma^2 time / (1 + (pace
    time)^2)``: a sigma counts for little where an acceleration lasts too short, or too long, for one. Correlation times stay.

    Parameters
    ----------
    prior, other
        Both are compared axis by axis.
    share
        The least is the sigma that, with the correlation time of ``prior``, has the power of this share of ``other``'s.
    """
    times_s = axis_times_s(prior)
    least = share * axis_sigmas(other) * np.sqrt(_power(axis_times_s(other)) / _power(times_s))
    return prior_of(np.maximum(axis_sigmas(prior), least), times_s[[0, 3]])


def _power(time_s: FloatArray) -> FloatArray:
    """Power of an acceleration with a sigma of 1 at the pace of manoeuvres, up to a factor."""
    return time_s / (1.0 + (_PACE_RADPS * time_s) ** 2)


def hidden(time_s: FloatArray, prism: NDArray[np.intp], at_s: FloatArray) -> NDArray[np.bool_]:
    """Tell when fewer than three prisms were seen.

    Parameters
    ----------
    time_s, prism
        (M,) when which prism was measured, in the order of time.
    at_s
        (N,) instants that are asked for.

    Returns
    -------
    NDArray[np.bool_]
        (N,) at most two prisms have measurements no more than :data:`OUTAGE_S` apart before and after it.
    """
    seen = np.zeros(len(at_s), np.intp)
    for each in np.unique(prism):
        own_s = np.concatenate([[-np.inf], time_s[prism == each], [np.inf]])
        after = np.searchsorted(own_s, at_s)
        seen += own_s[after] - own_s[after - 1] <= OUTAGE_S
    return seen < _LEAST_PRISMS
