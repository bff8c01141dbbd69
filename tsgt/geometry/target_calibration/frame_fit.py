"""Least-squares fit of one frame to another from points known in both, weighted by the noise of both.

Arun's alignment (Arun et al. 1987) is the initial guess of Gauss-Newton on rigid transforms. For levelled instruments both
solve heading and position only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry.alignment import align
from tsgt.geometry.rigid import exp_so3, skew

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry.rigid import FloatArray

PointName = int | str

MAX_ITERATIONS = 20
STEP_TOLERANCE = 1e-10  # in m and rad: far below any instrument's noise, well above rounding at 100 m


@dataclass(frozen=True, slots=True, eq=False)
class PointSet:
    """Named points in one frame, with their noise."""

    names: tuple[PointName, ...]  # n different target numbers or names of body points
    points_m: FloatArray  # (n, 3)
    covariances_m2: FloatArray  # (n, 3, 3) in the same frame; may be zero

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(set(self.names)) != n:
            raise GeometryError(
                f"expected {n} different names of points, got {', '.join(map(str, self.names))}"
            )
        if self.points_m.shape != (n, 3) or self.covariances_m2.shape != (n, 3, 3):
            raise GeometryError(
                f"expected points ({n}, 3) and covariances ({n}, 3, 3), "
                f"got {self.points_m.shape} and {self.covariances_m2.shape}"
            )
        if not (np.isfinite(self.points_m).all() and np.isfinite(self.covariances_m2).all()):
            raise GeometryError("expected finite coordinates and covariances, got NaN or infinity")

    def select(self, names: Sequence[PointName]) -> PointSet:
        """Return the points with these names, in this order."""
        rows = [self.names.index(name) for name in names]
        return PointSet(tuple(names), self.points_m[rows], self.covariances_m2[rows])


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """The same points in two frames, in the same order and with the same names."""

    source: PointSet
    target: PointSet
    levelled: bool  # both z axes are vertical: only heading and position are solved

    @property
    def names(self) -> tuple[PointName, ...]:
        """Names of the points."""
        return self.source.names

    def only(self, *names: PointName) -> PointPairs:
        """Return the points with these names, in this order."""
        return PointPairs(self.source.select(names), self.target.select(names), self.levelled)

    def without(self, *names: PointName) -> PointPairs:
        """Return all but the points with these names."""
        return self.only(*(name for name in self.names if name not in names))

    @property
    def unknowns(self) -> list[int]:
        """Solved components of (x, y, z, rotation about x, y, z)."""
        return [0, 1, 2, 5] if self.levelled else [0, 1, 2, 3, 4, 5]

    @property
    def redundancy(self) -> int:
        """Degrees of freedom: coordinates minus unknowns."""
        return 3 * len(self.names) - len(self.unknowns)


@dataclass(frozen=True, slots=True, eq=False)
class FrameFit:
    """A rigid transform: ``target = rotation source + translation_m``."""

    rotation: FloatArray
    translation_m: FloatArray
    # (6, 6) of (x, y, z, rotation about the target frame's fixed axes x, y, z) in m and rad, from the noise of the points;
    # zero for components that are not solved
    covariance: FloatArray

    def residuals_m(self, pairs: PointPairs) -> FloatArray:
        """(n, 3) target minus transformed source."""
        moved = pairs.source.points_m @ self.rotation.T + self.translation_m
        residuals: FloatArray = pairs.target.points_m - moved
        return residuals

    def residual_covariances_m2(self, pairs: PointPairs) -> FloatArray:
        """(n, 3, 3) covariance of the residuals from the noise of both points."""
        noise: FloatArray = (
            self.rotation @ pairs.source.covariances_m2 @ self.rotation.T + pairs.target.covariances_m2
        )
        return noise

    def chi_squared(self, pairs: PointPairs) -> float:
        """Sum of the squared normalised residuals."""
        residuals = self.residuals_m(pairs)[:, :, None]
        return float(np.sum(residuals * np.linalg.solve(self.residual_covariances_m2(pairs), residuals)))


def fit_frame(pairs: PointPairs, *, weighted: bool) -> FrameFit:
    """Fit a rigid transform to three or more points by Gauss-Newton, initialised with Arun's solution.

    No residual covariance may be singular; their inverses, at Arun's rotation, are the weights (``weighted`` False: Arun's
    unweighted least squares). The covariance of the result is of first order in the noise. The steps fail to converge only
    where the points are collinear up to their noise; Arun's solution is returned then, with a covariance that shows it.
    Raises DegenerateGeometryError: too few points, or they coincide or are collinear (levelled: above one another).
    """
    initial = _initial_fit(pairs)
    noise = initial.residual_covariances_m2(pairs)
    if weighted:
        weights = np.asarray(np.linalg.inv(noise), dtype=np.float64)
        fit = initial
        for _ in range(MAX_ITERATIONS):
            step, covariance = _gauss_newton_step(fit, pairs, weights, noise)
            fit = FrameFit(exp_so3(step[3:]) @ fit.rotation, fit.translation_m + step[:3], covariance)
            if np.abs(step).max() < STEP_TOLERANCE:
                return fit
    _, covariance = _gauss_newton_step(initial, pairs, np.eye(3), noise)
    return FrameFit(initial.rotation, initial.translation_m, covariance)


def _gauss_newton_step(
    fit: FrameFit, pairs: PointPairs, weights: FloatArray, residual_covariances_m2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step (6,) of (translation, rotation), and the covariance (6, 6) of an optimum at this fit."""
    free = pairs.unknowns
    jacobian = pose_jacobian(pairs.source.points_m @ fit.rotation.T)[:, :, free]
    projected = jacobian.transpose(0, 2, 1) @ weights
    inverse = np.linalg.inv(np.sum(projected @ jacobian, axis=0))
    step = np.zeros(6)
    step[free] = inverse @ np.sum(projected @ fit.residuals_m(pairs)[:, :, None], axis=0)[:, 0]
    # Sandwich covariance: valid for any weights; equal to the inverse for those of the noise itself.
    free_covariance = (
        inverse @ np.sum(projected @ residual_covariances_m2 @ projected.transpose(0, 2, 1), axis=0) @ inverse
    )
    covariance = np.zeros((6, 6))
    covariance[np.ix_(free, free)] = (free_covariance + free_covariance.T) / 2
    return step, covariance


def _initial_fit(pairs: PointPairs) -> FrameFit:
    """Unweighted alignment: Arun's solution, or its two-dimensional form about the vertical for levelled instruments."""
    no_covariance = np.zeros((6, 6))
    source, target = pairs.source.points_m, pairs.target.points_m
    if not pairs.levelled:
        aligned = align(source, target)
        return FrameFit(aligned.rotation, aligned.translation_m, no_covariance)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    cosine = float(np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    sine = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    across, along = np.linalg.norm(b[:, :2]), np.linalg.norm(b)
    if across <= 1e-6 * along or np.hypot(cosine, sine) == 0:
        raise DegenerateGeometryError(
            f"expected points apart from each other in plan, got a horizontal spread of {1e3 * across:.3f} mm; "
            "add points away from them"
        )
    rotation = exp_so3(np.array([0.0, 0.0, np.arctan2(sine, cosine)]))
    return FrameFit(rotation, target.mean(axis=0) - rotation @ source.mean(axis=0), no_covariance)


def pose_jacobian(rotated_m: FloatArray) -> FloatArray:
    """Jacobian of R p + t by (t, rotation about the fixed axes), given R p; (n, 3, 6)."""
    identity = np.broadcast_to(np.eye(3), (len(rotated_m), 3, 3))
    return np.concatenate([identity, -skew(rotated_m)], axis=2)
