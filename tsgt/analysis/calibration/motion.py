"""Calibrate the set-up from the motion in a recording, and cross-validate the result."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import (
    HeldOutErrors,
    cross_validate,
    folds,
    interpolation_errors,
    training_rows,
    trajectory_errors,
)
from tsgt.errors import GeometryError
from tsgt.estimation import build_observations, with_setup
from tsgt.geometry.batch import fit_trajectory, tune
from tsgt.geometry.motion_calibration import MotionCalibration, Setup, calibrate_motion, frames_from_motion

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.analysis.evaluation import Fold
    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import SetupPrior
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import MotionPrior, Parameters
    from tsgt.recording import Recording


@dataclass(frozen=True, slots=True)
class HeldOutComparison:
    """Held-out errors: straight lines per prism, and a trajectory with the set-up before and after calibration.

    ``before`` is None if the recording's frames are unknown; ``after`` is calibrated without the held-out measurements.
    """

    linear: HeldOutErrors
    before: HeldOutErrors | None
    after: HeldOutErrors

    @property
    def grown(self) -> bool | None:
        """Whether the calibration made the mean error larger; None: there is nothing to compare.

        Of the measurements that are not at gaps; if most are at gaps, as at a low rate, of all.
        """
        at_gap = self.after.at_gap
        if self.before is None or not len(at_gap):
            return None
        judged = ~at_gap if at_gap.mean() < 0.5 else np.ones_like(at_gap)
        growth_m = float((self.after.error_m - self.before.error_m)[judged].mean())
        return None if math.isnan(growth_m) else growth_m > 0.0


@dataclass(frozen=True, slots=True)
class CalibratedRecording:
    """Set-up calibrated from all measurements, the recording's parameters with it, and held-out prediction if requested."""

    calibration: MotionCalibration
    parameters: Parameters
    held_out: HeldOutComparison | None


def calibrate_recording(
    recording: Recording,
    known: SetupPrior,
    *,
    frames_known: bool = True,
    held_out: bool = True,
    on_progress: Callable[[str], None] | None = None,
) -> CalibratedRecording:
    """Calibrate from all measurements, and for cross-validation (``held_out``) five more times without a fifth of them.

    ``known`` has the parameters to estimate and their priors. Without ``frames_known`` the frames are initialised from
    motion (frame 1 remains). Raises GeometryError without measurements or their noise, or if the motion does not determine the set-up.
    """
    if not recording.measurements:
        raise GeometryError("the recording has no measurements")
    noises = [asdict(station.noise) for station in recording.parameters.stations]
    if noises and not any(value for noise in noises for value in noise.values()):
        *first, last = noises[0]
        raise GeometryError(
            f"{', '.join(first)} and {last} of all stations are 0 in the recording's parameters, which gives the measurements no "
            "weights; state the noise of the data sheet there, and for further recordings in the master's configuration: [stations.noise]"
        )
    origin_ns = min(measurement.stamp_ns for measurement in recording.measurements)
    observations, _ = build_observations(recording.parameters, recording.measurements, origin_ns=origin_ns)
    report = on_progress or (lambda _: None)

    def calibrated(some: Observations, title: str) -> MotionCalibration:
        start = Setup.of(some)
        if not frames_known:
            start = replace(start, frames=frames_from_motion(some))
        return calibrate_motion(
            some, known, start=start, on_progress=lambda words: report(f"{title}: {words}")
        )

    whole = calibrated(observations, "all measurements")
    comparison = None
    if held_out:
        splits = folds(observations)
        training = {
            split.number: observations.select(training_rows(observations, split.number)) for split in splits
        }
        setups = {
            number: calibrated(some, f"without fifth {number + 1}") for number, some in training.items()
        }
        before = None
        if frames_known:
            report("held-out prediction before")
            tuned = {number: tune(some) for number, some in training.items()}
            recorded = Setup.of(observations)
            before = _cross_validated(
                observations, splits, {n: (recorded, t.prior, t.noise_scales) for n, t in tuned.items()}
            )
        report("held-out prediction after")
        comparison = HeldOutComparison(
            cross_validate(splits, lambda fold: interpolation_errors(observations, fold)),
            before,
            _cross_validated(
                observations, splits, {n: (c.setup, c.prior, c.noise_scales) for n, c in setups.items()}
            ),
        )
    return CalibratedRecording(
        whole, with_setup(recording.parameters, whole.parameters, whole.setup, whole.covariance), comparison
    )


def _cross_validated(
    observations: Observations,
    splits: list[Fold],
    models: dict[int, tuple[Setup, MotionPrior, FloatArray]],
) -> HeldOutErrors:
    def error_m(fold: Fold) -> FloatArray:
        setup, prior, noise_scales = models[fold.number]
        training = setup.applied(observations.select(fold.training))
        trajectory = fit_trajectory(training, prior=prior, noise_scale=noise_scales).trajectory
        return trajectory_errors(trajectory, setup.applied_in_place(observations.select(fold.test)))

    return cross_validate(splits, error_m)
