"""Initial station frame from targets that may contain gross errors: least median of squares over small subsets."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import DegenerateGeometryError
from tsgt.geometry.target_calibration.frame_fit import FrameFit, fit_frame

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.target_calibration.frame_fit import PointPairs

MAX_SUBSETS = 400  # All triples of up to 14 targets
MAX_SQUARED_DISTANCE = (
    25.0  # Of a target from its counterpart, in variances of a coordinate; beyond, it is left out
)


def robust_frame(pairs: PointPairs) -> FrameFit:
    """Fit a frame to the larger consistent part of three or more points.

    Raises DegenerateGeometryError: too few points, or they coincide or are collinear (levelled: above one another).
    """
    whole = fit_frame(pairs, weighted=True)
    n, size = len(pairs.names), 2 if pairs.levelled else 3
    if n <= size + 1:
        return whole
    subsets = np.array(list(combinations(range(n), size)))
    if len(subsets) > MAX_SUBSETS:
        subsets = subsets[np.linspace(0, len(subsets) - 1, MAX_SUBSETS).astype(int)]
    rotation, translation = (_levelled_frames if pairs.levelled else _frames)(
        pairs.source.points_m[subsets], pairs.target.points_m[subsets]
    )
    variances = np.trace(pairs.source.covariances_m2 + pairs.target.covariances_m2, axis1=1, axis2=2) / 3
    moved = np.einsum("sij,nj->sni", rotation, pairs.source.points_m) + translation[:, None]
    squared = np.sum((pairs.target.points_m - moved) ** 2, axis=2) / variances
    half = (n + size + 1) // 2
    best = int(np.argmin(np.partition(squared, half - 1, axis=1)[:, half - 1]))
    kept = np.argsort(squared[best])[:half]
    fit = whole
    for _ in range(3):
        try:
            fit = fit_frame(pairs.only(*(pairs.names[row] for row in kept)), weighted=True)
        except DegenerateGeometryError:
            return whole
        squared_distance = np.sum(fit.residuals_m(pairs) ** 2, axis=1) / variances
        limit = MAX_SQUARED_DISTANCE * max(1.0, float(np.median(squared_distance[kept])) / 2.4)
        kept = np.flatnonzero(squared_distance <= limit)
    return fit


def _frames(source: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rigid transforms (s, 3, 3), (s, 3) of triples of points (s, 3, 3): Arun's solution."""
    a, b = (points - points.mean(axis=1, keepdims=True) for points in (source, target))
    u, _, vt = np.linalg.svd(a.transpose(0, 2, 1) @ b)
    signs = np.ones((len(u), 3))
    signs[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = vt.transpose(0, 2, 1) @ (signs[:, :, None] * u.transpose(0, 2, 1))
    return rotation, target.mean(axis=1) - np.einsum("sij,sj->si", rotation, source.mean(axis=1))


def _levelled_frames(source: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations about the vertical and translations from pairs of points (s, 2, 3)."""
    a, b = source[:, 1] - source[:, 0], target[:, 1] - target[:, 0]
    yaw = np.arctan2(b[:, 1], b[:, 0]) - np.arctan2(a[:, 1], a[:, 0])
    rotation = np.zeros((len(yaw), 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(yaw)
    rotation[:, 1, 0] = np.sin(yaw)
    rotation[:, 0, 1] = -rotation[:, 1, 0]
    rotation[:, 2, 2] = 1.0
    return rotation, target.mean(axis=1) - np.einsum("sij,sj->si", rotation, source.mean(axis=1))
