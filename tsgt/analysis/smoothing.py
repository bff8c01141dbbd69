"""Estimator ``continuous`` over a whole recording: one smooth trajectory through all measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.analysis.imu_setup import RecordedSetup, recorded_imu_setup
from tsgt.analysis.inertial_smoothing import fit_with_imu, shock_times_s
from tsgt.analysis.pose_series import PoseSeries
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
    Degradation,
    PoseBatch,
    build_observations,
    inertial_samples,
    noise_scales,
    setup_jacobian,
    with_setup,
)
from tsgt.geometry import check_layout
from tsgt.geometry.batch import (
    NOISE_FLOOR_SHARE,
    TrajectoryInPieces,
    overall_scale,
    tune,
    with_noise_floor,
)
from tsgt.geometry.rest import find_rest
from tsgt.model import MIN_PRISMS

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


HAS_MOVED = (
    "in a part of the drive its set-up is right, so that the IMU, a tripod or a prism may have moved: all poses are degraded; check the "
    "stations (tsgt calibrate check)"
)


@dataclass(frozen=True, slots=True)
class MotionModel:
    """Process noise and factors on the stated sigmas: ``tuned`` to the measurements; if too few, those of the recording."""

    prior: MotionPrior
    noise_scales: FloatArray  # (S + 1, 3) by station, Cartesian points last, and component
    noise_scale: float  # Their root mean square over all measurements and components
    tuned: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothedPoses:
    """Poses at the epochs from the first to the last usable measurement, and what they were computed with.

    ``sources``: measurement of each of the observations.
    """

    poses: PoseBatch
    observations: Observations  # With the stated noise
    sources: list[Measurement]
    motion: MotionModel
    parameters: Parameters  # of the recording, with the set-up that was used
    refinement: RefinedSetup | None  # None: switched off or not possible
    rest: tuple[RestInterval, ...]  # Intervals in which the robot stood still; with an IMU they are not used
    imu: ImuUse | None = None  # None: without an IMU
    imu_problem: str = ""  # Why the IMU of the recording was not used, if it was not

    @property
    def rest_s(self) -> float:
        """Total duration of rest."""
        return sum(each.end_s - each.start_s for each in self.rest)


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothedRecording(SmoothedPoses):
    """The same with the trajectory, which takes most of the memory. ``origin_ns``: Unix time at which its time is zero."""

    fit: TrajectoryFit | InertialFit
    origin_ns: int

    def observations_with(self, parameters: Parameters) -> Observations:
        """Return the observations with a set-up that may differ from the one that was used."""
        if parameters is self.parameters:
            return self.observations
        return build_observations(parameters, self.sources, origin_ns=self.origin_ns)[0]


def smooth_poses(
    recording: Recording,
    *,
    path: Path,
    refine: Refine = "auto",
    on_progress: Callable[[float], None] | None = None,
) -> SmoothedPoses:
    """Return the poses of :func:`smooth_recording`, in less memory: no piece of the trajectory outlives its poses."""
    return _smoothed(recording, path=path, refine=refine, on_progress=on_progress, whole=False)[0]


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
    found, series, fit = _smoothed(recording, path=path, refine=refine, on_progress=on_progress, whole=True)
    assert fit is not None  # noqa: S101 (the whole of it was asked for)
    fields = {name: getattr(found, name) for name in SmoothedPoses.__slots__}
    return SmoothedRecording(**fields, fit=fit, origin_ns=series.origin_ns)


@dataclass(frozen=True, slots=True)
class _Prepared:
    """What a trajectory is fitted to: measurements, set-up and motion model."""

    recording: Recording
    path: Path
    measurements: Sequence[Measurement]
    complete: bool  # All prisms of a robot with three were measured, so that no IMU is needed
    origin_ns: int
    parameters: Parameters  # With the set-up that is used
    observations: Observations
    sources: list[Measurement]
    motion: MotionModel
    refined: RefinedSetup | None


def _smoothed(
    recording: Recording,
    *,
    path: Path,
    refine: Refine,
    on_progress: Callable[[float], None] | None,
    whole: bool,
) -> tuple[SmoothedPoses, PoseSeries, TrajectoryFit | InertialFit | None]:
    """Return the poses, and the trajectory if the ``whole`` of it is to be kept, or an IMU was used."""
    prepared = _prepared(recording, path, refine)
    parameters, observations = prepared.parameters, prepared.observations
    imu, imu_problem, has_moved = _fit_imu(prepared, on_progress)
    series = PoseSeries(parameters, prepared.measurements, prepared.sources, prepared.origin_ns)
    fit: TrajectoryFit | InertialFit | None = None if imu is None else imu.fit
    motion, without = prepared.motion, None
    rest = tuple(find_rest(observations)) if prepared.complete and imu is not None else ()
    if imu is None or (prepared.complete and imu.unused):
        try:
            in_pieces = TrajectoryInPieces(
                observations,
                prior=motion.prior,
                occluded_prior=parameters.pipeline.motion,
                noise_scale=motion.noise_scales,
                setup_jacobian=setup_jacobian(parameters),
            )
            without, pieces = series.of_pieces(in_pieces, on_progress, keep=whole and imu is None)
            rest = in_pieces.rest
            if pieces:
                fit = in_pieces.joined(pieces)
        except GeometryError as error:
            if imu is None:
                raise RecordingError(str(error), path=path) from error
    if imu is not None:
        motion = replace(motion, noise_scales=imu.noise_scales, noise_scale=imu.noise_scale)
        poses = series.with_imu(imu, without)
    else:
        assert without is not None  # noqa: S101 (else an error was raised)
        poses = without
        if has_moved:
            poses.degraded[poses.valid] |= Degradation.IMU_DISAGREES
    if not poses.valid.any():
        raise RecordingError(no_valid_pose_message(poses, parameters), path=path)
    found = SmoothedPoses(
        poses=poses,
        observations=observations,
        sources=prepared.sources,
        motion=motion,
        parameters=parameters,
        refinement=prepared.refined,
        rest=rest,
        imu=imu,
        imu_problem=imu_problem,
    )
    return found, series, fit


def _prepared(recording: Recording, path: Path, refine: Refine) -> _Prepared:
    """Check the measurements, estimate the motion model, and refine the set-up where they contradict it."""
    parameters = recording.parameters
    measurements = plausible_measurements(recording)
    complete = len(measured_prisms(parameters, measurements)) == len(parameters.prisms) >= MIN_PRISMS
    without_imu = complete or not _has_imu(recording)
    names = [prism.prism for prism in parameters.prisms]
    check_layout([prism.position_m for prism in parameters.prisms], names=names, imu=not without_imu)
    check_measured = check_prisms_measured if without_imu else check_any_measured
    check_measured(recording, measurements, path)
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
    return _Prepared(
        recording,
        path,
        measurements,
        complete,
        origin_ns,
        parameters,
        observations,
        sources,
        motion,
        refined,
    )


def _has_imu(recording: Recording) -> bool:
    return recording.parameters.imu is not None and bool(recording.imu_samples)


class _FittedImu(NamedTuple):
    """The trajectory with the IMU, or why there is none although the recording has one."""

    used: ImuUse | None
    problem: str = ""
    has_moved: bool = False  # Its set-up was right in a part of the drive: it, a tripod or a prism has moved


def _fit_imu(prepared: _Prepared, on_progress: Callable[[float], None] | None) -> _FittedImu:
    """Return the trajectory with the IMU. Raises RecordingError where there is none, nor poses without it."""
    recording, parameters, path = prepared.recording, prepared.parameters, prepared.path
    if parameters.imu is None:
        return _FittedImu(None)
    if not recording.imu_samples:
        return _FittedImu(
            None, "the recording has no IMU samples; give --imu, a file of tsgt import imu, or --no-imu"
        )
    setup = RecordedSetup()
    if prepared.complete or len(parameters.prisms) < MIN_PRISMS:
        setup = recorded_imu_setup(parameters, prepared.measurements, recording.imu_samples)
        if setup.wrong and not prepared.complete:
            raise RecordingError(
                f"{setup.wrong}; without three stations there are no poses without it: correct its set-up (--imu-setup)",
                path=path,
            )
        if setup.wrong:
            return _left_out(setup.wrong, recording, parameters, has_moved=setup.has_moved)
    try:
        imu = fit_with_imu(
            parameters,
            prepared.observations,
            recording.imu_samples,
            odometry=recording.odometry,
            origin_ns=prepared.origin_ns,
            noise_scales=prepared.motion.noise_scales,
            tuned=prepared.motion.tuned,
            on_progress=on_progress,
        )
    except GeometryError as error:
        if not prepared.complete:
            raise RecordingError(f"{error}; --no-imu leaves the IMU out", path=path) from error
        return _left_out(str(error), recording, parameters, has_moved=setup.confirmed)
    return _FittedImu(imu)


def _left_out(problem: str, recording: Recording, parameters: Parameters, *, has_moved: bool) -> _FittedImu:
    """Return why the IMU is left out, which ``has_moved``, or a tripod or prism has, unless a shock shows that it was knocked."""
    assert parameters.imu is not None  # noqa: S101 (the caller checks)
    if not has_moved or len(shock_times_s(inertial_samples(recording.imu_samples, parameters.imu, 0))):
        return _FittedImu(None, problem)
    return _FittedImu(None, f"{problem}; {HAS_MOVED}", has_moved=True)


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
