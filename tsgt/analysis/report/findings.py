"""Content of a report, computed once; what cannot be computed has a reason in ``problems``."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tsgt.analysis.design import Perturbation, equivalent_noise, perturbed
from tsgt.analysis.diagnosis import diagnose_smoothed
from tsgt.analysis.evaluation import (
    compare,
    compare_aligned,
    compare_live,
    distances_at_epochs,
    error_details,
    held_out_errors,
    inter_prism,
    normalised_residuals,
    outliers,
    pose_errors,
    residual_statistics,
    stationary_errors,
)
from tsgt.analysis.processing import process, with_estimator
from tsgt.analysis.report.log import Log, read_log
from tsgt.analysis.report.motion import distance_error_series
from tsgt.analysis.report.stations import station_records, station_statistics
from tsgt.analysis.smoothing import smooth_recording
from tsgt.analysis.validation import no_measurements_message, plausible_measurements
from tsgt.errors import GeometryError, RecordingError
from tsgt.estimation import build_tracks, centroid_at_point, point_label
from tsgt.geometry import check_layout, rotation_from_quaternion, transform_from

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.diagnosis import Diagnosis
    from tsgt.analysis.evaluation import (
        Align,
        AlignedErrorStatistics,
        HeldOutErrors,
        InterPrismDistances,
        LiveComparison,
        Outlier,
        PoseErrorDetails,
        PoseErrorStatistics,
        Predictor,
        Reference,
        ResidualStatistics,
        StationaryStatistics,
    )
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.refinement import Refine
    from tsgt.analysis.report.motion import DistanceErrorSeries
    from tsgt.analysis.report.stations import StationRecord, StationStatistics
    from tsgt.analysis.smoothing import SmoothedRecording
    from tsgt.estimation import PoseBatch, Track
    from tsgt.geometry import FloatArray
    from tsgt.recording import Recording

T = TypeVar("T")

_NOISE_LEVELS = tuple(0.1 * level for level in range(21))  # Of the measured noise
_SAMPLES = 1000
_EQUIVALENT_SAMPLES = 20_000


@dataclass(frozen=True, slots=True)
class Difference:
    """Poses of the two estimators compared at N epochs."""

    stamp_ns: np.ndarray[Any, np.dtype[np.int64]]  # (N,)
    position_m: FloatArray  # (N,) distance between the reference points
    centroid_m: FloatArray  # (N,) distance between the prisms' centroids
    rotation_rad: FloatArray  # (N,) angle between the rotations


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Effect of prism noise on a pose, for the layout of the recording.

    ``as_measured`` is for the noise that explains the mean inter-prism error, ``study`` from none to twice that noise.
    """

    study: list[Perturbation]
    as_measured: Perturbation


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Content of a report; None and empty where something could not be computed.

    Attributes
    ----------
    start_ns, end_ns : First and last measurement.
    log : Radio, clocks, events.
    inter_prism, distance_errors : Distances between the measured prisms; None if fewer than two were measured.
    odometry_stationary_ns : Stationary intervals of the odometry, within the recording or not; None without odometry.
    difference : Between the estimators.
    held_out : Prediction errors, if requested.
    residuals, outliers, normalised : Of the continuous trajectory.
    reference_errors, error_details, aligned_errors, stationary_errors
        Against the reference by estimator: unaligned, by component and over distances, after an alignment, and mean poses of
        stationary intervals; positions at the reference point, most also at the prisms' centroid.
    diagnosis : Causes of errors.
    live : Errors of the poses as streamed; None without any.
    problems : Reasons for missing content, as sentences, by its name.
    """

    recording: Recording
    path: Path
    start_ns: int
    end_ns: int
    log: Log
    station_records: list[StationRecord]
    station_statistics: dict[int, StationStatistics]
    inter_prism: InterPrismDistances | None
    distance_errors: DistanceErrorSeries | None
    odometry_stationary_ns: tuple[tuple[int, int], ...] | None = None
    continuous: SmoothedRecording | None
    linear: PoseBatch | None = None
    difference: Difference | None = None
    held_out: dict[Predictor, HeldOutErrors] | None = None
    residuals: dict[int, dict[str, ResidualStatistics]]
    outliers: list[Outlier]
    normalised: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    reference_errors: dict[Estimator, PoseErrorStatistics]
    error_details: dict[Estimator, PoseErrorDetails] = field(default_factory=dict)
    aligned_errors: dict[Estimator, AlignedErrorStatistics] = field(default_factory=dict)
    stationary_errors: dict[Estimator, StationaryStatistics] = field(default_factory=dict)
    reference: Reference | None = None
    pose_noise: PoseNoise | None = None
    diagnosis: Diagnosis | None = None
    live: LiveComparison | None = None
    problems: dict[str, str] = field(default_factory=dict)

    @property
    def poses(self) -> PoseBatch | None:
        """The poses that the report shows: of the recording's estimator, otherwise of the other one."""
        both = self.poses_by_estimator
        return both.get(self.recording.parameters.pipeline.estimator) or next(iter(both.values()), None)

    @property
    def poses_by_estimator(self) -> dict[Estimator, PoseBatch]:
        """The poses of each estimator that has any."""
        continuous = None if self.continuous is None else self.continuous.poses
        found: dict[Estimator, PoseBatch | None] = {"linear": self.linear, "continuous": continuous}
        return {name: poses for name, poses in found.items() if poses is not None}

    @property
    def point(self) -> str:
        """The point whose poses are shown, in words."""
        return point_label(self.recording.parameters.reference_point)

    @property
    def duration_s(self) -> float:
        """From the first measurement to the last."""
        return (self.end_ns - self.start_ns) / 1e9


def collect_findings(
    recording: Recording,
    path: Path,
    *,
    reference: Reference | None,
    with_held_out: bool,
    refine: Refine = "auto",
    align: Align | None = None,
    stationary_ns: Sequence[tuple[int, int]] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Findings:
    """Compute the content of a report.

    ``reference``: trajectory to compare poses with, unaligned and after ``align``; ``with_held_out``: cross-validate both
    estimators; ``refine``: what of the set-up may be refined; ``stationary_ns``: from another source than the measurements; ``on_progress`` gets the fraction, 0 to 1.
    Raises RecordingError if there is no measurement at all, or the file cannot be read.
    """
    report = on_progress or (lambda _: None)
    parameters = recording.parameters
    measurements = plausible_measurements(recording)
    if not measurements:
        raise RecordingError(
            f"{no_measurements_message(recording)}, so there is nothing to report", path=path
        )
    problems: dict[str, str] = {}
    start_ns, end_ns = min(m.stamp_ns for m in measurements), max(m.stamp_ns for m in measurements)
    records = station_records(measurements, [s.station for s in parameters.stations])
    limit_ns = parameters.pipeline.outage_limit_ns
    fitted = 0.5 if with_held_out else 0.8
    attempt = _Attempts(path, problems)
    continuous = attempt(
        "continuous",
        lambda: smooth_recording(
            recording, path=path, refine=refine, on_progress=lambda share: report(fitted * share)
        ),
    )
    report(fitted)
    linear = attempt("linear", lambda: process(with_estimator(recording, "linear"), path=path))
    tracks = build_tracks(parameters, measurements)
    problems |= distances_problem(tracks)
    epochs = None if "inter_prism" in problems else distances_at_epochs(parameters, tracks)
    distances = None if epochs is None else inter_prism(parameters, tracks, stationary_ns, epochs)
    held_out = None
    if with_held_out and continuous is not None:
        report(fitted + 0.1)
        observations = continuous.observations_with(parameters)
        held_out = attempt(
            "held_out",
            lambda: held_out_errors(
                observations,
                parameters,
                refine=refine,
                imu=None if continuous.imu is None else continuous.imu.samples,
                on_progress=lambda s: report(fitted + 0.1 + 0.3 * s),
            ),
        )
    report(0.9)
    centroid_m = centroid_at_point(parameters)
    smoothed = None if continuous is None else continuous.poses
    both: dict[Estimator, PoseBatch | None] = {"linear": linear, "continuous": smoothed}
    poses_of = {name: poses for name, poses in both.items() if poses is not None}
    intervals_ns = () if distances is None else distances.stationary_ns
    against = _compare_with_reference(poses_of, reference, centroid_m, intervals_ns, align, attempt)
    return Findings(
        recording=recording,
        path=path,
        start_ns=start_ns,
        end_ns=end_ns,
        log=read_log(path),
        station_records=records,
        station_statistics={
            each.station: station_statistics(each, start_ns=start_ns, end_ns=end_ns, outage_limit_ns=limit_ns)
            for each in records
        },
        inter_prism=distances,
        distance_errors=None
        if epochs is None
        else distance_error_series(parameters, epochs, linear if smoothed is None else smoothed),
        odometry_stationary_ns=None if stationary_ns is None else tuple(stationary_ns),
        continuous=continuous,
        linear=linear,
        difference=None if smoothed is None or linear is None else difference(linear, smoothed, centroid_m),
        held_out=held_out,
        residuals={} if continuous is None else residual_statistics(continuous.fit, continuous.sources),
        outliers=[] if continuous is None else outliers(continuous.fit, continuous.sources),
        normalised=np.empty((0, 3)) if continuous is None else normalised_residuals(continuous.fit),
        reference_errors=against.errors,
        error_details=against.details,
        live=None
        if not poses_of
        # Lines that cannot be read were an error, or skipped, when the recording was loaded.
        else compare_live(
            recording,
            path,
            poses_of.get("continuous", next(iter(poses_of.values()))),
            reference,
            keep_going=True,
        ),
        aligned_errors=against.aligned,
        stationary_errors=against.stationary,
        reference=reference,
        pose_noise=attempt("pose_noise", lambda: _pose_noise(recording, distances)),
        diagnosis=None
        if continuous is None
        else attempt(
            "diagnosis",
            lambda: diagnose_smoothed(parameters, continuous, held_out=held_out, distances=distances),
        ),
        problems=problems,
    )


def distances_problem(tracks: Mapping[int, Track]) -> dict[str, str]:
    """Return why there are no inter-prism distances, as an entry of ``Findings.problems``; empty if there may be."""
    if len(tracks) == 1:
        return {"inter_prism": "the robot has a single prism"}
    unmeasured = [f"prism {prism}" for prism, track in tracks.items() if not len(track)]
    if len(tracks) - len(unmeasured) > 1:
        return {}
    return {"inter_prism": f"no usable measurement of {' and '.join(unmeasured)}"}


@dataclass(frozen=True, slots=True)
class _Attempts:
    """Computes what may be impossible, and notes why it is."""

    path: Path
    problems: dict[str, str]

    def __call__(self, name: str, compute: Callable[[], T]) -> T | None:
        try:
            return compute()
        except (RecordingError, GeometryError) as error:
            # Of both estimators, that of the first.
            self.problems.setdefault(name, str(error).removeprefix(f"{self.path}: "))
            return None


@dataclass(frozen=True, slots=True)
class _AgainstReference:
    """Errors of each estimator against the reference."""

    errors: dict[Estimator, PoseErrorStatistics] = field(default_factory=dict)
    details: dict[Estimator, PoseErrorDetails] = field(default_factory=dict)
    aligned: dict[Estimator, AlignedErrorStatistics] = field(default_factory=dict)
    stationary: dict[Estimator, StationaryStatistics] = field(default_factory=dict)


def _compare_with_reference(
    poses_of: dict[Estimator, PoseBatch],
    reference: Reference | None,
    centroid_m: FloatArray,
    stationary_ns: Sequence[tuple[int, int]],
    align: Align | None,
    attempt: _Attempts,
) -> _AgainstReference:
    """Compare the poses of each estimator with the reference, if there is one."""
    found = _AgainstReference()
    if reference is None:
        return found
    for name, poses in poses_of.items():
        found.errors[name] = compare(poses, reference, centroid_m)
        found.details[name] = error_details(poses, reference)
        found.stationary[name] = stationary_errors(poses, reference, stationary_ns, centroid_m).statistics()
        if align is not None and found.errors[name].compared:
            aligned = attempt("aligned", partial(compare_aligned, poses, reference, centroid_m, align))
            if aligned is not None:
                found.aligned[name] = aligned
    return found


def difference(a: PoseBatch, b: PoseBatch, centroid_m: FloatArray) -> Difference:
    """Compare poses at the epochs, which increase, at which both are valid; ``centroid_m``: in the frame of their point, (3,)."""
    stamps, rows_a, rows_b = np.intersect1d(
        a.stamp_ns[a.valid], b.stamp_ns[b.valid], assume_unique=True, return_indices=True
    )
    of_a, of_b = (
        transform_from(rotation_from_quaternion(p.orientation_xyzw[r]), p.position_m[r])
        for p, r in ((a, np.flatnonzero(a.valid)[rows_a]), (b, np.flatnonzero(b.valid)[rows_b]))
    )
    errors = pose_errors(of_b, of_a, centroid_m)
    return Difference(stamps, errors.position_m, errors.centroid_m, errors.rotation_rad)


def _pose_noise(recording: Recording, distances: InterPrismDistances | None) -> PoseNoise:
    prisms = recording.parameters.prisms
    layout = np.array([prism.position_m for prism in prisms])
    check_layout(layout, names=[prism.prism for prism in prisms])
    centroid_m = layout.mean(axis=0)
    # A fixed seed: the same recording gives the same report.
    random = np.random.default_rng(0)
    errors = [
        np.abs(pair.distances_m - pair.reference_m)
        for pair in (distances.dynamic if distances is not None else ())
    ]
    all_errors = np.concatenate(errors) if errors else np.empty(0)
    if not all_errors.any():
        raise GeometryError("without distances between the prisms, the noise on the prisms was not measured")
    mean_m = float(all_errors.mean())
    measured = equivalent_noise(
        layout, mean_m, samples=_EQUIVALENT_SAMPLES, point_m=centroid_m, random=random
    )
    unit_noise = random.standard_normal(
        (_SAMPLES, *layout.shape)
    )  # the same for all levels: the curves are smooth
    levels_m = [level * measured.noise_m for level in _NOISE_LEVELS]
    return PoseNoise(
        [perturbed(layout, noise_m, unit_noise, point_m=centroid_m) for noise_m in levels_m], measured
    )


def position_sigma_mm(covariance: FloatArray) -> FloatArray:
    """Return the position sigma per axis (root mean square of the three), (N,), of covariances, (N, 6, 6)."""
    return np.asarray(1e3 * np.sqrt(np.einsum("nii->n", covariance[:, :3, :3]) / 3))


def rotation_sigma_deg(covariance: FloatArray) -> FloatArray:
    """Return the rotation sigma per axis (root mean square of the three), (N,), of covariances, (N, 6, 6)."""
    return np.asarray(np.degrees(np.sqrt(np.einsum("nii->n", covariance[:, 3:, 3:]) / 3)))
