"""Absolute and relative pose errors (APE, also called ATE, and RPE), as the tool evo defines them. Sans-I/O.

With estimated poses P and true poses Q at the same instants, the absolute error is ``inv(Q_i) P_i``, and the relative error of
a pair ``inv(inv(Q_i) Q_j) inv(P_i) P_j``: how much the estimated motion from i to j differs from the true one. Each is reduced
to the norm of its translation, the angle of its rotation, and the Frobenius norm of its difference from the identity
(``full``, which mixes metres and rotation). Nothing is aligned. Source: Sturm et al. 2012, A benchmark for the evaluation of
RGB-D SLAM systems, section V.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tsgt.geometry import invert, log_so3

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

PATH_TOLERANCE = TIME_TOLERANCE = 0.1  # As in evo
STEP_TOLERANCE = 0.51  # Of the median step: half a step at any rate, but the last poses have no partner


@dataclass(frozen=True, slots=True)
class ErrorSummary:
    """Statistics of absolute values, ``std`` with divisor n; NaN without any."""

    rms: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, values: FloatArray) -> ErrorSummary:
        """Summarise values, (N,)."""
        if not len(values):
            return cls(*(math.nan,) * len(dataclasses.fields(cls)))
        return cls(
            rms=math.sqrt(float(np.mean(values**2))),
            mean=float(values.mean()),
            median=float(np.median(values)),
            std=float(values.std()),
            min=float(values.min()),
            max=float(values.max()),
        )


@dataclass(frozen=True, slots=True)
class TransformErrors:
    """Summaries of ``n`` error transforms, as in the description of this file."""

    n: int
    position_mm: ErrorSummary
    orientation_deg: ErrorSummary
    full: ErrorSummary

    @classmethod
    def of(cls, errors: FloatArray) -> TransformErrors:
        """Summarise error transforms, (N, 4, 4)."""
        return cls(
            n=len(errors),
            position_mm=ErrorSummary.of(1e3 * np.linalg.norm(errors[:, :3, 3], axis=1)),
            orientation_deg=ErrorSummary.of(np.degrees(np.linalg.norm(log_so3(errors[:, :3, :3]), axis=1))),
            full=ErrorSummary.of(np.linalg.norm(errors - np.eye(4), axis=(1, 2))),
        )

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {
            "n": self.n,
            "position_rms_mm": self.position_mm.rms,
            "orientation_rms_deg": self.orientation_deg.rms,
            **{
                name: dataclasses.asdict(getattr(self, name))
                for name in ("position_mm", "orientation_deg", "full")
            },
        }


def absolute_errors(estimated: FloatArray, true: FloatArray) -> TransformErrors:
    """Return the APE (ATE) of poses, (N, 4, 4), against the truth at the same instants."""
    return TransformErrors.of(invert(true) @ estimated)


def relative_errors(estimated: FloatArray, true: FloatArray, pairs: NDArray[np.intp]) -> TransformErrors:
    """Return the RPE of poses, (N, 4, 4), over pairs of their rows, (K, 2)."""
    first, second = pairs.T
    motion, true_motion = (invert(poses[first]) @ poses[second] for poses in (estimated, true))
    return TransformErrors.of(invert(true_motion) @ motion)


def pairs_by_path(position_m: FloatArray, delta_m: float, *, all_pairs: bool) -> NDArray[np.intp]:
    """Return pairs of rows, (K, 2), that are ``delta_m`` apart along the path through positions, (N, 3).

    By default the pairs follow each other: each ends at the first position that is at least ``delta_m`` further, where the
    next begins. With ``all_pairs`` there is one for each row, with the row whose distance is closest, if within the tolerance.
    """
    steps_m = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
    if not all_pairs:
        return _consecutive(steps_m.tolist(), delta_m)
    path_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    return _closest(path_m, delta_m, PATH_TOLERANCE * delta_m)


def pairs_by_time(stamp_ns: NDArray[np.int64], delta_s: float) -> NDArray[np.intp]:
    """Return one pair, (K, 2), for each row with the row that is ``delta_s`` later, within the tolerance.

    evo has no such unit. Without a gap, it is the same as its ``--delta_unit f --all_pairs`` with the number of poses in that time.
    """
    time_s = (stamp_ns - stamp_ns[:1]) / 1e9
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else delta_s
    return _closest(time_s, delta_s, min(TIME_TOLERANCE * delta_s, STEP_TOLERANCE * step_s))


def _consecutive(steps_m: list[float], delta_m: float) -> NDArray[np.intp]:
    rows, since_m = [0], 0.0
    for row, step_m in enumerate(steps_m, start=1):
        since_m += step_m
        if since_m >= delta_m:
            rows.append(row)
            since_m = 0.0
    return np.stack([rows[:-1], rows[1:]], axis=1).astype(np.intp)


def _closest(place: FloatArray, delta: float, tolerance: float) -> NDArray[np.intp]:
    """Pair each row of ``place``, (N,), which does not decrease, with the later one closest to ``delta`` further; the first of equals."""
    rows = np.arange(len(place) - 1)
    after = np.clip(np.searchsorted(place, place[:-1] + delta), rows + 1, len(place) - 1)
    before = np.maximum(np.searchsorted(place, place[after - 1]), rows + 1)
    miss_after, miss_before = (np.abs(place[other] - place[:-1] - delta) for other in (after, before))
    chosen = np.where(miss_before <= miss_after, before, after)
    close = np.minimum(miss_before, miss_after) <= tolerance
    return np.stack([rows[close], chosen[close]], axis=1)


@dataclass(frozen=True, slots=True)
class RelativeErrors:
    """RPE over ``delta`` metres along the path, or seconds; ``pairs``: one after the other, or one for each pose."""

    delta: float
    unit: Literal["m", "s"]
    pairs: Literal["consecutive", "all"]
    errors: TransformErrors

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {"delta": self.delta, "unit": self.unit, "pairs": self.pairs, **self.errors.keys()}


RELATIVE_DELTAS_M = (1.0, 10.0)
RELATIVE_DELTA_S = 1.0


def relative_error_table(
    estimated: FloatArray, true: FloatArray, stamp_ns: NDArray[np.int64]
) -> tuple[RelativeErrors, ...]:
    """Return the RPE over the usual distances, with consecutive (evo's default) and all pairs, and over a second.

    ``estimated``, ``true``: poses, (N, 4, 4), at ``stamp_ns``, (N,), which increase. Pairs are chosen by the estimated path, as
    in evo.
    """
    if not len(estimated):
        return ()
    position_m = estimated[:, :3, 3]
    by_path = [
        RelativeErrors(
            delta_m,
            "m",
            "all" if all_pairs else "consecutive",
            relative_errors(estimated, true, pairs_by_path(position_m, delta_m, all_pairs=all_pairs)),
        )
        for delta_m in RELATIVE_DELTAS_M
        for all_pairs in (False, True)
    ]
    by_time = relative_errors(estimated, true, pairs_by_time(stamp_ns, RELATIVE_DELTA_S))
    return (*by_path, RelativeErrors(RELATIVE_DELTA_S, "s", "all", by_time))
