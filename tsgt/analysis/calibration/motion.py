"""A recording's set-up from the motion of its robot, and whether held-out measurements are predicted better with it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

from tsgt.analysis.evaluation import (
    HeldOutErrors,
    cross_validate,
    folds,
    interpolation_errors,
    training_rows,
    trajectory_errors,
)
from tsgt.errors import GeometryError
from tsgt.estimation import build_observations
from tsgt.geometry.calibration import MotionCalibration, Setup, calibrate_motion, frames_from_motion
from tsgt.geometry.trajectory import fit_trajectory, tune

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.analysis.evaluation import Fold
    from tsgt.geometry import FloatArray, Observations
    from tsgt.geometry.calibration import SetupPrior
    from tsgt.model import Matrix4, MotionPrior, Parameters, Vector3
    from tsgt.recording import Recording


@dataclass(frozen=True, slots=True)
class HeldOutComparison:
    """How well measurements that were left out are predicted from the rest.

    Attributes
    ----------
    linear
        By straight lines between each prism's own measurements.
    before
        By the trajectory, with the recording's set-up; None where its frames are not known.
    after
        By the trajectory, with a set-up that was found without the left-out measurements.
    """

    linear: HeldOutErrors
    before: HeldOutErrors | None
    after: HeldOutErrors


@dataclass(frozen=True, slots=True)
class CalibratedRecording:
    """What the motion in a recording tells of its set-up.

    Attributes
    ----------
    calibration
        From all measurements.
    parameters
        The recording's, with the set-up put in.
    judgement
        Whether it predicts better; None where not asked for.
    """

    calibration: MotionCalibration
    parameters: Parameters
    judgement: HeldOutComparison | None


def calibrate_recording(
    recording: Recording,
    known: SetupPrior,
    *,
    frames_known: bool = True,
    held_out: bool = True,
    on_progress: Callable[[str], None] | None = None,
) -> CalibratedRecording:
    """Calibrate from all measurements, and judge it by calibrating five times more without a fifth of them.

    Parameters
    ----------
    recording
        With polar measurements.
    known
        What to find, and what is known of it beforehand.
    frames_known
        Begin with the recording's frames; otherwise they are not looked at (but that of station 1).
    held_out
        Judge it.
    on_progress
        Called with a few words now and then.

    Raises
    ------
    GeometryError
        The motion, or what there is of it, does not allow a calibration.
    """
    if not recording.measurements:
        raise GeometryError("the recording has no measurements")
    origin_ns = min(measurement.stamp_ns for measurement in recording.measurements)
    observations, _ = build_observations(recording.parameters, recording.measurements, origin_ns=origin_ns)
    tell = on_progress or (lambda _: None)

    def calibrated(some: Observations, title: str) -> MotionCalibration:
        start = Setup.of(some)
        if not frames_known:
            start = replace(start, frames=frames_from_motion(some))
        return calibrate_motion(some, known, start=start, on_progress=lambda words: tell(f"{title}: {words}"))

    whole = calibrated(observations, "all measurements")
    judgement = None
    if held_out:
        parts = folds(observations)
        # By number of fold: these have seen nothing of what the folds of that number leave out.
        seen = {part.number: observations.select(training_rows(observations, part.number)) for part in parts}
        found = {number: calibrated(some, f"without fifth {number + 1}") for number, some in seen.items()}
        before = None
        if frames_known:
            tell("held-out prediction before")
            tuned = {number: tune(some) for number, some in seen.items()}
            own = Setup.of(observations)
            before = _predicted(
                observations, parts, {n: (own, t.prior, t.noise_scale) for n, t in tuned.items()}
            )
        tell("held-out prediction after")
        judgement = HeldOutComparison(
            cross_validate(parts, lambda fold: interpolation_errors(observations, fold)),
            before,
            _predicted(observations, parts, {n: (c.setup, c.prior, c.noise_scale) for n, c in found.items()}),
        )
    return CalibratedRecording(whole, _with_setup(recording.parameters, whole), judgement)


def _predicted(
    observations: Observations, parts: list[Fold], by: dict[int, tuple[Setup, MotionPrior, float]]
) -> HeldOutErrors:
    def error_m(fold: Fold) -> FloatArray:
        setup, prior, noise_scale = by[fold.number]
        kept = setup.applied(observations.select(fold.training))
        trajectory = fit_trajectory(kept, prior=prior, noise_scale=noise_scale).trajectory
        return trajectory_errors(trajectory, setup.applied(observations.select(fold.test)))

    return cross_validate(parts, error_m)


def _with_setup(parameters: Parameters, calibration: MotionCalibration) -> Parameters:
    setup = calibration.setup
    bent_m = setup.layout - calibration.initial.layout
    stations = tuple(
        replace(
            station,
            T_station1_station=_matrix(setup.frames[row]),
            latency_ns=station.latency_ns + round(1e9 * float(setup.latencies_s[row])),
        )
        for row, station in enumerate(parameters.stations)
    )
    prisms = tuple(
        replace(prism, position_m=cast("Vector3", tuple(map(float, prism.position_m + bent_m[row]))))
        for row, prism in enumerate(parameters.prisms)
    )
    return replace(parameters, stations=stations, prisms=prisms)


def _matrix(frame: FloatArray) -> Matrix4:
    a, b, c, d = (tuple(map(float, row)) for row in frame)
    return cast("Matrix4", (a, b, c, d))
