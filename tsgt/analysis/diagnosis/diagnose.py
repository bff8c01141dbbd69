"""Finds the errors that a recording shows: alternates between noise and set-up until neither changes. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.diagnosis.noise_factors import (
    estimate_noise,
    lock_losses,
    single_outliers,
    without_lock_losses,
)
from tsgt.analysis.smoothing import estimate_motion_model
from tsgt.geometry.motion_calibration import CauseSelection, SetupErrors, cause_hypotheses, linearise_setup

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.diagnosis.noise_factors import LockLoss, NoiseEstimate
    from tsgt.analysis.smoothing import MotionModel
    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import CauseHypothesis, LinearisedSetup, SelectedCause
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import Parameters

MAX_ROUNDS = 5
COARSE_NOISE_SCALES = (10.0, 1.0)  # First, so that a wrong set-up makes few outliers
MIN_NOISE = 0.7  # A component whose noise the motion absorbs must not make everything else significant


@dataclass(frozen=True, slots=True, eq=False)
class Analysis:
    """Errors of set-up and noise that a recording shows.

    Attributes
    ----------
    causes : Of the set-up, the most evident first.
    effects_m : Of each cause, the displacement of the measured prisms that it causes (rms).
    single : Log Bayes factor of each hypothesis alone, with its estimate and sigma, about the recorded set-up.
    linearised : At the most likely errors of the set-up.
    """

    layout: SetupErrors
    causes: tuple[SelectedCause, ...]
    effects_m: tuple[float, ...]
    single: dict[CauseHypothesis, float]
    linearised: LinearisedSetup
    noise: NoiseEstimate
    lock_loss: LockLoss | None
    outliers: NDArray[np.intp]


def analyse(observations: Observations, parameters: Parameters, motion: MotionModel) -> Analysis:
    """Find errors of the set-up and noise.

    ``observations``: with the recorded set-up and the stated noise, in the order of time. ``motion``: estimated from them.
    Raises GeometryError: the measurements do not determine a trajectory.
    """
    layout = SetupErrors(
        tuple(each.station for each in parameters.stations), tuple(each.prism for each in parameters.prisms)
    )
    nominal = layout.nominal_covariance(parameters.setup_covariance)
    candidates = cause_hypotheses(layout)
    # Noise from the most general model, as in any regression: a wrong set-up would pass for noise, and hide itself.
    everything = frozenset(candidates)
    errors = np.zeros(len(layout))
    for scale in COARSE_NOISE_SCALES:
        linearised = linearise_setup(layout, observations, errors, motion.prior, scale * floored(motion))
        prior = CauseSelection(linearised.information, nominal, candidates).prior(everything)
        errors, _ = linearised.information.posterior(prior)
    motion = estimate_motion_model(layout.corrected(observations, errors), parameters.pipeline)
    linearised = linearise_setup(layout, observations, errors, motion.prior, floored(motion))
    lock_loss = lock_losses(linearised, estimate_noise(linearised, floored(motion)).normalised)
    if lock_loss is not None:
        observations = without_lock_losses(observations, lock_loss)
        motion = estimate_motion_model(layout.corrected(observations, errors), parameters.pipeline)
        linearised = linearise_setup(layout, observations, errors, motion.prior, floored(motion))
    chosen: frozenset[CauseHypothesis] | None = None
    noise = floored(motion)
    for number in range(MAX_ROUNDS):
        if number:
            linearised = linearise_setup(layout, observations, errors, motion.prior, noise)
        selection = CauseSelection(linearised.information, nominal, candidates)
        found = selection.search(chosen or frozenset())
        if found == chosen:
            break
        chosen = found
        errors, _ = linearised.information.posterior(selection.prior(chosen))
    chosen = chosen or frozenset()
    causes = tuple(selection.summarise(chosen))
    estimate = estimate_noise(linearised, noise)
    return Analysis(
        layout,
        causes,
        tuple(_effect_m(linearised, each) for each in causes),
        selection.single(),
        linearised,
        estimate,
        lock_loss,
        single_outliers(linearised, estimate.normalised),
    )


def floored(motion: MotionModel) -> FloatArray:
    """Factors on the noise, (S, 3), none far below 1."""
    return np.maximum(motion.noise_scales, MIN_NOISE)


def _effect_m(linearised: LinearisedSetup, cause: SelectedCause) -> float:
    """Displacement of the measured prisms by a cause, rms over the measurements that it displaces."""
    displaced = linearised.by_errors[:, :, list(cause.hypothesis.rows)] @ cause.estimate
    squared = (displaced**2).sum(axis=1)
    return float(np.sqrt(squared[squared > 0].mean())) if (squared > 0).any() else 0.0
