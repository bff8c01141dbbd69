"""Frames from points measured in two of them: stations from targets, prisms from body points. Sans-I/O.

The points are aligned (paper section III-C, "Calibration procedure": Arun et al. 1987), by default weighted by the noise of
both. Each is predicted from all others: data snooping (Baarda 1968, three coordinates at a time) rejects outliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry.rigid import transform_from, transform_points
from tsgt.geometry.target_calibration.frame_fit import PointPairs, PointSet, fit_frame, pose_jacobian

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.target_calibration.frame_fit import PointName

FALSE_ALARM_RATE = 1e-4  # Probability of suspecting any point of a set that matches its noise model
MAX_NOISE_SCALE = 2.0
"""Factor on the noise model's sigmas beyond which points are inconsistent.

The authors' four sets of field targets show 0.5 to 1.2 times ``tsgt.model.TARGET_NOISE``.
"""

MAX_PREDICTION_SIGMA_M = 0.02
MAX_PREDICTION_SIGMA_RAD = 0.1
"""One-sigma limits on a point and a rotation predicted from the other points: beyond, the covariance of first order is too
optimistic to test the prediction.
"""

MIN_POINTS = 3


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that depend on what the frame is for."""

    weak_rad: float  # One-sigma rotation above which an axis is weak
    # Smallest prediction error that is rejected as a blunder: a wrong prism constant, common to all points, may cause
    # less
    blunder_m: float


STATION_LIMITS = Limits(weak_rad=0.5e-3, blunder_m=0.01)
"""For stations. 0.5 mrad is 10 mm at a prism 20 m off the axis, as much as the rest of the system together. Targets all around
give 0.06 to 0.11 mrad (the authors' field sets), four of them nearly collinear 3 to 5 mrad. A constant wrong by 10 mm moves
single targets of these sets by up to 11 mm.
"""

BODY_LIMITS = Limits(weak_rad=5e-3, blunder_m=0.003)
"""For the robot's body: 5 mm at a prism one metre off the axis. All points are seen from about one side, so that a wrong constant
hardly distorts them.
"""


@dataclass(frozen=True, slots=True)
class RejectedPoint:
    """A point that is inconsistent with the others."""

    name: PointName
    prediction_error_m: float  # Distance from its prediction by the points that were kept


@dataclass(frozen=True, slots=True)
class WeakAxis:
    """An axis about which the points hold the frame weakly."""

    axis: tuple[float, float, float]  # Unit vector in the target frame, pointing towards the points
    sigma_rad: float  # One sigma of the rotation about it


@dataclass(frozen=True, slots=True, eq=False)
class FrameCalibration:
    """A frame found from points."""

    T: FloatArray  # (4, 4) rigid transform from the source to the target frame, in m
    # (6, 6) covariance of (x, y, z, rotation about the target frame's fixed axes x, y, z) in m and rad, T_true =
    # [exp(dtheta) R | t + dt]; rows and columns of roll and pitch are zero for levelled instruments
    covariance: FloatArray
    used: tuple[PointName, ...]  # Names of the n points that the frame was computed from
    residuals_m: FloatArray  # (n,) distance of each used point from its transformed counterpart
    # (n,) the same when the frame is computed without that point; NaN where the others do not determine it
    leave_one_out_m: FloatArray
    rejected: tuple[RejectedPoint, ...]
    # False where the points are inconsistent and the outliers cannot be identified; nothing is rejected then, and the
    # frame must not be used
    consistent: bool
    weak: tuple[WeakAxis, ...]  # Weakly held axes, worst first
    # Angle between the z axes where the frames were taken as levelled and the points contradict that significantly
    tilt_rad: float | None

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals_m**2)))

    @property
    def max_m(self) -> float:
        """Largest residual."""
        return float(self.residuals_m.max())


@dataclass(frozen=True, slots=True, eq=False)
class PrismCalibration:
    """Prisms in the robot frame."""

    body: FrameCalibration  # The fit to the body points; ``body.T`` takes station to robot coordinates
    # Positions and covariances in the robot frame; each covariance contains the error of the body fit, which is
    # common to all
    prisms: PointSet
    joint_covariance_m2: FloatArray  # (3 n, 3 n) of all prisms in their order


def calibrate_frame(
    source: PointSet,
    target: PointSet,
    *,
    weighted: bool = True,
    levelled: bool = False,
    limits: Limits = STATION_LIMITS,
) -> FrameCalibration:
    """Find the frame ``source`` in the frame ``target`` from the points that both have.

    Raises DegenerateGeometryError: fewer than three common points, or they coincide or are collinear (levelled: above one
    another).
    Raises GeometryError: a covariance of the source is singular.

    Parameters
    ----------
    source, target : Paired by name; unpaired points are ignored. No covariance of the source may be singular.
    weighted
        Weight each residual with its inverse covariance (maximum likelihood); False is Arun's unweighted least squares.
        Outlier tests follow the noise model either way.
    levelled : Both z axes are vertical: only heading and position are solved.
    """
    common = [name for name in target.names if name in source.names]
    if len(common) < MIN_POINTS:
        listed = ", ".join(map(str, common)) or "none"
        raise DegenerateGeometryError(
            f"expected at least {MIN_POINTS} points known in both frames, got {len(common)} ({listed}); "
            "measure more of them"
        )
    pairs = PointPairs(source.select(common), target.select(common), levelled)
    if np.linalg.eigvalsh(pairs.source.covariances_m2).min() <= 0:
        raise GeometryError(
            "expected noise in every direction of every source point, got a singular covariance"
        )
    fit_frame(pairs, weighted=True)  # raises for a degenerate set
    outliers = _outliers(pairs, limits.blunder_m)
    return frame_without(
        pairs, outliers or (), weighted=weighted, limits=limits, consistent=outliers is not None
    )


def frame_without(
    pairs: PointPairs,
    outliers: Sequence[PointName],
    *,
    weighted: bool,
    limits: Limits,
    consistent: bool = True,
) -> FrameCalibration:
    """Fit a frame to all but the outliers, whatever the residuals are."""
    kept = pairs.without(*outliers)
    fit = fit_frame(kept, weighted=weighted)
    predictions = [_Prediction.of(kept, name, weighted=weighted) for name in kept.names]
    return FrameCalibration(
        T=transform_from(fit.rotation, fit.translation_m),
        covariance=fit.covariance,
        used=kept.names,
        residuals_m=np.linalg.norm(fit.residuals_m(kept), axis=1),
        leave_one_out_m=np.array([np.nan if p is None else p.length_m for p in predictions]),
        rejected=tuple(
            RejectedPoint(name, float(np.linalg.norm(fit.residuals_m(pairs.only(name))))) for name in outliers
        ),
        consistent=consistent,
        weak=weak_axes(fit.covariance, kept.target.points_m, limits.weak_rad),
        tilt_rad=_tilt_rad(kept) if pairs.levelled else None,
    )


def calibrate_prisms(body: PointSet, body_cad: PointSet, prisms: PointSet) -> PrismCalibration:
    """Find the prisms in the robot frame from one station's measurements of them and of body points, in its frame.

    ``body_cad`` has the body points in the robot frame, from CAD, with the build tolerance as covariance. Raises
    DegenerateGeometryError: fewer than three body points, or they coincide or are collinear.
    """
    frame = calibrate_frame(body, body_cad, limits=BODY_LIMITS)
    rotation = frame.T[:3, :3]
    jacobian = pose_jacobian(prisms.points_m @ rotation.T)
    covariances = (
        rotation @ prisms.covariances_m2 @ rotation.T
        + jacobian @ frame.covariance @ jacobian.transpose(0, 2, 1)
    )
    stacked = jacobian.reshape(-1, 6)
    joint = stacked @ frame.covariance @ stacked.T
    for each, noise in enumerate(rotation @ prisms.covariances_m2 @ rotation.T):
        joint[3 * each : 3 * each + 3, 3 * each : 3 * each + 3] += noise
    return PrismCalibration(
        body=frame,
        prisms=PointSet(prisms.names, transform_points(frame.T, prisms.points_m), covariances),
        joint_covariance_m2=(joint + joint.T) / 2,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Prediction:
    """Prediction of one point by the others."""

    error_m: FloatArray  # (3,)
    covariance_m2: FloatArray  # (3, 3) of the error: prediction plus measurement
    variance_ratio: float  # variance ratio of the others' residuals to their noise

    @classmethod
    def of(cls, pairs: PointPairs, name: PointName, *, weighted: bool) -> _Prediction | None:
        """Predict a point from the others; None where they do not determine it well enough."""
        others, point = pairs.without(name), pairs.only(name)
        try:
            fit = fit_frame(others, weighted=weighted)
        except DegenerateGeometryError:
            return None
        jacobian = pose_jacobian(point.source.points_m @ fit.rotation.T)[0]
        prediction_covariance = jacobian @ fit.covariance @ jacobian.T
        if (
            np.linalg.eigvalsh(fit.covariance[3:, 3:]).max() > MAX_PREDICTION_SIGMA_RAD**2
            or np.linalg.eigvalsh(prediction_covariance).max() > MAX_PREDICTION_SIGMA_M**2
        ):
            return None
        return cls(
            error_m=fit.residuals_m(point)[0],
            covariance_m2=fit.residual_covariances_m2(point)[0] + prediction_covariance,
            variance_ratio=fit.chi_squared(others) / others.redundancy,
        )

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(self.error_m))

    @property
    def normalised_squared_error(self) -> float:
        """Squared error over its covariance."""
        squared = float(self.error_m @ np.linalg.solve(self.covariance_m2, self.error_m))
        return squared / _noise_scale(self.variance_ratio)


def _noise_scale(variance_ratio: float) -> float:
    """Factor on the noise model's variances from the variance ratio of the residuals: 1 to ``MAX_NOISE_SCALE`` squared."""
    return min(max(variance_ratio, 1.0), MAX_NOISE_SCALE**2)


def _worst_outlier(pairs: PointPairs, blunder_m: float) -> PointName | None:
    """Name the point with the largest significant prediction error (chi squared, Bonferroni)."""
    scores = {}
    for name in pairs.names:
        prediction = _Prediction.of(pairs, name, weighted=True)
        if prediction is not None and prediction.length_m >= blunder_m:
            scores[name] = prediction.normalised_squared_error
    worst = max(scores, key=lambda name: scores[name], default=None)
    if worst is None or scores[worst] <= chdtri(3, FALSE_ALARM_RATE / len(pairs.names)):
        return None
    return worst


def _outliers(pairs: PointPairs, blunder_m: float) -> tuple[PointName, ...] | None:
    """Outliers, found one at a time; None if ambiguous, near half of all, under four remain, or the rest is inconsistent."""
    outliers: list[PointName] = []
    kept = pairs
    max_outliers = (len(pairs.names) - MIN_POINTS) // 2
    while (suspect := _worst_outlier(kept, blunder_m)) is not None:
        others = [name for name in kept.names if name != suspect]
        if len(outliers) == max_outliers or any(
            _worst_outlier(kept.without(name), blunder_m) is None for name in others
        ):
            return None
        outliers.append(suspect)
        kept = kept.without(suspect)
    chi_squared = fit_frame(kept, weighted=True).chi_squared(kept)
    return (
        tuple(outliers)
        if chi_squared <= MAX_NOISE_SCALE**2 * chdtri(kept.redundancy, FALSE_ALARM_RATE)
        else None
    )


def weak_axes(covariance: FloatArray, points_m: FloatArray, limit_rad: float) -> tuple[WeakAxis, ...]:
    """Principal axes of the rotation's covariance whose sigma exceeds the limit, worst first."""
    variances, axes = np.linalg.eigh(covariance[3:, 3:])
    weak = []
    for variance, axis in zip(variances[::-1], axes.T[::-1], strict=True):
        if variance > limit_rad**2:
            x, y, z = (axis if axis @ points_m.mean(axis=0) >= 0 else -axis).tolist()
            weak.append(WeakAxis((x, y, z), float(np.sqrt(variance))))
    return tuple(weak)


def _tilt_rad(pairs: PointPairs) -> float | None:
    """Angle between the z axes if it is significant: the chi-squared test of the two additional unknowns."""
    free = PointPairs(pairs.source, pairs.target, levelled=False)
    try:
        tilted = fit_frame(free, weighted=True)
    except DegenerateGeometryError:
        return None  # collinear points
    tilted_chi_squared = tilted.chi_squared(free)
    drop = fit_frame(pairs, weighted=True).chi_squared(pairs) - tilted_chi_squared
    if drop <= chdtri(2, FALSE_ALARM_RATE) * _noise_scale(tilted_chi_squared / free.redundancy):
        return None
    return float(np.arccos(np.clip(tilted.rotation[2, 2], -1.0, 1.0)))
