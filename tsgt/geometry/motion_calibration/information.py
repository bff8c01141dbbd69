"""What measurements say about the errors of a set-up, trajectories eliminated, and the evidence of priors on them. Sans-I/O.

A prior is a factor L, (G, r), of its covariance ``L L^T``. The evidence follows in closed form from the quadratic information
(R. E. Kass and A. E. Raftery, Bayes factors, JASA 90, 1995), so that hypotheses cost nothing compared with the trajectories.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray


class Information(NamedTuple):
    """Quadratic about zero errors."""

    matrix: FloatArray  # (G, G) information
    vector: FloatArray  # (G,) information times the most likely errors: the negative gradient of half the cost at zero

    def evidence(self, factor: FloatArray) -> float:
        """Log marginal likelihood under a prior of a factor (G, r), against no errors at all."""
        normal, projected = self.normal(factor), factor.T @ self.vector
        quadratic = float(projected @ np.linalg.solve(normal, projected))
        return 0.5 * (quadratic - float(np.linalg.slogdet(normal)[1]))

    def max_evidence(self, least: FloatArray, most: FloatArray) -> float:
        """Upper bound of the evidence of all priors that include ``least`` and are included in ``most``, factors (G, r).

        A wider prior fits better, and costs at least what ``least`` costs.
        """
        fitted = self.evidence(most) + 0.5 * float(np.linalg.slogdet(self.normal(most))[1])
        return fitted - 0.5 * float(np.linalg.slogdet(self.normal(least))[1])

    def coordinates(self, factor: FloatArray) -> FloatArray:
        """(r,) most probable errors in the coordinates of a prior's factor (G, r)."""
        return np.asarray(np.linalg.solve(self.normal(factor), factor.T @ self.vector))

    def posterior(self, factor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (G,) and covariance (G, G) of the errors under a prior of a factor (G, r)."""
        covariance = factor @ np.linalg.inv(self.normal(factor)) @ factor.T
        return factor @ self.coordinates(factor), 0.5 * (covariance + covariance.T)

    def normal(self, factor: FloatArray) -> FloatArray:
        """(r, r) normal matrix in the coordinates of a prior's factor (G, r)."""
        normal: FloatArray = np.eye(factor.shape[1]) + factor.T @ self.matrix @ factor
        return normal
