"""Estimator ``continuous`` over a whole recording: one smooth trajectory through all measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.imu_setup import wrong_imu_setup
from tsgt.analysis.inertial_smoothing import fit_with_imu
from tsgt.analysis.refinement import refine_recorded_setup
from tsgt.analysis.validation import (
    check_any_measured,
    check_prisms_measured,
    check_time_span,
    measured_prisms,
    no_valid_pose_message,
    plausible_measurements,
)
from tsgt.errors import GeometryError, RecordingError
from tsgt.estimation import (
    ContinuousPoseOutput,
    MeasurementHistory,
    PoseBatch,
    build_observations,
    measured_at_ns,
    noise_scales,
    setup_jacobian,
    usable,
    with_setup,
)
from tsgt.geometry import check_layout
from tsgt.geometry.batch import (
    NOISE_FLOOR_SHARE,
    fit_trajectory,
    overall_scale,
    tune,
    with_noise_floor,
)
from tsgt.geometry.rest import find_rest

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from tsgt.analysis.inertial_smoothing import ImuUse
    from tsgt.analysis.refinement import Refine
    from tsgt.geometry import FloatArray
    from tsgt.geometry.batch import TrajectoryFit
    from tsgt.geometry.inertial import InertialFit
    from tsgt.geometry.motion_calibration import RefinedSetup
    from tsgt.geometry.rest import RestInterval
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import Measurement, MotionPrior, Parameters, PipelineParameters
    from tsgt.recording import Recording

# Bounds the memory of intermediate results, which should fit into the CPU cache.
_EPOCHS_PER_CHUNK = 1024

_POSE_DIM = 6

MIN_PRISMS = 3  # Without an IMU

TWO_PRISMS = 2  # Measured for a minute they tell what a single prism does not: the rotation of the IMU, but about their line


@dataclass(frozen=True, slots=True)
class MotionModel:
    """Process noise and factors on the stated sigmas: ``tuned`` to the measurements; if too few, those of the recording."""

    prior: MotionPrior
    noise_scales: FloatArray  # (S + 1, 3) by station, Cartesian points last, and component
    noise_scale: float  # Their root mean square over all measurements and components
    tuned: bool


@dataclass(frozen=True, slots=True)
class SmoothedRecording:
    """Trajectory fitted to a recording, and its poses at the epochs from the first to the last usable measurement.

    ``sources``: measurement of each observation of the fit. ``origin_ns``: Unix time at which its time is zero.
    """

    poses: PoseBatch
    fit: TrajectoryFit | InertialFit
    motion: MotionModel
    sources: list[Measurement]
    origin_ns: int
    parameters: Parameters  # of the recording, with the set-up that was used
    refinement: RefinedSetup | None  # None: switched off or not possible
    rest: tuple[RestInterval, ...]  # Intervals in which the robot stood still; with an IMU they are not used
    imu: ImuUse | None = None  # None: without an IMU
    imu_problem: str = ""  # Why the IMU of the recording was not used, if it was not

    @property
    def rest_s(self) -> float:
        """Total duration of rest."""
        return sum(each.end_s - each.start_s for each in self.rest)


def smooth_recording(
    recording: Recording,
    *,
    path: Path,
    refine: Refine = "auto",
    on_progress: Callable[[float], None] | None = None,
) -> SmoothedRecording:
    """Fit a smooth trajectory to all measurements of a recording, with its set-up or, where they contradict it, a refined one.

    The hyperparameters are estimated from the measurements. Those of the recording, which the live estimator used, bound the
    process noise: at least a third of them, and all of them while prisms are occluded. Where the recording has samples of an
    IMU, and its parameters, they replace the motion prior, and measurements of one or two prisms are enough; set-up and noise
    are estimated without them. An IMU whose set-up contradicts the measurements is not used. Progress is a fraction, 0 to 1. Raises as :func:`tsgt.analysis.processing.process`, also
    RecordingError if no trajectory fits.
    """
    parameters = recording.parameters
    measurements = plausible_measurements(recording)
    with_imu = parameters.imu is not None and bool(recording.imu_samples)
    complete = len(measured_prisms(parameters, measurements)) == len(parameters.prisms) >= MIN_PRISMS
    names = [prism.prism for prism in parameters.prisms]
    alone = complete or not with_imu
    check_layout([prism.position_m for prism in parameters.prisms], names=names, imu=not alone)
    if alone:
        check_prisms_measured(parameters, measurements, path)
    else:
        check_any_measured(parameters, measurements, path)
    check_time_span(parameters, measurements, path)
    origin_ns = min(m.stamp_ns for m in measurements)
    observations, sources = build_observations(parameters, measurements, origin_ns=origin_ns)
    recorded = noise_scales(parameters)
    if complete:
        motion = estimate_motion_model(observations, parameters.pipeline, recorded=recorded)
    else:
        motion = recorded_motion_model(observations, parameters.pipeline, recorded)
    refined = None
    if motion.tuned:
        refined = refine_recorded_setup(parameters, observations, motion.prior, motion.noise_scales, refine)
    if refined is not None and refined.used:
        parameters = with_setup(parameters, refined.parameters, refined.setup, refined.covariance)
        observations, sources = build_observations(parameters, measurements, origin_ns=origin_ns)
        motion = estimate_motion_model(observations, parameters.pipeline, start=refined.motion_prior)
    imu, problem = None, ""
    if parameters.imu is not None and not recording.imu_samples:
        problem = "the recording has no samples of it"
    if with_imu and (complete or len(parameters.prisms) == TWO_PRISMS):
        problem = wrong_imu_setup(parameters, measurements, recording.imu_samples)
        if problem and not complete:
            raise RecordingError(
                f"{problem}; without three stations there are no poses without it: correct its set-up (--imu-setup)",
                path=path,
            )
    if with_imu and not problem:
        try:
            imu = fit_with_imu(
                parameters,
                observations,
                recording.imu_samples,
                odometry=recording.odometry,
                origin_ns=origin_ns,
                noise_scales=motion.noise_scales,
                tuned=motion.tuned,
                on_progress=on_progress,
            )
        except GeometryError as error:
            if not complete:
                raise RecordingError(f"{error}; --no-imu leaves the IMU out", path=path) from error
            problem = str(error)
    without: TrajectoryFit | None = None
    if imu is None or (complete and imu.unused):
        try:
            without = fit_trajectory(
                observations,
                prior=motion.prior,
                occluded_prior=parameters.pipeline.motion,
                noise_scale=motion.noise_scales,
                setup_jacobian=setup_jacobian(parameters),
                on_progress=on_progress,
            )
        except GeometryError as error:
            if imu is None:
                raise RecordingError(str(error), path=path) from error
    if imu is not None:
        motion = replace(motion, noise_scales=imu.noise_scales, noise_scale=imu.noise_scale)
    series = _PoseSeries(parameters, measurements, sources, origin_ns)
    fit: TrajectoryFit | InertialFit
    if imu is not None:
        fit, poses = imu.fit, series.with_imu(imu, without)
    else:
        assert without is not None  # noqa: S101 (else an error was raised)
        fit, poses = without, series.of(without)
    if not poses.valid.any():
        raise RecordingError(no_valid_pose_message(poses, parameters), path=path)
    rest = without.rest if without is not None else tuple(find_rest(observations)) if complete else ()
    return SmoothedRecording(poses, fit, motion, sources, origin_ns, parameters, refined, rest, imu, problem)


def estimate_motion_model(
    observations: Observations,
    pipeline: PipelineParameters,
    *,
    recorded: FloatArray | None = None,
    start: MotionPrior | None = None,
) -> MotionModel:
    """Estimate the hyperparameters, with a floor on the process noise; too few measurements: return those of ``pipeline``.

    ``recorded``: noise scales, (S + 1, 3), for that case; by default the factor of ``pipeline`` for all. ``start``: prior near the
    result, which saves time.
    """
    try:
        tuned = tune(observations, start=start)
    except GeometryError:
        return recorded_motion_model(observations, pipeline, recorded)
    return MotionModel(
        with_noise_floor(tuned.prior, pipeline.motion, NOISE_FLOOR_SHARE),
        tuned.noise_scales,
        tuned.noise_scale,
        tuned=True,
    )


def recorded_motion_model(
    observations: Observations, pipeline: PipelineParameters, recorded: FloatArray | None = None
) -> MotionModel:
    """Return the hyperparameters of a recording; arguments as for :func:`estimate_motion_model`."""
    scales = np.full((len(observations.frames), 3), pipeline.noise_scale) if recorded is None else recorded
    return MotionModel(pipeline.motion, scales, overall_scale(observations, scales), tuned=False)


class _PoseSeries:
    """Poses at the epochs from the first to the last usable measurement."""

    def __init__(
        self,
        parameters: Parameters,
        measurements: Sequence[Measurement],
        sources: Sequence[Measurement],
        origin_ns: int,
    ) -> None:
        stations = {station.station: station for station in parameters.stations}
        self._parameters, self._origin_ns = parameters, origin_ns
        self._times_ns = np.array([measured_at_ns(m, stations[m.station]) for m in sources], dtype=np.int64)
        self._stations = np.array([m.station for m in sources], dtype=np.int64)
        self._unusable_ns = [
            np.array(
                sorted(
                    measured_at_ns(m, stations[m.station])
                    for m in measurements
                    if m.prism == prism.prism and m.station in stations and not usable(m)
                ),
                dtype=np.int64,
            )
            for prism in parameters.prisms
        ]

    def with_imu(self, imu: ImuUse, without: TrajectoryFit | None) -> PoseBatch:
        """Return poses with an IMU; where it is not to be used those without it, or invalid ones."""
        poses = self.of(imu.fit, imu)
        if without is None:
            return poses
        unused = imu.unused_at((poses.stamp_ns - self._origin_ns) / 1e9)
        other = self.of(without)
        rows = np.concatenate([np.flatnonzero(~unused), len(poses) + np.flatnonzero(unused)])
        joined = PoseBatch.concatenated([poses, other]).select(rows)
        return joined.select(np.argsort(joined.stamp_ns, kind="stable"))

    def of(self, found: TrajectoryFit | InertialFit, imu: ImuUse | None = None) -> PoseBatch:
        """Return the poses of a trajectory; invalid where its IMU is not to be used."""
        seen = MeasurementHistory(
            times_ns=self._times_ns,
            stations=self._stations,
            prisms=found.observations.prism,
            residuals_m=np.linalg.norm(found.residuals_m, axis=1),
            unusable_ns=self._unusable_ns,
        )
        period_ns = self._parameters.pipeline.period_ns
        first, last = -(-int(seen.times_ns[0]) // period_ns), int(seen.times_ns[-1]) // period_ns
        epochs_ns = np.arange(first, last + 1, dtype=np.int64) * period_ns
        chunks, output = [], ContinuousPoseOutput(self._parameters)
        for start in range(0, max(len(epochs_ns), 1), _EPOCHS_PER_CHUNK):
            some_ns = epochs_ns[start : start + _EPOCHS_PER_CHUNK]
            time_s = (some_ns - self._origin_ns) / 1e9
            if imu is None:
                states, covariance = found.trajectory.at(time_s, dim=_POSE_DIM)
                common, converged = found.trajectory.common_at(time_s, dim=_POSE_DIM), None
            else:
                states, covariance, common = imu.fit.trajectory.poses_at(time_s)
                converged = ~imu.unused_at(time_s)
            chunks.append(
                output.smoothed(some_ns, seen, states, covariance, common=common, converged=converged)
            )
        return PoseBatch.concatenated(chunks)
