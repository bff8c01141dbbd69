"""Held-out prediction of a recording's measurements by both estimators."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.held_out import FOLDS, folds, hold_out, missed_by_lines, missed_by_trajectory, never_out
from tsgt.analysis.smoothing import motion_of
from tsgt.geometry.fit import fit

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.analysis.held_out import Fold, HeldOut
    from tsgt.analysis.processing import Estimator
    from tsgt.geometry import FloatArray, Observations
    from tsgt.model import PipelineParameters


def held_out(
    observations: Observations,
    pipeline: PipelineParameters,
    *,
    on_progress: Callable[[float], None] | None = None,
) -> dict[Estimator, HeldOut]:
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
        motions.append(motion_of(observations.select(never_out(observations, number)), pipeline))
    done = 0

    def missed(fold: Fold) -> FloatArray:
        nonlocal done
        report(0.5 + 0.5 * done / len(parts))
        done += 1
        motion = motions[fold.number]
        found = fit(
            observations.select(fold.kept),
            prior=motion.prior,
            while_hidden=pipeline.motion,
            noise_scale=motion.noise_scale,
        )
        return missed_by_trajectory(found.trajectory, observations.select(fold.out))

    result: dict[Estimator, HeldOut] = {
        "linear": hold_out(parts, lambda fold: missed_by_lines(observations, fold)),
        "continuous": hold_out(parts, missed),
    }
    report(1.0)
    return result
