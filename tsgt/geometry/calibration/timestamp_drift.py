"""Time stamps that wander, as a calibration from motion allows for them. Pure.

A station's clock is followed to a millisecond or so, and what is left changes over minutes: it is no noise that averages out
from one measurement to the next, and a trajectory that is late by a different time in each piece of a recording looks like
turned frames. So in each piece of a recording every station may be late by some time of its own beside its latency, all of
one size (a random effect), and that size is the one that makes the pieces most probable (restricted maximum likelihood: D. A.
Harville, Journal of the American Statistical Association 72, 1977).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray

LEAST_WANDER_S = 1e-5
MOST_WANDER_S = 0.1
"""Less makes no difference with any instrument, more is no wandering."""


class Part(NamedTuple):
    """What one piece of a recording tells of G unknowns.

    Attributes
    ----------
    information
        (G, G), the piece's trajectory eliminated.
    gradient
        (G,) of half the cost.
    """

    information: FloatArray
    gradient: FloatArray


class Allowed(NamedTuple):
    """A piece with its wandering eliminated as well.

    Attributes
    ----------
    part
        What is left of it.
    gained
        By how much half the piece's cost falls.
    log_share
        Logarithm of how much of what is known of the wandering was known beforehand.
    """

    part: Part
    gained: float
    log_share: float


def allowed_for(part: Part, latencies: NDArray[np.intp], wander_s: float) -> Allowed:
    """Let each station be late by some time of its own in a piece.

    Parameters
    ----------
    part
        The piece.
    latencies
        (n,) which of the unknowns are latencies, of all stations but the first.
    wander_s
        One sigma of that time, of each station.
    """
    information, gradient = part
    # Those beside station 1: it wanders, too, and all others the other way with it.
    known = wander_s**2 * (np.eye(len(latencies)) + 1.0)
    share = np.eye(len(latencies)) + known @ information[np.ix_(latencies, latencies)]
    covariance = np.linalg.solve(share, known)
    covariance = 0.5 * (covariance + covariance.T)
    mixed = information[:, latencies]
    late = gradient[latencies]
    left = Part(information - mixed @ covariance @ mixed.T, gradient - mixed @ covariance @ late)
    return Allowed(left, 0.5 * float(late @ covariance @ late), -float(np.linalg.slogdet(share)[1]))


def likely_wander_s(parts: Sequence[Part], known: Part, latencies: NDArray[np.intp]) -> float:
    """How much stations' time stamps wander from piece to piece, one sigma; 0 if nothing speaks for it.

    Parameters
    ----------
    parts
        The pieces of a recording, all about one set-up.
    known
        What is known of the unknowns beforehand, about the same set-up.
    latencies
        (n,) which of the unknowns are latencies.
    """
    if not len(latencies) or len(parts) < 2:
        return 0.0

    def negative(log_wander: float) -> float:
        allowed = [allowed_for(part, latencies, float(np.exp(log_wander))) for part in parts]
        information = known.information + sum(each.part.information for each in allowed)
        gradient = known.gradient + sum(each.part.gradient for each in allowed)
        probable = sum(each.gained + 0.5 * each.log_share for each in allowed)
        probable += 0.5 * float(gradient @ np.linalg.solve(information, gradient))
        return -float(probable - 0.5 * np.linalg.slogdet(information)[1])

    bounds = (float(np.log(LEAST_WANDER_S)), float(np.log(MOST_WANDER_S)))
    found = minimize_scalar(negative, bounds=bounds, method="bounded", options={"xatol": 0.01})
    # At the bound below nothing speaks for it, and the search stops just short of the bound.
    return float(np.exp(found.x)) if found.fun < negative(bounds[0]) - 1e-6 else 0.0
