"""Search for the few causes that explain a misfit: subsets of additional unknowns in a linear least-squares problem.

Each cause is a block of columns. The subset minimises a penalised likelihood, in which the noise is as stated or, at a price,
of unknown scale: noise larger than stated is not taken for many causes. Two causes that mask each other are found because all
pairs are tried.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray

Subset = tuple[int, ...]

NOISE_SCALE_PENALTY = 10.0  # By how much an unknown noise scale must lower twice the negative log-likelihood
MAX_CAUSES = 8
BLOCK = 4  # Columns of a cause, at most
MIN_REDUNDANCY = (
    1e-6  # Share of a column that least squares leaves in the residuals; below, it has no effect on them
)
AMBIGUITY = 9.2
"""Difference of twice the log-likelihood below which an alternative is not excluded: a likelihood ratio of 100."""


class CauseSearch:
    """Causes of a misfit, by index.

    Parameters
    ----------
    columns, projected : (m, c) whitened columns of all causes, and what least squares leaves of them in the residuals.
    residuals : (m,) whitened, after least squares.
    redundancy : Degrees of freedom of the residuals.
    blocks : Columns of each cause, at most four.
    priors : (c,) information of a prior about zero on each column; zero where there is none.
    penalties : By how much each cause must lower twice the negative log-likelihood to be chosen at all.
    odds : Twice the negative logarithm of how probable each cause is; also counts between causes that explain the same.
    allowed : Whether a subset may be chosen at all.
    """

    def __init__(
        self,
        columns: FloatArray,
        projected: FloatArray,
        residuals: FloatArray,
        *,
        redundancy: int,
        blocks: Sequence[Sequence[int]],
        priors: FloatArray,
        penalties: FloatArray,
        odds: FloatArray,
        allowed: Callable[[Subset], bool],
    ) -> None:
        norms = np.sqrt(np.maximum(np.sum(columns**2, axis=0), 1e-300))
        products = columns.T @ projected / np.outer(norms, norms)
        gains = columns.T @ residuals / norms
        size = len(blocks) * BLOCK
        self._matrix, self._vector = np.eye(size), np.zeros(size)
        self._norms = np.ones(size)
        places = [
            (place, column)
            for block, own in enumerate(blocks)
            for place, column in enumerate(own, start=block * BLOCK)
            if products[column, column] > MIN_REDUNDANCY
        ]
        if places:
            to, of = np.array(places).T
            self._matrix[np.ix_(to, to)] = products[np.ix_(of, of)] + MIN_REDUNDANCY * np.eye(len(to))
            self._matrix[to, to] += priors[of] / norms[of] ** 2
            self._vector[to] = gains[of]
            self._norms[to] = norms[of]
        self._chi_squared = float(residuals @ residuals)
        self._redundancy = max(redundancy, 1)
        self._count = len(blocks)
        self._penalties = penalties
        self._odds = odds
        self._allowed = allowed

    def costs(self, subsets: Sequence[Subset]) -> FloatArray:
        """Penalised cost of subsets of one size: twice the negative log-likelihood, up to a constant."""
        index = np.array(subsets, dtype=np.intp).reshape(len(subsets), -1)
        matrix, vector = self._blocks(index)
        drop = np.sum(vector * np.linalg.solve(matrix, vector), axis=(1, 2)) if index.shape[1] else 0.0
        n = self._redundancy
        rest = np.maximum(self._chi_squared - drop, 1e-9)
        rescaled = n * (1.0 + np.log(np.maximum(rest / n, 1.0))) + NOISE_SCALE_PENALTY
        cost: FloatArray = np.minimum(rest, rescaled) + (self._penalties + self._odds)[index].sum(axis=1)
        return cost

    def estimates(self, chosen: Subset) -> dict[int, FloatArray]:
        """Return the value (4,) of each chosen cause, in the units of its columns; unused columns are zero."""
        if not chosen:
            return {}
        index = np.array([chosen], dtype=np.intp)
        matrix, vector = self._blocks(index)
        values = np.linalg.solve(matrix, vector)[0, :, 0].reshape(len(chosen), BLOCK)
        return {
            cause: value / self._norms[cause * BLOCK : (cause + 1) * BLOCK]
            for cause, value in zip(chosen, values, strict=True)
        }

    def best(self) -> Subset:
        """Return the causes of the lowest cost, found by adding one or two, removing and exchanging."""
        chosen: Subset = ()
        cost = float(self.costs([chosen])[0])
        while True:
            improved = self._improved(chosen, cost)
            if improved is None:
                return chosen
            chosen, cost = improved

    def alternatives(self, chosen: Subset) -> dict[int, tuple[int, ...]]:
        """Return by chosen cause the others that explain the same nearly as well, whatever their penalties."""
        base = float(self.costs([chosen])[0]) - self._penalties[list(chosen)].sum()
        others = [cause for cause in range(self._count) if cause not in chosen]
        result: dict[int, tuple[int, ...]] = {}
        for cause in chosen:
            exchanged = [tuple(other if each == cause else each for each in chosen) for other in others]
            if exchanged:
                costs = self.costs(exchanged) - self._penalties[np.array(exchanged)].sum(axis=1)
                near = costs < base + AMBIGUITY
                result[cause] = tuple(other for other, is_near in zip(others, near, strict=True) if is_near)
        return result

    def _blocks(self, index: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Return normal matrices (s, b, b) and right-hand sides (s, b, 1) of subsets (s, k)."""
        places = (index[:, :, None] * BLOCK + np.arange(BLOCK)).reshape(len(index), -1)
        return self._matrix[places[:, :, None], places[:, None, :]], self._vector[places][:, :, None]

    def _improved(self, chosen: Subset, cost: float) -> tuple[Subset, float] | None:
        others = [cause for cause in range(self._count) if cause not in chosen]
        without = [tuple(each for each in chosen if each != cause) for cause in chosen]
        neighbours = [without]
        if len(chosen) < MAX_CAUSES:
            neighbours.append([(*chosen, other) for other in others])
        if len(chosen) + 1 < MAX_CAUSES:
            neighbours.append([(*chosen, *pair) for pair in combinations(others, 2)])
        neighbours.append([(*rest, other) for rest in without for other in others])
        found: list[tuple[float, Subset]] = []
        for subsets in neighbours:
            if not subsets:
                continue
            costs = self.costs(subsets)
            for row in np.argsort(costs):
                if costs[row] >= cost - 1e-9:
                    break
                if self._allowed(subsets[row]):
                    found.append((float(costs[row]), subsets[row]))
                    break
        if not found:
            return None
        best_cost, best = min(found)
        return best, best_cost
