"""Rigid registration of point sets: least-squares rotation and translation.

:func:`align` serves calibration: one weighted set with covariance. :func:`align_triplets` and :func:`align_many` serve
poses: one layout against many measured sets, unweighted; three points have a closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry.rigid import rotate, skew, transform_from

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from tsgt.geometry.rigid import FloatArray

COLLINEAR_RATIO = 1e-6  # Spread across the best line to that along it; below, points are collinear
ROUNDING = 1e-12  # A spread below this ratio of the coordinates is rounding error


@dataclass(frozen=True, slots=True)
class Alignment:
    """The rigid transform that brings source points closest to target points."""

    rotation: FloatArray  # R, (3, 3), proper: ``target = R source + t``
    translation_m: FloatArray  # t, (3,)
    residuals_m: FloatArray  # (n, 3) target minus transformed source
    rms_m: float  # Root mean square of the residuals' lengths, unweighted
    # 6x6 of (translation x, y, z in m; rotation about the target frame's fixed axes x, y, z in rad): the true
    # transform is ``[exp(dtheta) R | t + dt]``
    covariance: FloatArray

    @property
    def T(self) -> FloatArray:  # noqa: N802 (the field's name for a transform)
        """4x4 transform ``T_target_source``."""
        return transform_from(self.rotation, self.translation_m)


@dataclass(frozen=True, slots=True)
class BatchAlignment:
    """The rigid transforms that bring one layout closest to each of N measured sets of its P points."""

    rotation: FloatArray  # (N, 3, 3): ``point = R layout + t``. The identity where degenerate.
    translation_m: FloatArray  # (N, 3)
    residuals_m: FloatArray  # (N, P, 3) measured minus transformed layout
    # (N,) the measured points coincide or are collinear (relative to the layout, to :data:`COLLINEAR_RATIO`): the
    # rotation is undefined
    degenerate: NDArray[np.bool_]


def align(
    source: ArrayLike,
    target: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
) -> Alignment:
    """Weighted least-squares rigid alignment of two point sets (Arun et al. 1987; Umeyama 1991 for the sign).

    Raises DegenerateGeometryError: fewer than three points, coincident or collinear points, or a mirror image that fits
    equally well in more than one way.
    Raises GeometryError: shapes that do not match, numbers that are not finite, weights that are not positive.

    Parameters
    ----------
    source, target : (n, 3) the same n >= 3 points in either frame in m.
    weights : (n,) positive; equal when not given. Only their ratios count.
    covariances
        (n, 3, 3) covariance of each residual (of both points together) in the target frame in m^2. When not given, the
        noise is taken as isotropic with variances inverse to the weights, its size estimated from the residuals with
        3n - 6 degrees of freedom.

    Returns with a covariance of first order in the noise.
    """
    source, target = _points(source, "source"), _points(target, "target")
    n = len(source)
    if len(target) != n:
        raise GeometryError(f"alignment needs as many target as source points, got {len(target)} and {n}")
    w = np.ones(n) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (n,) or not np.all((w > 0) & np.isfinite(w)):
        raise GeometryError(f"alignment needs {n} positive weights, got {w.tolist()}")
    check_spread(source, "source points")
    check_spread(target, "target points")

    w = w / w.sum()
    source_mean, target_mean = w @ source, w @ target
    cross_covariance = (w[:, None] * (source - source_mean)).T @ (target - target_mean)
    u, s, vt = np.linalg.svd(cross_covariance)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    if s[1] + sign * s[2] <= ROUNDING * s[1]:
        raise DegenerateGeometryError(
            "the target points are a mirror image of the source points: no rotation fits best"
        )
    R = (vt.T * (1.0, 1.0, sign)) @ u.T
    t = target_mean - R @ source_mean
    residuals = target - (source @ R.T + t)

    if covariances is None:
        variance = float(w @ (residuals**2).sum(axis=1)) / (3 * n - 6)
        point_covariances = (variance / w)[:, None, None] * np.eye(3)
    else:
        point_covariances = np.asarray(covariances, dtype=np.float64)
        if point_covariances.shape != (n, 3, 3) or not np.isfinite(point_covariances).all():
            raise GeometryError(
                f"alignment needs {n} finite 3x3 covariances, got shape {point_covariances.shape}"
            )
    gain = fit_gain(source @ R.T, w)
    return Alignment(
        rotation=R,
        translation_m=t,
        residuals_m=residuals,
        rms_m=float(np.sqrt((residuals**2).sum(axis=1).mean())),
        covariance=(gain @ point_covariances @ np.swapaxes(gain, 1, 2)).sum(axis=0),
    )


def fit_gain(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the derivative of the fitted rigid transform by the displacement of each of n points, (n, 6, 3).

    Summed over the points, gain times displacement is (translation of the moved frame's origin, small rotation) in the axes
    of ``points``, (n, 3) in m from it: the pseudo-inverse of ``[I, -skew(point)]`` with the fit's weights, (n,), in blocks.
    """
    w = weights / weights.sum()
    mean = w @ points
    arms = skew(points - mean)
    # About the weighted mean, translation and rotation decouple; about the origin their normal matrix is badly
    # conditioned as soon as the points are far away.
    inertia = np.linalg.inv((w[:, None, None] * (np.swapaxes(arms, 1, 2) @ arms)).sum(axis=0))
    rotation = inertia @ (w[:, None, None] * arms)
    translation = w[:, None, None] * np.eye(3) + skew(mean) @ rotation
    return np.concatenate([translation, rotation], axis=1)


def align_triplets(layout: ArrayLike, points: ArrayLike) -> BatchAlignment:
    """Closed-form alignment of three layout points, (3, 3), with N measured triplets, (N, 3, 3): item, point, coordinate.

    In m, in the body and in the world frame. The optimum is that of :func:`align_many` to rounding. Raises
    DegenerateGeometryError: the layout's points coincide or are collinear; a degenerate measured triplet is marked instead.
    Raises GeometryError: wrong shapes or numbers that are not finite.

    It maps centroid to centroid and plane to plane; what remains is one angle in the plane. Let b1, b2, b3 be axes of the
    layout with b3 its normal, (u_i, v_i) its points on b1, b2 from their centroid, and n the measured normal. With U = sum
    u_i p_i and V = sum v_i p_i, the image r1 of b1 maximises U·r1 + V·(n x r1) = r1·(U - n x V), so r1 is the direction of U
    - n x V: no trigonometry, no decomposition.
    """
    layout = np.asarray(layout, dtype=np.float64)
    if layout.shape != (3, 3):
        count = len(_points(layout, "layout"))
        raise GeometryError(f"the closed form is for 3 points, the layout has {count}")
    batch = _batch(points, 3)
    layout_mean, double_area, (b1, b2, b3), u, v = _triangle(layout.tobytes())

    # Coordinates first, items last: each step below passes over contiguous rows.
    p = np.ascontiguousarray(batch.transpose(1, 2, 0))
    mean = (p[0] + p[1] + p[2]) / 3
    edge_1, edge_2 = p[1] - p[0], p[2] - p[0]
    normal = _cross(edge_1, edge_2)
    normal_length = _norm(normal)
    degenerate = normal_length <= COLLINEAR_RATIO * double_area
    normal /= np.where(degenerate, 1.0, normal_length)
    # The u_i and the v_i sum to zero: U and V follow from the edges.
    U = u[1] * edge_1 + u[2] * edge_2
    V = v[1] * edge_1 + v[2] * edge_2
    r1 = U - _cross(normal, V)
    r1 /= np.where(degenerate, 1.0, _norm(r1))
    r2 = _cross(normal, r1)
    if degenerate.any():
        for axis, body_axis in ((r1, b1), (r2, b2), (normal, b3)):
            axis[:, degenerate] = body_axis[:, None]

    R = b1[:, None] * r1[:, None] + b2[:, None] * r2[:, None] + b3[:, None] * normal[:, None]
    residuals = p - mean - (u[:, None, None] * r1 + v[:, None, None] * r2)
    translation = mean - (layout_mean[0] * R[:, 0] + layout_mean[1] * R[:, 1] + layout_mean[2] * R[:, 2])
    # Contiguous: the memory layout depends on N, and a matrix product may round differently for another layout.
    return BatchAlignment(
        rotation=np.ascontiguousarray(R.transpose(2, 0, 1)),
        translation_m=np.ascontiguousarray(translation.T),
        residuals_m=np.ascontiguousarray(residuals.transpose(2, 0, 1)),
        degenerate=degenerate,
    )


@lru_cache(maxsize=16)
def _triangle(points: bytes) -> tuple[FloatArray, float, FloatArray, FloatArray, FloatArray]:
    """Centroid of a layout, twice its area, its axes in rows, and its points' coordinates along the first two axes."""
    layout = _points(np.frombuffer(points).reshape(3, 3), "layout")
    check_spread(layout, "layout points")
    mean = (layout[0] + layout[1] + layout[2]) / 3
    normal = np.cross(layout[1] - layout[0], layout[2] - layout[0])
    double_area = float(np.linalg.norm(normal))
    b3 = normal / double_area
    # b1 along the edge 0-1: both ends have the same v.
    b1 = layout[1] - layout[0]
    b1 = b1 / np.linalg.norm(b1)
    b2 = np.cross(b3, b1)
    return mean, double_area, np.array([b1, b2, b3]), (layout - mean) @ b1, (layout - mean) @ b2


def align_many(layout: ArrayLike, points: ArrayLike) -> BatchAlignment:
    """Align a layout, (P, 3) in the body frame, P >= 3, with N measured sets, (N, P, 3) in the world frame, both in m.

    By one SVD each (Arun et al. 1987), equal weights. Raises as :func:`align_triplets`.
    """
    layout = _points(layout, "layout")
    batch = _batch(points, len(layout))
    check_spread(layout, "layout points")

    body = layout - layout.mean(axis=0)
    # One by one: a sum over an axis may group its terms differently for one item than for many.
    mean = sum((batch[:, i] for i in range(1, len(layout))), start=batch[:, 0]) / len(layout)
    u, s, vt = np.linalg.svd(body.T @ (batch - mean[:, None]))
    u_t, v = np.swapaxes(u, 1, 2), np.swapaxes(vt, 1, 2).copy()
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    v[:, :, 2] *= sign[:, None]
    degenerate = s[:, 1] + sign * s[:, 2] <= COLLINEAR_RATIO * len(layout) * spread_m(layout)[1] ** 2
    R = np.where(degenerate[:, None, None], np.eye(3), v @ u_t)
    translation = mean - rotate(R, layout.mean(axis=0))
    residuals = batch - rotate(R[:, None], layout) - translation[:, None]
    return BatchAlignment(rotation=R, translation_m=translation, residuals_m=residuals, degenerate=degenerate)


def spread_m(points: FloatArray) -> FloatArray:
    """(3,) root mean square of points about their mean along their principal axes in m, largest first."""
    spread: FloatArray = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return spread


def check_spread(points: FloatArray, what: str) -> None:
    """Check that (n, 3) points in m, n >= 3, span a triangle; ``what`` names them in the plural in the message.

    Raises DegenerateGeometryError: they coincide or are collinear; with the spread along and across their best line.
    """
    along_m, across_m, _ = spread_m(points)
    rounding_m = ROUNDING * float(np.abs(points).max())
    if along_m <= rounding_m:
        raise DegenerateGeometryError(
            f"the {len(points)} {what} coincide: expected at least three that span a triangle"
        )
    if across_m <= max(COLLINEAR_RATIO * along_m, rounding_m):
        raise DegenerateGeometryError(
            f"the {len(points)} {what} lie in a line: they spread {across_m:.2g} m across it over {along_m:.2g} m along "
            f"it, a ratio of {across_m / along_m:.1g}, expected more than {COLLINEAR_RATIO:g}"
        )


def _points(points: ArrayLike, what: str) -> FloatArray:
    """Check a point set of shape (n, 3), n >= 3."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise GeometryError(f"{what} points have shape (n, 3), got {array.shape}")
    if len(array) < 3:
        raise DegenerateGeometryError(f"alignment needs at least 3 {what} points, got {len(array)}")
    if not np.isfinite(array).all():
        raise GeometryError(f"{what} points are finite numbers, got NaN or infinity")
    return array


def _batch(points: ArrayLike, count: int) -> FloatArray:
    """Check measured sets of shape (N, count, 3)."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 3 or array.shape[1:] != (count, 3):
        raise GeometryError(
            f"measured points have shape (N, {count}, 3) as the layout has, got {array.shape}"
        )
    if not np.isfinite(array).all():
        raise GeometryError("measured points are finite numbers, got NaN or infinity")
    return array


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of vectors along the first axis."""
    # Concatenated twice: cyclic shifts become slices.
    a, b = np.concatenate([a, a]), np.concatenate([b, b])
    cross: FloatArray = a[1:4] * b[2:5] - a[2:5] * b[1:4]
    return cross


def _norm(a: FloatArray) -> FloatArray:
    """Lengths of vectors along the first axis."""
    length: FloatArray = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    return length
