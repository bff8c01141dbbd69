"""Errors of paired poses, each with the part that the reference's own uncertainty explains. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.evaluation import (
    Bins,
    ErrorSummary,
    NeesStatistics,
    PoseComponents,
    TransformErrors,
    absolute_errors,
    binned,
)
from tsgt.geometry import log_so3, rotate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.pairing import PairedPoses
    from tsgt.geometry import FloatArray

TRAVEL_COMPONENTS = ("along", "across", "up", "roll", "pitch", "yaw")
"""Errors along the horizontal direction of travel, to its left, and up; rotations about these axes."""

MIN_SPEED_MPS = 0.1  # Below it the direction of travel is that of before
_HALF_WINDOW_S = 0.25  # Speed and turn rate are means over twice this
RESOLUTION_FACTOR = math.sqrt(2.0)


@dataclass(frozen=True, slots=True)
class Explained:
    """Root mean squares of position and rotation that the reference's covariance predicts, of which ``common`` all poses share.

    NaN where it is unknown.
    """

    position_rms_mm: float
    orientation_rms_deg: float
    common_position_rms_mm: float
    common_orientation_rms_deg: float

    @classmethod
    def of(cls, covariance: FloatArray | None, common: FloatArray | None) -> Explained:
        """Reduce covariances, (N, 6, 6); None: unknown."""
        return cls(*_rms_of(covariance), *_rms_of(common))

    def independent(self) -> Explained:
        """Return it without the common part, which an alignment of the frames absorbs."""
        if math.isnan(self.common_position_rms_mm):
            return self
        return replace(
            self,
            position_rms_mm=_without(self.position_rms_mm, self.common_position_rms_mm),
            orientation_rms_deg=_without(self.orientation_rms_deg, self.common_orientation_rms_deg),
            common_position_rms_mm=0.0,
            common_orientation_rms_deg=0.0,
        )


def _without(whole: float, part: float) -> float:
    return math.sqrt(max(0.0, whole**2 - part**2))


def _rms_of(covariance: FloatArray | None) -> tuple[float, float]:
    if covariance is None or not len(covariance):
        return math.nan, math.nan
    diagonal = np.einsum("nii->ni", covariance)
    position, rotation = (
        math.sqrt(max(0.0, float(diagonal[:, columns].sum(axis=1).mean())))
        for columns in (slice(0, 3), slice(3, 6))
    )
    return 1e3 * position, math.degrees(rotation)


@dataclass(frozen=True, slots=True)
class JudgedErrors:
    """Errors, and what the reference's uncertainty explains of their root mean squares.

    A figure is below the reference's resolution if what it has beyond the explained part, ``sqrt(rms² - explained²)``, is less
    than that part.
    """

    errors: TransformErrors
    explained: Explained

    @property
    def position_below_resolution(self) -> bool:
        """Whether the position error is below the reference's resolution."""
        return self.errors.position_mm.rms < RESOLUTION_FACTOR * self.explained.position_rms_mm

    @property
    def orientation_below_resolution(self) -> bool:
        """Whether the rotation error is below the reference's resolution."""
        return self.errors.orientation_deg.rms < RESOLUTION_FACTOR * self.explained.orientation_rms_deg

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        e = self.explained
        return {
            **self.errors.keys(),
            "explained_position_rms_mm": e.position_rms_mm,
            "explained_orientation_rms_deg": e.orientation_rms_deg,
            "explained_common_position_rms_mm": e.common_position_rms_mm,
            "explained_common_orientation_rms_deg": e.common_orientation_rms_deg,
            "position_below_resolution": self.position_below_resolution,
            "orientation_below_resolution": self.orientation_below_resolution,
        }


def judged(pairs: PairedPoses, errors: TransformErrors, explained: Explained) -> JudgedErrors:
    """Return errors with the explained part; of positions alone, rotations are unknown."""
    if not pairs.has_orientation:
        unknown = ErrorSummary.of(np.empty(0))
        errors = replace(errors, orientation_deg=unknown, full=unknown)
        explained = replace(explained, orientation_rms_deg=math.nan, common_orientation_rms_deg=math.nan)
    return JudgedErrors(errors, explained)


def absolute(pairs: PairedPoses, *, aligned: bool) -> JudgedErrors:
    """Return the ATE as evo has it; ``aligned``: whether the frame was, which absorbs the reference's common part."""
    explained = Explained.of(pairs.reference_covariance, pairs.reference_covariance_common)
    errors = absolute_errors(pairs.estimated, pairs.reference)
    return judged(pairs, errors, explained.independent() if aligned else explained)


@dataclass(frozen=True, slots=True)
class ErrorSeries:
    """Errors of K paired poses over time, with the motion of the reference.

    ``components`` are those of :data:`TRAVEL_COMPONENTS` with the reference's sigmas; rotations are NaN for positions alone.
    """

    components: PoseComponents
    position_m: FloatArray  # (K,) norm
    rotation_rad: FloatArray  # (K,) angle
    path_m: FloatArray  # (K,) driven since the first pose, by the reference
    speed_mps: FloatArray  # (K,)
    turn_rate_radps: FloatArray  # (K,) about the vertical, absolute

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """Instants, (K,), on the reference's clock."""
        return self.components.stamp_ns

    def by_speed(self) -> Bins | None:
        """Return the position errors in bins of the speed; None with too few."""
        return binned(self.position_m[None], self.speed_mps)

    def by_turn_rate(self) -> Bins | None:
        """Return the position errors in bins of the turn rate; None with too few."""
        return binned(self.position_m[None], self.turn_rate_radps)

    def component_keys(self) -> dict[str, Any]:
        """Return mean, rms, the part explained by the reference, and the share within two of its sigmas, for ``--json``."""
        c = self.components
        names = [f"{name}_{'mm' if row < 3 else 'deg'}" for row, name in enumerate(TRAVEL_COMPONENTS)]
        scale = np.array([1e3] * 3 + [180 / np.pi] * 3)
        mean, rms, explained = scale * _mean(c.value), scale * c.rms, scale * np.sqrt(_mean(c.sigma**2))
        columns = (mean.tolist(), rms.tolist(), explained.tolist(), c.within_two_sigma.tolist())
        return {
            name: dict(zip(("mean", "rms", "explained_rms", "within_2_sigma"), figures, strict=True))
            for name, *figures in zip(names, *columns, strict=True)
        }


def _mean(values: FloatArray) -> FloatArray:
    known = np.isfinite(values)
    count = known.sum(axis=0)
    mean = np.where(known, values, 0.0).sum(axis=0) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan)


def error_series(pairs: PairedPoses) -> ErrorSeries:
    """Resolve the errors of paired poses in the axes of travel, and add the motion of the reference."""
    true_m = pairs.reference[:, :3, 3]
    time_s = (pairs.stamp_ns - pairs.stamp_ns[:1]) / 1e9
    velocity = _mean_rates(time_s, true_m)
    axes = travel_axes(velocity)
    into = np.swapaxes(axes, 1, 2)
    shift = rotate(into, pairs.estimated[:, :3, 3] - true_m)
    turn = rotate(into, rotation_errors(pairs)) if pairs.has_orientation else np.full_like(shift, np.nan)
    known = (1.0,) * 3 + (1.0 if pairs.has_orientation else np.nan,) * 3
    sigmas = (
        np.full((len(time_s), 6), np.nan) if covariance is None else _sigmas(into, covariance) * known
        for covariance in (pairs.reference_covariance, pairs.reference_covariance_common)
    )
    steps_m = np.linalg.norm(np.diff(true_m, axis=0), axis=1)
    yaw_rad = np.concatenate([[0.0], np.cumsum(_vertical_turns(pairs.reference[:, :3, :3]))])[: len(time_s)]
    return ErrorSeries(
        components=PoseComponents(pairs.stamp_ns, np.concatenate([shift, turn], axis=1), *sigmas),
        position_m=np.linalg.norm(shift, axis=1),
        rotation_rad=np.linalg.norm(turn, axis=1),
        path_m=np.concatenate([[0.0], np.cumsum(steps_m)])[: len(time_s)],
        speed_mps=np.linalg.norm(velocity, axis=1),
        turn_rate_radps=np.abs(_mean_rates(time_s, yaw_rad[:, None])[:, 0]),
    )


def rotation_errors(pairs: PairedPoses) -> FloatArray:
    """Return the rotation from the reference to the estimate about the fixed axes of ``station1``, (K, 3) in rad."""
    return log_so3(pairs.estimated[:, :3, :3] @ np.swapaxes(pairs.reference[:, :3, :3], 1, 2))


def travel_axes(velocity_mps: FloatArray) -> FloatArray:
    """Return rotations, (K, 3, 3), to ``station1`` from axes along the horizontal direction of travel, to its left, and up.

    Below :data:`MIN_SPEED_MPS` the direction is the last one, or the next one at the beginning, or x if nothing ever moves.
    """
    vx, vy = velocity_mps[:, 0], velocity_mps[:, 1]
    size = np.hypot(vx, vy)
    moving = np.flatnonzero(size > MIN_SPEED_MPS)
    axes = np.broadcast_to(np.eye(3), (len(size), 3, 3)).copy()
    if len(moving):
        rows = moving[np.maximum(np.searchsorted(moving, np.arange(len(size)), side="right") - 1, 0)]
        cosine, sine = vx[rows] / size[rows], vy[rows] / size[rows]
        axes[:, 0, 0], axes[:, 0, 1] = cosine, -sine
        axes[:, 1, 0], axes[:, 1, 1] = sine, cosine
    return axes


def _mean_rates(time_s: FloatArray, values: FloatArray) -> FloatArray:
    """Return mean rates of change of values, (K, D), around each instant; (K, D)."""
    if len(time_s) < 2:
        return np.zeros_like(values)
    start = np.clip(time_s - _HALF_WINDOW_S, time_s[0], time_s[-1])
    end = np.clip(time_s + _HALF_WINDOW_S, time_s[0], time_s[-1])
    change = np.stack(
        [np.interp(end, time_s, column) - np.interp(start, time_s, column) for column in values.T], axis=1
    )
    return change / (end - start)[:, None]


def _vertical_turns(R: FloatArray) -> FloatArray:
    """Return the turn about the vertical, in rad, from each rotation, (K, 3, 3), to the next."""
    return log_so3(R[1:] @ np.swapaxes(R[:-1], 1, 2))[:, 2]


def _sigmas(into: FloatArray, covariance: FloatArray) -> FloatArray:
    blocks = (covariance[:, :3, :3], covariance[:, 3:, 3:])
    variances = [np.einsum("nij,njk,nik->ni", into, block, into, optimize=True) for block in blocks]
    # A variance that should be 0 may be less by rounding.
    sigmas: FloatArray = np.sqrt(np.maximum(np.concatenate(variances, axis=1), 0.0))
    return sigmas


@dataclass(frozen=True, slots=True)
class Nees:
    """NEES of the estimate's errors under its own covariance and the reference's; expected mean: ``degrees_of_freedom``."""

    degrees_of_freedom: int
    statistics: NeesStatistics

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        s = self.statistics
        return {
            "degrees_of_freedom": self.degrees_of_freedom,
            "mean": s.mean,
            "above_95": s.above_95,
            "max": s.max,
        }


def nees(pairs: PairedPoses) -> Nees | None:
    """Return the NEES of paired poses; None if the estimate has no covariance, or none that can be inverted."""
    if pairs.estimate_covariance is None:
        return None
    size = 6 if pairs.has_orientation else 3
    covariance = pairs.estimate_covariance[:, :size, :size]
    if pairs.reference_covariance is not None:
        covariance = covariance + pairs.reference_covariance[:, :size, :size]
    errors = pairs.estimated[:, :3, 3] - pairs.reference[:, :3, 3]
    if pairs.has_orientation:
        errors = np.concatenate([errors, rotation_errors(pairs)], axis=1)
    known = np.isfinite(covariance).all(axis=(1, 2)) & (np.einsum("nii->ni", covariance) > 0).all(axis=1)
    if not known.any():
        return None
    try:
        return Nees(size, NeesStatistics.of(errors[known], covariance[known]))
    except np.linalg.LinAlgError:
        return None
