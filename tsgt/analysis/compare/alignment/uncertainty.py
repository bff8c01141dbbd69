"""What the motion determines, and how well: covariance of a fit whose errors are correlated beyond its model."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from tsgt.analysis.compare.alignment.drifting_frame import NAMES

if TYPE_CHECKING:
    from tsgt.analysis.compare.alignment.drifting_frame import Rows, Solved
    from tsgt.geometry import FloatArray

OBSERVABLE_SIGMA = dict(zip(NAMES, [0.05, 1e-3, 0.1, *[0.05] * 3, *[math.radians(1.0)] * 3], strict=True))
"""Sigma above which the motion does not determine an unknown to any use."""

WEAK_SIGMA = {
    "offset_s": 0.5e-3,
    **{f"extrinsic_{axis}_m": 2.5e-3 for axis in "xyz"},
    **{f"extrinsic_{axis}_rad": math.radians(0.05) for axis in ("roll", "pitch", "yaw")},
}
"""Sigma above which an unknown is not determined within 1 ms, 5 mm or 0.1 degrees at two sigmas."""

WEAK_AGAINST_PRIOR = 2.0  # Sigma of the motion to that of the prior, above which the prior remains

CORRELATION_S = 15.0
"""Time over which errors may be correlated beyond the drift that is modelled."""


def weak_unknowns(solved: Solved, active: list[int], prior_weight: FloatArray) -> list[int]:
    """Return the unknowns that the motion does not determine, the weakest first: each that goes makes others determinable."""
    limit = np.array([OBSERVABLE_SIGMA[NAMES[i]] for i in active])
    weight = prior_weight[active]
    with_prior = weight > 0
    limit[with_prior] = np.minimum(limit[with_prior], WEAK_AGAINST_PRIOR / np.sqrt(weight[with_prior]))
    information = (solved.information - np.diag(weight)) * limit[:, None] * limit
    remaining, weak = list(range(len(active))), []
    while remaining:
        values, vectors = np.linalg.eigh(information[np.ix_(remaining, remaining)])
        variance = (vectors**2 / np.maximum(values, 1e-9)).sum(axis=1)
        worst = int(np.argmax(variance))
        if variance[worst] <= 1.0:
            break
        weak.append(active[remaining.pop(worst)])
    return weak


def weakest_by_stated_sigma(covariance: FloatArray, active: list[int], prior_weight: FloatArray) -> list[int]:
    """Return the unknown without prior whose stated sigma is furthest above what is of any use; none if all are of use."""
    limit = np.array([OBSERVABLE_SIGMA[NAMES[i]] for i in active])
    excess = np.where(prior_weight[active] > 0, 0.0, np.diag(covariance) / np.maximum(limit**2, 1e-300))
    return [active[int(np.argmax(excess))]] if excess.max(initial=0.0) > 1.0 else []


def fit_covariance(solved: Solved, rows: Rows) -> FloatArray:
    """Covariance of the active unknowns, (P, P): that of the model, widened where the residuals' pull is correlated beyond it.

    Sandwich of the information around the covariance of the scores, whose correlation over time counts with Bartlett's
    weights (W. K. Newey and K. D. West, 1987).
    """
    p = len(solved.information)
    if not p:
        return np.zeros((0, 0))
    model = np.linalg.pinv(solved.information)
    scores = solved.scores
    lags = max(1, round(CORRELATION_S / float(np.median(rows.step_s))))
    n = len(scores)
    padded = np.concatenate([np.zeros((lags, p)), scores, np.zeros((lags, p))])
    running = np.cumsum(np.concatenate([np.zeros((1, p)), padded]), axis=0)
    sums = running[lags:] - running[:-lags]
    # Sums over every window of this length: Bartlett's weights. Fewer independent windows than unknowns say too little.
    meat = sums.T @ sums / lags
    windows = n / lags
    freedom = max(windows - p, 2.0)
    sandwich = model @ meat @ model * max(windows / freedom, 1.0)
    ratio = np.diag(sandwich) / np.maximum(np.diag(model), 1e-300)
    # What few windows say of one unknown is uncertain itself: never less than the average of all, and as Student's t has it.
    wider = np.sqrt(np.maximum(ratio, max(1.0, float(ratio.mean()))))
    wider *= float(stats.t.ppf(stats.norm.cdf(2.0), freedom)) / 2.0
    return np.asarray(model * wider[:, None] * wider)
