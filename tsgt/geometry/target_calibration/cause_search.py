"""Search for the few causes that explain a misfit: subsets of additional unknowns in a linear least-squares problem.

Each cause is a block of columns. The subset minimises a penalised likelihood. Two causes that mask each other are found
because all pairs are tried.
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

MAX_CAUSES = 8
BLOCK = 4  # Columns of a cause, at most
MIN_REDUNDANCY = (
    1e-6  # Share of a column that least squares leaves in the residuals; below, it has no effect on them
)
AMBIGUITY = 6.0
"""Difference of the cost below which an alternative is not excluded: a ratio of 20 of the probabilities."""


def exchanged(chosen: Subset, old: Subset, new: Subset) -> Subset:
    """Return a subset with some causes in place of others."""
    at = min(chosen.index(each) for each in old)
    rest = [each for each in chosen if each not in old]
    return (*rest[:at], *new, *rest[at:])


class CauseSearch:
    """Causes of a misfit, by index.

    Parameters
    ----------
    columns, projected : (m, c) whitened columns of all causes, and what least squares leaves of them in the residuals.
    residuals : (m,) whitened, after least squares.
    chi_squared : Misfit without any cause.
    blocks : Columns of each cause, at most four.
    penalties : By how much each cause must lower twice the negative log-likelihood to be chosen at all.
    odds : Twice the negative logarithm of how probable each cause is; also counts between causes that explain the same.
    groups : Group of each cause, -1 for none: a second one of a group has no odds against it.
    allowed : Whether a subset may be chosen at all.
    """

    def __init__(
        self,
        columns: FloatArray,
        projected: FloatArray,
        residuals: FloatArray,
        *,
        chi_squared: float,
        blocks: Sequence[Sequence[int]],
        penalties: FloatArray,
        odds: FloatArray,
        groups: NDArray[np.intp],
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
            self._vector[to] = gains[of]
            self._norms[to] = norms[of]
        self._chi_squared = chi_squared
        self._count = len(blocks)
        self._penalties = penalties
        self._odds = odds
        self._members = groups[:, None] == np.arange(max(groups.max(initial=-1) + 1, 1))
        self._pairs = [
            pair for pair in combinations(range(len(blocks)), 2) if groups[pair[0]] == groups[pair[1]] >= 0
        ]
        self._allowed = allowed

    def costs(self, subsets: Sequence[Subset]) -> FloatArray:
        """Penalised cost of subsets of one size: twice the negative log-likelihood, up to a constant."""
        index = np.array(subsets, dtype=np.intp).reshape(len(subsets), -1)
        cost: FloatArray = self.misfits(index) + self._penalties[index].sum(axis=1) + self._odds_of(index)
        return cost

    def misfits(self, index: NDArray[np.intp]) -> FloatArray:
        """Chi-square (s,) with subsets (s, k)."""
        if not index.shape[1]:
            return np.full(len(index), self._chi_squared)
        matrix, vector = self._blocks(index)
        drop = np.sum(vector * np.linalg.solve(matrix, vector), axis=(1, 2))
        rest: FloatArray = np.maximum(self._chi_squared - drop, 1e-9)
        return rest

    def _odds_of(self, index: NDArray[np.intp]) -> FloatArray:
        """Odds of subsets, (s,): of a group only those of its least probable member."""
        odds = self._odds[index]
        alone = np.where(self._members[index].any(axis=2), 0.0, odds).sum(axis=1)
        grouped = (self._members[index] * odds[:, :, None]).max(axis=1, initial=0.0).sum(axis=1)
        total: FloatArray = alone + grouped
        return total

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

    def alternatives(self, chosen: Subset) -> list[tuple[Subset, Subset]]:
        """Return which of the chosen causes others may replace that explain nearly as well, the best first.

        One by one, one by two of a group, and two of a group by one.
        """
        others = [cause for cause in range(self._count) if cause not in chosen]
        exchanges: list[list[tuple[Subset, Subset]]] = [
            [((cause,), (other,)) for cause in chosen for other in others],
            [((cause,), pair) for cause in chosen for pair in self._pairs if not {*pair} & {*chosen}],
            [(pair, (other,)) for pair in self._pairs if {*pair} <= {*chosen} for other in others],
        ]
        limit = float(self.costs([chosen])[0]) + AMBIGUITY
        found: list[tuple[float, tuple[Subset, Subset]]] = []
        for some in filter(None, exchanges):
            costs = self.costs([exchanged(chosen, *each) for each in some]).tolist()
            found += [(cost, each) for cost, each in zip(costs, some, strict=True) if cost < limit]
        return [each for _, each in sorted(found)]

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
        if len(chosen) < MAX_CAUSES:
            neighbours.append(
                [(*rest, *pair) for rest in without for pair in self._pairs if not {*pair} & {*rest}]
            )
        if len(chosen) > 1:
            fewer = [tuple(each for each in chosen if each not in pair) for pair in combinations(chosen, 2)]
            neighbours.append([(*rest, other) for rest in fewer for other in others])
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
