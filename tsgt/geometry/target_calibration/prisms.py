"""Prisms in the robot frame from body points that are known from CAD. Sans-I/O.

The points are aligned (paper section III-C, "Calibration procedure": Arun et al. 1987), weighted by the noise of both sets.
Each is predicted from all others: data snooping (Baarda 1968, three coordinates at a time) rejects outliers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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


WEAK_BODY_RAD = 5e-3
"""One-sigma rotation of the robot's body above which an axis is weak: 5 mm at a prism one metre off the axis."""

MIN_BLUNDER_M = 0.003
"""Smallest prediction error of a body point that is rejected. All points are seen from about one side, so that a wrong constant
hardly distorts them."""


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


def calibrate_body(body: PointSet, body_cad: PointSet) -> FrameCalibration:
    """Find the frame ``body`` in the frame ``body_cad`` from the points that both have.

    Raises DegenerateGeometryError: fewer than three common points, or they coincide or are collinear. Raises GeometryError:
    a covariance of ``body`` is singular.
    """
    common = [name for name in body_cad.names if name in body.names]
    if len(common) < MIN_POINTS:
        listed = ", ".join(map(str, common)) or "none"
        raise DegenerateGeometryError(
            f"expected at least {MIN_POINTS} points known in both frames, got {len(common)} ({listed}); "
            "measure more of them"
        )
    pairs = PointPairs(body.select(common), body_cad.select(common), levelled=False)
    if np.linalg.eigvalsh(pairs.source.covariances_m2).min() <= 0:
        raise GeometryError(
            "expected noise in every direction of every source point, got a singular covariance"
        )
    fit_frame(pairs, weighted=True)  # raises for a degenerate set
    outliers = _outliers(pairs)
    frame = frame_without(pairs, outliers or (), weighted=True)
    weak = weak_axes(frame.covariance, pairs.without(*(outliers or ())).target.points_m, WEAK_BODY_RAD)
    return replace(frame, consistent=outliers is not None, weak=weak)


def frame_without(pairs: PointPairs, outliers: Sequence[PointName], *, weighted: bool) -> FrameCalibration:
    """Fit a frame to all but the outliers, whatever the residuals are; the caller judges it."""
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
        consistent=True,
        weak=(),
        tilt_rad=None,
    )


def calibrate_prisms(body: PointSet, body_cad: PointSet, prisms: PointSet) -> PrismCalibration:
    """Find the prisms in the robot frame from one station's measurements of them and of body points, in its frame.

    ``body_cad`` has the body points in the robot frame, from CAD, with the build tolerance as covariance. Raises
    DegenerateGeometryError: fewer than three body points, or they coincide or are collinear.
    """
    frame = calibrate_body(body, body_cad)
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
        return squared / min(max(self.variance_ratio, 1.0), MAX_NOISE_SCALE**2)


def _worst_outlier(pairs: PointPairs) -> PointName | None:
    """Name the point with the largest significant prediction error (chi squared, Bonferroni)."""
    scores = {}
    for name in pairs.names:
        prediction = _Prediction.of(pairs, name, weighted=True)
        if prediction is not None and prediction.length_m >= MIN_BLUNDER_M:
            scores[name] = prediction.normalised_squared_error
    worst = max(scores, key=lambda name: scores[name], default=None)
    if worst is None or scores[worst] <= chdtri(3, FALSE_ALARM_RATE / len(pairs.names)):
        return None
    return worst


def _outliers(pairs: PointPairs) -> tuple[PointName, ...] | None:
    """Outliers, found one at a time; None if ambiguous, near half of all, under four remain, or the rest is inconsistent."""
    outliers: list[PointName] = []
    kept = pairs
    max_outliers = (len(pairs.names) - MIN_POINTS) // 2
    while (suspect := _worst_outlier(kept)) is not None:
        others = [name for name in kept.names if name != suspect]
        if len(outliers) == max_outliers or any(
            _worst_outlier(kept.without(name)) is None for name in others
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
