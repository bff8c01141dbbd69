"""Estimator ``continuous`` over a whole recording: one smooth trajectory through all measurements."""

from __future__ import annotations

import itertools
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
    TrajectoryInPieces,
    overall_scale,
    tune,
    with_noise_floor,
)
from tsgt.geometry.rest import find_rest
from tsgt.geometry.trajectory import POSE_DIM
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.inertial_smoothing import ImuUse
    from tsgt.analysis.refinement import Refine
    from tsgt.geometry import FloatArray
    from tsgt.geometry.batch import TrajectoryFit, TrajectoryPiece
    from tsgt.geometry.inertial import InertialFit
    from tsgt.geometry.motion_calibration import RefinedSetup
    from tsgt.geometry.rest import RestInterval
    from tsgt.geometry.trajectory import Observations, Trajectory
    from tsgt.model import Measurement, MotionPrior, Parameters, PipelineParameters
    from tsgt.recording import Recording

# Bounds the memory of intermediate results, which should fit into the CPU cache.
_EPOCHS_PER_CHUNK = 1024

TWO_PRISMS = 2  # Measured for a minute they tell what a single prism does not: the rotation of the IMU, but about their line


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


def _smoothed(
    recording: Recording,
    *,
    path: Path,
    refine: Refine,
    on_progress: Callable[[float], None] | None,
    whole: bool,
) -> tuple[SmoothedPoses, _PoseSeries, TrajectoryFit | InertialFit | None]:
    """Return the poses, and the trajectory if the ``whole`` of it is to be kept, or an IMU was used."""
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
        problem = "the recording has no IMU samples; give --imu, a file of tsgt import imu, or --no-imu"
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
    series = _PoseSeries(parameters, measurements, sources, origin_ns)
    fit: TrajectoryFit | InertialFit | None = None if imu is None else imu.fit
    without, rest = None, tuple(find_rest(observations)) if complete and imu is not None else ()
    if imu is None or (complete and imu.unused):
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
    if not poses.valid.any():
        raise RecordingError(no_valid_pose_message(poses, parameters), path=path)
    found = SmoothedPoses(
        poses=poses,
        observations=observations,
        sources=sources,
        motion=motion,
        parameters=parameters,
        refinement=refined,
        rest=rest,
        imu=imu,
        imu_problem=problem,
    )
    return found, series, fit


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
        self.origin_ns = origin_ns
        stations = {station.station: station for station in parameters.stations}
        columns = {prism.prism: column for column, prism in enumerate(parameters.prisms)}
        self._parameters, self._output = parameters, ContinuousPoseOutput(parameters)
        self._times_ns = np.array([measured_at_ns(m, stations[m.station]) for m in sources], dtype=np.int64)
        self._stations = np.array([m.station for m in sources], dtype=np.int64)
        self._prisms = np.array([columns[m.prism] for m in sources], dtype=np.intp)
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
        period_ns = parameters.pipeline.period_ns
        first, last = -(-int(self._times_ns[0]) // period_ns), int(self._times_ns[-1]) // period_ns
        self._epochs_ns = np.arange(first, last + 1, dtype=np.int64) * period_ns

    def with_imu(self, imu: ImuUse, without: PoseBatch | None) -> PoseBatch:
        """Return poses with an IMU; where it is not to be used those without it, or invalid ones."""
        seen = self._history(imu.fit.residuals_m)

        def chunk(epochs_ns: NDArray[np.int64]) -> PoseBatch:
            time_s = self._time_s(epochs_ns)
            states, covariance, common = imu.fit.trajectory.poses_at(time_s)
            converged = ~imu.unused_at(time_s)
            return self._output.smoothed(
                epochs_ns, seen, states, covariance, common=common, converged=converged
            )

        poses = PoseBatch.collected(len(self._epochs_ns), map(chunk, _chunks(self._epochs_ns)))
        if without is None:
            return poses
        unused = imu.unused_at(self._time_s(poses.stamp_ns))
        rows = np.concatenate([np.flatnonzero(~unused), len(poses) + np.flatnonzero(unused)])
        joined = PoseBatch.concatenated([poses, without]).select(rows)
        return joined.select(np.argsort(joined.stamp_ns, kind="stable"))

    def of_pieces(
        self, in_pieces: TrajectoryInPieces, on_progress: Callable[[float], None] | None, *, keep: bool
    ) -> tuple[PoseBatch, list[TrajectoryPiece]]:
        """Return the poses of a trajectory, computed piece by piece, and the pieces if they are to be kept."""
        kept: list[TrajectoryPiece] = []

        def chunks() -> Iterator[PoseBatch]:
            residuals_m, measured, done = np.full((len(self._times_ns), 3), np.nan), 0, 0
            # A pose looks at residuals before and after it, so that a piece waits for the next one.
            previous: TrajectoryPiece | None = None
            for piece in itertools.chain(in_pieces.fitted(on_progress), [None]):
                if piece is not None:
                    residuals_m[measured : measured + len(piece.residuals_m)] = piece.residuals_m
                    measured += len(piece.residuals_m)
                    if keep:
                        kept.append(piece)
                if previous is not None:
                    until_s = np.inf if piece is None else piece.trajectory.knots.time_s[0]
                    stop = int(np.searchsorted(self._time_s(self._epochs_ns), until_s))
                    yield from self._of_piece(previous.trajectory, self._epochs_ns[done:stop], residuals_m)
                    done = stop
                previous = piece

        return PoseBatch.collected(len(self._epochs_ns), chunks()), kept

    def _of_piece(
        self, trajectory: Trajectory, epochs_ns: NDArray[np.int64], residuals_m: FloatArray
    ) -> Iterator[PoseBatch]:
        seen = self._history(residuals_m)
        for some_ns in _chunks(epochs_ns):
            time_s = self._time_s(some_ns)
            states, covariance = trajectory.at(time_s, dim=POSE_DIM)
            common = trajectory.common_at(time_s, dim=POSE_DIM)
            yield self._output.smoothed(some_ns, seen, states, covariance, common=common)

    def _time_s(self, epochs_ns: NDArray[np.int64]) -> FloatArray:
        """Return the times of epochs from the trajectory's origin."""
        return np.asarray((epochs_ns - self.origin_ns) / 1e9)

    def _history(self, residuals_m: FloatArray) -> MeasurementHistory:
        return MeasurementHistory(
            times_ns=self._times_ns,
            stations=self._stations,
            prisms=self._prisms,
            residuals_m=np.linalg.norm(residuals_m, axis=1),
            unusable_ns=self._unusable_ns,
        )


def _chunks(epochs_ns: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for start in range(0, max(len(epochs_ns), 1), _EPOCHS_PER_CHUNK):
        yield epochs_ns[start : start + _EPOCHS_PER_CHUNK]
