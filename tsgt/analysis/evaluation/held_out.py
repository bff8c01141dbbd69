"""How well measurements that an estimator has not seen are predicted from the rest. Pure.

No reference is needed, and nothing that all prisms have in common hides: where a prism was measured is compared with where
the estimator, fitted without that measurement, puts it. Each prism's measurements are dealt out to five folds in turn; a fold
of one prism is left out at a time. docs/reference/evaluate.md says what the figures mean.

Held-out prediction of a recording's measurements by both estimators.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.smoothing import estimate_motion_model
from tsgt.geometry.trajectory import fit_trajectory

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from tsgt.analysis.processing import Estimator
    from tsgt.geometry import FloatArray, Observations
    from tsgt.geometry.trajectory import Trajectory
    from tsgt.model import PipelineParameters

FOLDS = 5

EDGE = 5
"""The first and last so many measurements of a prism are never left out: beyond them there is nothing to predict from."""

GAP_S = 1.0
"""A left-out measurement whose remaining neighbours are further apart counts apart, as one at a gap."""


@dataclass(frozen=True, slots=True)
class Fold:
    """What is left out at a time: about a fifth of one prism's measurements.

    Attributes
    ----------
    number
        Which fifth, from 0.
    test, training
        Rows of the observations that are left out, and all others; increasing.
    at_gap
        For each of ``out``: the prism's remaining measurements before and after it are more than a second apart.
    """

    number: int
    test: NDArray[np.intp]
    training: NDArray[np.intp]
    at_gap: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PredictionErrorStatistics:
    """Misses of left-out measurements in mm; NaN without any."""

    mean: float
    median: float
    p95: float
    n: int

    @classmethod
    def of(cls, error_m: FloatArray) -> PredictionErrorStatistics:
        """Sum misses in m up."""
        if not len(error_m):
            return cls(math.nan, math.nan, math.nan, 0)
        missed_mm = 1e3 * error_m
        return cls(
            mean=float(np.mean(missed_mm)),
            median=float(np.median(missed_mm)),
            p95=float(np.percentile(missed_mm, 95)),
            n=len(missed_mm),
        )


@dataclass(frozen=True, slots=True)
class HeldOutErrors:
    """Misses of all left-out measurements, in the order of the folds.

    Attributes
    ----------
    error_m
        (N,) distance between where the prism was measured and where it was predicted.
    at_gap
        (N,) as in :class:`Fold`.
    """

    error_m: FloatArray
    at_gap: NDArray[np.bool_]

    @property
    def statistics(self) -> PredictionErrorStatistics:
        """Of those that are not at gaps."""
        return PredictionErrorStatistics.of(self.error_m[~self.at_gap])

    @property
    def gaps(self) -> PredictionErrorStatistics:
        """Of those at gaps."""
        return PredictionErrorStatistics.of(self.error_m[self.at_gap])


def folds(observations: Observations) -> list[Fold]:
    """Deal the measurements of each prism out; prisms with too few of them have no fold.

    Parameters
    ----------
    observations
        In the order of time.

    Returns
    -------
    list of Fold
        At most five for each prism, sorted by their number.
    """
    found = []
    for number in range(FOLDS):
        for prism in range(len(observations.layout)):
            rows = np.flatnonzero(observations.prism == prism)
            places = np.arange(number, len(rows), FOLDS)
            places = places[(places >= EDGE) & (places < len(rows) - EDGE)]
            if not len(places):
                continue
            time_s = observations.time_s[rows]
            # Its neighbours belong to other folds and stay.
            at_gap = time_s[places + 1] - time_s[places - 1] > GAP_S
            kept = np.ones(len(observations), np.bool_)
            kept[rows[places]] = False
            found.append(Fold(number, rows[places], np.flatnonzero(kept), at_gap))
    return found


def training_rows(observations: Observations, number: int) -> NDArray[np.intp]:
    """Rows that no fold of a number leaves out, of whichever prism.

    What is estimated from these (a prior, stations' frames) may serve all folds of this number: it has seen none of the
    measurements that they predict.
    """
    kept = np.ones(len(observations), np.bool_)
    for fold in folds(observations):
        if fold.number == number:
            kept[fold.test] = False
    return np.flatnonzero(kept)


def cross_validate(parts: Sequence[Fold], error_m: Callable[[Fold], FloatArray]) -> HeldOutErrors:
    """Collect what an estimator misses.

    Parameters
    ----------
    parts
        From :func:`folds`.
    error_m
        Given a fold, predicts what it leaves out from what it keeps; by how much it misses each, in m.
    """
    if not parts:
        return HeldOutErrors(np.empty(0), np.empty(0, np.bool_))
    return HeldOutErrors(
        np.concatenate([error_m(fold) for fold in parts]), np.concatenate([fold.at_gap for fold in parts])
    )


def interpolation_errors(observations: Observations, fold: Fold) -> FloatArray:
    """Predict by straight lines between each prism's own measurements, as the estimator ``linear`` does; misses in m."""
    points = observations.in_world()
    prism = observations.prism[fold.test[0]]
    kept = fold.training[observations.prism[fold.training] == prism]
    time_s = observations.time_s[fold.test]
    lines = [np.interp(time_s, observations.time_s[kept], points[kept, axis]) for axis in range(3)]
    missed: FloatArray = np.linalg.norm(np.stack(lines, axis=1) - points[fold.test], axis=1)
    return missed


def trajectory_errors(trajectory: Trajectory, left_out: Observations) -> FloatArray:
    """By how much a trajectory misses measurements of prisms, in m."""
    states, _ = trajectory.at(left_out.time_s)
    arms = left_out.layout[left_out.prism]
    predicted = states.position + (states.rotation @ arms[..., None])[..., 0]
    missed: FloatArray = np.linalg.norm(predicted - left_out.in_world(), axis=1)
    return missed


def held_out_errors(
    observations: Observations,
    pipeline: PipelineParameters,
    *,
    on_progress: Callable[[float], None] | None = None,
) -> dict[Estimator, HeldOutErrors]:
    """Leave measurements out and predict them.

    How the robot moves is found five times, each time without the measurements of one number's folds of all prisms, so
    that nothing that predicts a measurement has seen it.

    Parameters
    ----------
    observations
        In the order of time, with the stated noise.
    pipeline
        How the robot moves if the measurements are too few to tell, and how lively it is at least.
    on_progress
        Called now and then with the share of the work that is done, 0 to 1.

    Raises
    ------
    GeometryError
        No trajectory fits what is kept.
    """
    report = on_progress or (lambda _: None)
    parts = folds(observations)
    motions = []
    for number in range(FOLDS if parts else 0):
        report(number / (2 * FOLDS))
        motions.append(
            estimate_motion_model(observations.select(training_rows(observations, number)), pipeline)
        )
    done = 0

    def missed(fold: Fold) -> FloatArray:
        nonlocal done
        report(0.5 + 0.5 * done / len(parts))
        done += 1
        motion = motions[fold.number]
        found = fit_trajectory(
            observations.select(fold.training),
            prior=motion.prior,
            occluded_prior=pipeline.motion,
            noise_scale=motion.noise_scale,
        )
        return trajectory_errors(found.trajectory, observations.select(fold.test))

    result: dict[Estimator, HeldOutErrors] = {
        "linear": cross_validate(parts, lambda fold: interpolation_errors(observations, fold)),
        "continuous": cross_validate(parts, missed),
    }
    report(1.0)
    return result
