"""Cross-validation: how well the estimators predict measurements that they were not given. Sans-I/O.

Needs no reference, and errors that all prisms share do not cancel: the measured position of a prism is compared with the
prediction of the estimator fitted without that measurement. The measurements of each prism are dealt in turn into five
folds; each fold of one prism is held out once. Of a long recording only the measurements of a few spans are held out.
docs/reference/evaluate.md defines the figures.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tsgt.analysis.evaluation.normalised_prediction import NormalisedErrors, normalised_prediction_errors
from tsgt.analysis.refinement import refine_recorded_setup
from tsgt.analysis.smoothing import estimate_motion_model, recorded_motion_model
from tsgt.estimation import centroid_m, noise_scales
from tsgt.geometry.batch import fit_trajectory, scale_noise
from tsgt.geometry.inertial import fit_inertial_trajectory
from tsgt.geometry.motion_calibration import Setup
from tsgt.geometry.rest import find_rest, in_rest
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from tsgt.analysis.evaluation.normalised_prediction import NormalisedErrorStatistics
    from tsgt.analysis.refinement import Refine
    from tsgt.analysis.smoothing import MotionModel
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialSamples, InertialTrajectory
    from tsgt.geometry.trajectory import Observations, Trajectory
    from tsgt.model import Parameters

Predictor = Literal["linear", "continuous", "continuous_imu"]
"""The estimators, and ``continuous`` with the robot's IMU."""

PREDICTOR_NAMES: dict[Predictor, str] = {
    "linear": "linear",
    "continuous": "continuous",
    "continuous_imu": "continuous, with IMU",
}

FOLDS = 5

MAX_WHOLE_S = 900.0  # Longer recordings are sampled: their figures would hardly change, and take minutes
SPANS, SPAN_S = 6, 30.0  # Evenly spread
CONTEXT_S = 5.0  # On either side of a span, for the trajectory; the motion prior forgets in a second or two

EDGE = 5  # First and last measurements of a prism that are never held out (extrapolation)
GAP_S = 1.0  # A held-out measurement whose neighbours are further apart counts as one at a gap


@dataclass(frozen=True, slots=True)
class Fold:
    """A split of the observations: about a fifth of one prism's measurements is held out.

    Attributes
    ----------
    number : 0 to 4; always 0 in a long recording. Folds of one number share hyperparameters and set-up.
    test, training : Rows of the observations that are held out, and all others, in a long recording those near; increasing.
    at_gap : For each of ``test``: the prism's neighbours before and after it are more than :data:`GAP_S` apart.
    """

    number: int
    test: NDArray[np.intp]
    training: NDArray[np.intp]
    at_gap: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PredictionErrorStatistics:
    """Prediction errors in mm; NaN without any."""

    mean: float
    median: float
    p95: float
    n: int

    @classmethod
    def of(cls, error_m: FloatArray) -> PredictionErrorStatistics:
        """Summarise errors in m."""
        if not len(error_m):
            return cls(math.nan, math.nan, math.nan, 0)
        error_mm = 1e3 * error_m
        return cls(
            mean=float(np.mean(error_mm)),
            median=float(np.median(error_mm)),
            p95=float(np.percentile(error_mm, 95)),
            n=len(error_mm),
        )


@dataclass(frozen=True, slots=True)
class HeldOutErrors:
    """Distance between measured and predicted position of N held-out measurements, by fold; ``at_gap`` as in :class:`Fold`.

    ``normalised``: the same errors by their covariance; None where there is none.
    """

    error_m: FloatArray
    at_gap: NDArray[np.bool_]
    normalised: NormalisedErrors | None = None

    @property
    def statistics(self) -> PredictionErrorStatistics:
        """Of the measurements that are not at gaps."""
        return PredictionErrorStatistics.of(self.error_m[~self.at_gap])

    @property
    def gaps(self) -> PredictionErrorStatistics:
        """Of the measurements at gaps."""
        return PredictionErrorStatistics.of(self.error_m[self.at_gap])

    def normalised_statistics(self) -> dict[str, dict[str, NormalisedErrorStatistics]]:
        """By component, of all measurements that are not at gaps, of the moving and the stationary ones, and of those at gaps."""
        if self.normalised is None:
            return {}
        stationary = self.normalised.stationary
        parts = {
            "all": ~self.at_gap,
            "moving": ~self.at_gap & ~stationary,
            "stationary": ~self.at_gap & stationary,
            "gaps": self.at_gap,
        }
        return {name: self.normalised.statistics(part) for name, part in parts.items()}


def folds(observations: Observations) -> list[Fold]:
    """Split observations, in the order of time, into up to five folds per prism, by number; none with too few measurements.

    If they last longer than :data:`MAX_WHOLE_S` and are of three prisms, each span in which all prisms are measured is split.
    """
    time_s = observations.time_s
    prisms = np.unique(observations.prism)
    if len(prisms) < MIN_PRISMS or time_s[-1] - time_s[0] <= MAX_WHOLE_S:
        return _folds(observations, np.arange(len(time_s)))
    splits = []
    for share in (np.arange(SPANS) + 0.5) / SPANS:
        middle_s = time_s[0] + share * (time_s[-1] - time_s[0])
        margin_s = np.array([-0.5, 0.5]) * SPAN_S
        first, last = np.searchsorted(time_s, middle_s + margin_s + [-CONTEXT_S, CONTEXT_S])
        if len(np.unique(observations.prism[first:last])) == len(prisms):
            splits += _folds(observations, np.arange(first, last), middle_s + margin_s)
    return [replace(fold, number=0) for fold in splits]


def _folds(
    observations: Observations, rows: NDArray[np.intp], within_s: FloatArray | None = None
) -> list[Fold]:
    """Split consecutive ``rows``; only what was measured ``within_s``, (2,), is held out."""
    splits = []
    for number in range(FOLDS):
        for prism in range(len(observations.layout)):
            own = rows[observations.prism[rows] == prism]
            time_s = observations.time_s[own]
            indices = np.arange(number, len(own), FOLDS)
            indices = indices[(indices >= EDGE) & (indices < len(own) - EDGE)]
            if within_s is not None:
                indices = indices[(time_s[indices] >= within_s[0]) & (time_s[indices] <= within_s[1])]
            if not len(indices):
                continue
            # The neighbours belong to other folds and remain in the training set.
            at_gap = time_s[indices + 1] - time_s[indices - 1] > GAP_S
            splits.append(Fold(number, own[indices], np.setdiff1d(rows, own[indices]), at_gap))
    return splits


def training_rows(observations: Observations, number: int) -> NDArray[np.intp]:
    """Return the rows that no fold of this number holds out, of any prism: hyperparameters from these may serve all of them."""
    training = np.ones(len(observations), np.bool_)
    for fold in folds(observations):
        if fold.number == number:
            training[fold.test] = False
    return np.flatnonzero(training)


def cross_validate(splits: Sequence[Fold], error_m: Callable[[Fold], FloatArray]) -> HeldOutErrors:
    """Collect prediction errors over folds; ``error_m`` predicts test from training measurements, with errors in m."""
    if not splits:
        return HeldOutErrors(np.empty(0), np.empty(0, np.bool_))
    return HeldOutErrors(
        np.concatenate([error_m(fold) for fold in splits]), np.concatenate([fold.at_gap for fold in splits])
    )


def interpolation_errors(observations: Observations, fold: Fold) -> FloatArray:
    """Predict by straight lines between each prism's own measurements, as the estimator ``linear`` does; errors in m."""
    points = observations.in_world()
    prism = observations.prism[fold.test[0]]
    training = fold.training[observations.prism[fold.training] == prism]
    time_s = observations.time_s[fold.test]
    lines = [np.interp(time_s, observations.time_s[training], points[training, axis]) for axis in range(3)]
    error_m: FloatArray = np.linalg.norm(np.stack(lines, axis=1) - points[fold.test], axis=1)
    return error_m


def trajectory_errors(trajectory: Trajectory | InertialTrajectory, test: Observations) -> FloatArray:
    """Return the distance in m between measured prism positions and those that a trajectory predicts."""
    states, _ = trajectory.at(test.time_s)
    lever_arms = test.layout[test.prism]
    predicted = states.position + (states.rotation @ lever_arms[..., None])[..., 0]
    error_m: FloatArray = np.linalg.norm(predicted - test.in_world(), axis=1)
    return error_m


def held_out_errors(
    observations: Observations,
    parameters: Parameters,
    *,
    refine: Refine = "auto",
    imu: InertialSamples | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> dict[Predictor, HeldOutErrors]:
    """Cross-validate both estimators on observations in the order of time, with the stated noise and the recorded set-up.

    The hyperparameters are estimated and the set-up is refined for each number, without the test measurements of that
    number's folds of all prisms, so that no prediction depends on the measurement that it is compared with; the pipeline's
    bound the hyperparameters from below, and replace them if the measurements are too few. ``linear`` has the recorded
    set-up. ``imu``: samples on the time axis of the observations, used for a third entry; ``continuous`` is missing where the
    measurements alone determine no trajectory. ``on_progress`` gets the completed fraction, 0 to 1. Raises GeometryError if no trajectory fits the training
    measurements.
    """
    report = on_progress or (lambda _: None)
    splits = folds(observations)
    complete = len(np.unique(observations.prism)) >= MIN_PRISMS
    models = {}
    numbers = sorted({fold.number for fold in splits})
    for number in numbers:
        report(number / (2 * len(numbers)))
        training = observations.select(training_rows(observations, number))
        models[number] = (
            _training_model(training, parameters, refine)
            if complete
            else (
                Setup.of(training),
                recorded_motion_model(training, parameters.pipeline, noise_scales(parameters)),
            )
        )
    done = 0
    normalised: dict[Predictor, list[FloatArray]] = {"continuous": [], "continuous_imu": []}
    predictors: list[Predictor] = ["continuous"] if complete or imu is None else []
    predictors += [] if imu is None else ["continuous_imu"]

    def fitted(name: Predictor, fold: Fold) -> Trajectory | InertialTrajectory:
        setup, motion = models[fold.number]
        training = setup.applied(observations.select(fold.training))
        if name == "continuous":
            return fit_trajectory(
                training,
                prior=motion.prior,
                occluded_prior=parameters.pipeline.motion,
                noise_scale=motion.noise_scales,
            ).trajectory
        assert imu is not None  # noqa: S101 (only then it is among the predictors)
        assert parameters.imu is not None  # noqa: S101 (there are samples of it)
        return fit_inertial_trajectory(
            scale_noise(training, motion.noise_scales),
            imu,
            parameters.imu,
            reference_m=centroid_m(parameters),
        ).trajectory

    def smoothing_errors(name: Predictor, fold: Fold) -> FloatArray:
        nonlocal done
        report(0.5 + 0.5 * done / (len(splits) * len(predictors)))
        done += 1
        setup, motion = models[fold.number]
        trajectory = fitted(name, fold)
        test = setup.applied_in_place(observations.select(fold.test))
        normalised[name].append(
            normalised_prediction_errors(trajectory, scale_noise(test, motion.noise_scales))
        )
        return trajectory_errors(trajectory, test)

    result: dict[Predictor, HeldOutErrors] = {
        "linear": cross_validate(splits, lambda fold: interpolation_errors(observations, fold))
    }
    rows = np.concatenate([fold.test for fold in splits]) if splits else np.empty(0, np.intp)
    stationary = in_rest(find_rest(observations), observations.time_s[rows]) >= 0
    for name in predictors:
        result[name] = cross_validate(splits, partial(smoothing_errors, name))
        if splits:
            sigmas = np.concatenate(normalised[name])
            in_sigmas = NormalisedErrors(sigmas, rows, observations.polar[rows], stationary)
            result[name] = replace(result[name], normalised=in_sigmas)
    report(1.0)
    return result


def held_out_keys(predicted: Mapping[Predictor, HeldOutErrors]) -> dict[str, Any]:
    """Return the figures for ``--json``."""
    return {
        "held_out_mm": {
            name: {**asdict(each.statistics), "gaps": asdict(each.gaps)} for name, each in predicted.items()
        },
        "normalised": {
            name: {
                part: {component: asdict(figures) for component, figures in of_part.items()}
                for part, of_part in each.normalised_statistics().items()
            }
            for name, each in predicted.items()
            if each.normalised is not None
        },
    }


def _training_model(
    training: Observations, parameters: Parameters, refine: Refine
) -> tuple[Setup, MotionModel]:
    """Return the set-up and the hyperparameters from training measurements alone."""
    setup = Setup.of(training)
    motion = estimate_motion_model(training, parameters.pipeline)
    if not motion.tuned:
        return setup, motion
    refined = refine_recorded_setup(parameters, training, motion.prior, motion.noise_scales, refine)
    if refined is None or not refined.used:
        return setup, motion
    setup = refined.setup
    return setup, estimate_motion_model(
        setup.applied(training), parameters.pipeline, start=refined.motion_prior
    )
