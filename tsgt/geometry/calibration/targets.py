"""Frames from points that were measured in two of them: stations from targets, prisms from body points.

Every point has coordinates and a 3x3 covariance in both frames. The frames follow from the alignment of the
points (paper section III-C, "Calibration procedure": Arun et al. 1987), by default refined so that each miss
counts by the noise of both measurements. Each point is also predicted from all others: that exposes a bad point
(data snooping after Baarda 1968, here with three coordinates at a time), which is named and left out. The
covariance tells whether the points fix the frame at all, and if not, about which axis it can still turn.

Nothing here knows files or instruments; the noise comes in with the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry.calibration.frame_fit import PointPairs, PointSet, fit_frame, pose_jacobian
from tsgt.geometry.rigid import transform_from, transform_points

if TYPE_CHECKING:
    from tsgt.geometry.calibration.frame_fit import PointName
    from tsgt.geometry.rigid import FloatArray

FALSE_ALARM_RATE = 1e-4
"""Probability of suspecting any point of a set that is as good as its noise model says."""

MAX_NOISE_SCALE = 2.0
"""How much larger than its model the noise may be (one sigma) before points count as contradictory.

The authors' four sets of field targets show 0.5 to 1.2 times ``tsgt.model.TARGET_NOISE``."""

MAX_PREDICTION_SIGMA_M = 0.02
MAX_PREDICTION_SIGMA_RAD = 0.1
"""Where the others hold a point or the frame to no better than this (one sigma), they are not said to predict it:
the covariance is of first order and promises too much there."""

MIN_POINTS = 3


@dataclass(frozen=True, slots=True)
class Limits:
    """What counts as bad; it depends on what the frame is for.

    Attributes
    ----------
    weak_rad
        One-sigma rotation in rad above which an axis is weak.
    blunder_m
        A point that misses its prediction by less than this in m is never rejected: so much may come from a
        wrong constant, which is common to all points and no fault of one of them.
    """

    weak_rad: float
    blunder_m: float


STATION_LIMITS = Limits(weak_rad=0.5e-3, blunder_m=0.01)
"""For stations. 0.5 mrad is 10 mm at a prism 20 m off the axis, as much as all the rest of the system together.
Targets all around give 0.06 to 0.11 mrad (the authors' field sets), four of them nearly in a line 3 to 5 mrad.
A constant wrong by 10 mm moves single targets of these sets by up to 11 mm."""

BODY_LIMITS = Limits(weak_rad=5e-3, blunder_m=0.003)
"""For the robot's body: 5 mm at a prism one metre off the axis; all points are seen from about one side, so that
a wrong constant hardly bends them."""


@dataclass(frozen=True, slots=True)
class RejectedPoint:
    """A point that the others contradict.

    Attributes
    ----------
    name
        Its target number or name.
    miss_m
        How far it lies from where the points that were kept predict it, in m.
    """

    name: PointName
    prediction_error_m: float


@dataclass(frozen=True, slots=True)
class WeakAxis:
    """An axis about which the points hardly hold the frame.

    Attributes
    ----------
    axis
        Unit vector in the target frame; of the two senses the one that points towards the points.
    sigma_rad
        One sigma of the rotation about it in rad, from the noise of the points.
    """

    axis: tuple[float, float, float]
    sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameCalibration:
    """A frame found from points: ``T`` takes coordinates in the source frame to the target frame.

    Attributes
    ----------
    T
        (4, 4) rigid transform from the source to the target frame, in m.
    covariance
        (6, 6) covariance of (x, y, z, rotation about the target frame's fixed axes x, y, z) in m and rad,
        T_true = [exp(dtheta) R | t + dt], from the noise of the points; rows and columns of roll and pitch
        are zero for levelled instruments.
    used
        Names of the n points that the frame was computed from.
    residuals_m
        (n,) distance in m of each used point from its transformed counterpart.
    leave_one_out_m
        (n,) the same in m when the frame is computed without that point; NaN where the others do not
        determine it.
    rejected
        Points left out because the others contradict them.
    consistent
        False where the points contradict each other and it cannot be told which one is bad; nothing is
        rejected then, and the frame must not be used.
    weak
        Axes about which the frame is poorly held, worst first; empty for a good set of points.
    tilt_rad
        Angle between the z axes in rad where the frames were taken as levelled and the points say beyond their
        noise that they are not; None otherwise.
    """

    T: FloatArray
    covariance: FloatArray
    used: tuple[PointName, ...]
    residuals_m: FloatArray
    leave_one_out_m: FloatArray
    rejected: tuple[RejectedPoint, ...]
    consistent: bool
    weak: tuple[WeakAxis, ...]
    tilt_rad: float | None

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals (vector lengths) in m."""
        return float(np.sqrt(np.mean(self.residuals_m**2)))

    @property
    def max_m(self) -> float:
        """Largest residual in m."""
        return float(self.residuals_m.max())


@dataclass(frozen=True, slots=True, eq=False)
class PrismCalibration:
    """Prisms in the robot frame.

    Attributes
    ----------
    body
        The robot frame as found from the body points; ``body.T`` takes station to robot coordinates.
    prisms
        Prism positions and covariances in the robot frame. The errors of the body fit are common to all
        prisms; each covariance contains them.
    """

    body: FrameCalibration
    prisms: PointSet


def calibrate_frame(
    source: PointSet,
    target: PointSet,
    *,
    weighted: bool = True,
    levelled: bool = False,
    limits: Limits = STATION_LIMITS,
) -> FrameCalibration:
    """Find the frame ``source`` in the frame ``target`` from the points that both have.

    Parameters
    ----------
    source, target
        The points in either frame; they are paired by name, and a name that only one of them has is ignored.
        No covariance of the source may be singular.
    weighted
        Weigh each miss with the inverse covariance of both points (maximum likelihood); False is Arun's plain
        least squares. The search for bad points follows the noise model either way.
    levelled
        Both z axes are vertical: only heading and position are solved.
    limits
        What counts as weak and as a blunder.

    Returns
    -------
    FrameCalibration
        ``T`` takes source to target coordinates.

    Raises
    ------
    DegenerateGeometryError
        There are fewer than three common points, or they coincide or lie in a line (levelled: above one
        another).
    GeometryError
        A covariance of the source is singular.
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
    fit_frame(pairs, weighted=True)  # so that a degenerate set is refused before the search for bad points
    bad = _bad_points(pairs, limits.blunder_m)
    kept = pairs.without(*(bad or ()))
    fit = fit_frame(kept, weighted=weighted)
    predictions = [_Prediction.of(kept, name, weighted=weighted) for name in kept.names]
    return FrameCalibration(
        T=transform_from(fit.rotation, fit.translation_m),
        covariance=fit.covariance,
        used=kept.names,
        residuals_m=np.linalg.norm(fit.residuals_m(kept), axis=1),
        leave_one_out_m=np.array([np.nan if p is None else p.length_m for p in predictions]),
        rejected=tuple(
            RejectedPoint(name, float(np.linalg.norm(fit.residuals_m(pairs.only(name)))))
            for name in bad or ()
        ),
        consistent=bad is not None,
        weak=_weak_axes(fit.covariance, kept.target.points_m, limits.weak_rad),
        tilt_rad=_tilt_rad(kept) if levelled else None,
    )


def calibrate_prisms(body: PointSet, body_cad: PointSet, prisms: PointSet) -> PrismCalibration:
    """Find the prisms in the robot frame from one station's measurements of them and of body points.

    Parameters
    ----------
    body
        Body points as the station measured them, in the station's frame.
    body_cad
        The same points in the robot frame, from CAD, with the tolerance of the build as covariance.
    prisms
        Prisms as the station measured them from the same place, in the station's frame.

    Returns
    -------
    PrismCalibration
        The prisms in the robot frame.

    Raises
    ------
    DegenerateGeometryError
        There are fewer than three body points, or they coincide or lie in a line.
    """
    frame = calibrate_frame(body, body_cad, limits=BODY_LIMITS)
    rotation = frame.T[:3, :3]
    jacobian = pose_jacobian(prisms.points_m @ rotation.T)
    covariances = (
        rotation @ prisms.covariances_m2 @ rotation.T
        + jacobian @ frame.covariance @ jacobian.transpose(0, 2, 1)
    )
    return PrismCalibration(
        body=frame,
        prisms=PointSet(prisms.names, transform_points(frame.T, prisms.points_m), covariances),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Prediction:
    """Where one point misses its prediction by the others."""

    prediction_error_m: FloatArray  # (3,)
    residual_covariances_m2: (
        FloatArray  # (3, 3) covariance of the miss: of the prediction and of the point itself
    )
    scale: float  # of the others' scatter to their noise, as variances

    @classmethod
    def of(cls, pairs: PointPairs, name: PointName, *, weighted: bool) -> _Prediction | None:
        """Predict a point from the others; None where they do not hold it."""
        others, point = pairs.without(name), pairs.only(name)
        try:
            fit = fit_frame(others, weighted=weighted)
        except DegenerateGeometryError:
            return None
        jacobian = pose_jacobian(point.source.points_m @ fit.rotation.T)[0]
        spread = jacobian @ fit.covariance @ jacobian.T
        if (
            np.linalg.eigvalsh(fit.covariance[3:, 3:]).max() > MAX_PREDICTION_SIGMA_RAD**2
            or np.linalg.eigvalsh(spread).max() > MAX_PREDICTION_SIGMA_M**2
        ):
            return None
        return cls(
            prediction_error_m=fit.residuals_m(point)[0],
            residual_covariances_m2=fit.residual_covariances_m2(point)[0] + spread,
            scale=fit.chi_squared(others) / others.redundancy,
        )

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(self.prediction_error_m))

    @property
    def implausibility(self) -> float:
        """Squared miss over its noise."""
        squared = float(
            self.prediction_error_m @ np.linalg.solve(self.residual_covariances_m2, self.prediction_error_m)
        )
        return squared / _noise_scale(self.scale)


def _noise_scale(scatter: float) -> float:
    """Factor on the noise model's variances, given what the points scatter among themselves in units of it.

    Where they disagree more than the model says, it is taken to be optimistic by as much, up to ``MAX_NOISE_SCALE``.
    """
    return min(max(scatter, 1.0), MAX_NOISE_SCALE**2)


def _suspect(pairs: PointPairs, blunder_m: float) -> PointName | None:
    """Name the point that the others contradict most, if they do so beyond chance (chi squared, Bonferroni)."""
    scores = {}
    for name in pairs.names:
        prediction = _Prediction.of(pairs, name, weighted=True)
        if prediction is not None and prediction.length_m >= blunder_m:
            scores[name] = prediction.implausibility
    worst = max(scores, key=lambda name: scores[name], default=None)
    if worst is None or scores[worst] <= chdtri(3, FALSE_ALARM_RATE / len(pairs.names)):
        return None
    return worst


def _bad_points(pairs: PointPairs, blunder_m: float) -> tuple[PointName, ...] | None:
    """Points to leave out, found one at a time; None where it cannot be told which ones are bad.

    It cannot be told when leaving out some other point instead would make the rest plausible as well, when
    fewer than four points would remain, when the bad ones come near to half of all, or when the rest disagree
    with their noise although none stands out.
    """
    bad: list[PointName] = []
    kept = pairs
    bad_max = (len(pairs.names) - MIN_POINTS) // 2
    while (suspect := _suspect(kept, blunder_m)) is not None:
        others = [name for name in kept.names if name != suspect]
        if len(bad) == bad_max or any(_suspect(kept.without(name), blunder_m) is None for name in others):
            return None
        bad.append(suspect)
        kept = kept.without(suspect)
    chi_squared = fit_frame(kept, weighted=True).chi_squared(kept)
    return (
        tuple(bad) if chi_squared <= MAX_NOISE_SCALE**2 * chdtri(kept.redundancy, FALSE_ALARM_RATE) else None
    )


def _weak_axes(covariance: FloatArray, points_m: FloatArray, limit_rad: float) -> tuple[WeakAxis, ...]:
    """Principal axes of the rotation's covariance whose sigma exceeds the limit, worst first."""
    variances, axes = np.linalg.eigh(covariance[3:, 3:])
    weak = []
    for variance, axis in zip(variances[::-1], axes.T[::-1], strict=True):
        if variance > limit_rad**2:
            x, y, z = (axis if axis @ points_m.mean(axis=0) >= 0 else -axis).tolist()
            weak.append(WeakAxis((x, y, z), float(np.sqrt(variance))))
    return tuple(weak)


def _tilt_rad(pairs: PointPairs) -> float | None:
    """Angle between the z axes if the points demand one: the misfit then drops by more than two unknowns explain."""
    free = PointPairs(pairs.source, pairs.target, levelled=False)
    try:
        tilted = fit_frame(free, weighted=True)
    except DegenerateGeometryError:
        return None  # a line of points cannot tell
    left = tilted.chi_squared(free)
    drop = fit_frame(pairs, weighted=True).chi_squared(pairs) - left
    if drop <= chdtri(2, FALSE_ALARM_RATE) * _noise_scale(left / free.redundancy):
        return None
    return float(np.arccos(np.clip(tilted.rotation[2, 2], -1.0, 1.0)))
