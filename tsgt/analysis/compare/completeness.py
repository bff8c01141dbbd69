"""How much of the time an estimate covers, and where it jumps or diverges. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.compare.errors import rotation_errors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.errors import ErrorSeries
    from tsgt.analysis.compare.pairing import PairedPoses
    from tsgt.analysis.compare.trajectories import ReferencePoses

GAP_INTERVALS, MIN_GAP_S = 3.0, 0.2
"""A gap of the estimate is longer than this many of its median intervals, and than this time."""

MAX_REFERENCE_STEP_S = (
    1.0  # A longer step between valid reference poses is not time that the reference covers
)

JUMP_FACTOR, MIN_JUMP_M, MIN_JUMP_RAD, JUMP_SIGMAS = 10.0, 0.05, np.radians(1.0), 5.0
"""A jump changes the error from one pose to the next by more than each of these: times the median change, absolute, and
sigmas of the reference."""

DIVERGENCE_M, DIVERGENCE_SHARE, DIVERGENCE_QUARTILES = 1.0, 0.05, 10.0
"""An estimate has diverged from the instant on after which its error remains above this distance plus this share of the path
driven, and above this many times the lower quartile of its errors."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Interval without poses of the estimate."""

    start_ns: int  # on the reference's clock
    duration_s: float


@dataclass(frozen=True, slots=True)
class Jump:
    """Sudden change of the error."""

    stamp_ns: int
    position_m: float
    rotation_rad: float  # NaN for positions alone


@dataclass(frozen=True, slots=True)
class Completeness:
    """Cover of the reference's valid time by an estimate."""

    share: float  # of the reference's valid time; 0 to 1
    reference_valid_s: float
    covered_s: float
    poses: int
    compared: int
    outside: int
    reference_gap: int
    reference_weak: int
    gaps: tuple[Gap, ...]
    jumps: tuple[Jump, ...]
    diverged_ns: int | None
    start_ns: int  # first pose that was compared

    @property
    def diverged_s(self) -> float | None:
        """Time of the divergence after the first pose that was compared; None without one."""
        return None if self.diverged_ns is None else (self.diverged_ns - self.start_ns) / 1e9

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {
            "share": self.share,
            "reference_valid_s": self.reference_valid_s,
            "covered_s": self.covered_s,
            "poses": self.poses,
            "compared": self.compared,
            "outside": self.outside,
            "reference_gap": self.reference_gap,
            "reference_weak": self.reference_weak,
            "gaps": [{"start_ns": each.start_ns, "duration_s": each.duration_s} for each in self.gaps],
            "jumps": [
                {
                    "stamp_ns": each.stamp_ns,
                    "position_mm": 1e3 * each.position_m,
                    "rotation_deg": float(np.degrees(each.rotation_rad)),
                }
                for each in self.jumps
            ],
            "diverged_ns": self.diverged_ns,
            "diverged_s": self.diverged_s,
        }


def completeness(
    reference: ReferencePoses, stamp_ns: NDArray[np.int64], pairs: PairedPoses, errors: ErrorSeries
) -> Completeness:
    """Assess an estimate with poses at ``stamp_ns``, (M,), on the reference's clock."""
    gaps = _gaps(stamp_ns)
    valid_s, covered_s = _cover(reference, stamp_ns, gaps)
    return Completeness(
        share=covered_s / valid_s if valid_s else 0.0,
        reference_valid_s=valid_s,
        covered_s=covered_s,
        poses=pairs.n_estimate,
        compared=len(pairs.row),
        outside=pairs.n_outside,
        reference_gap=pairs.n_reference_gap,
        reference_weak=pairs.n_reference_weak,
        gaps=tuple(
            Gap(int(stamp_ns[row]), int(stamp_ns[row + 1] - stamp_ns[row]) / 1e9) for row in gaps.tolist()
        ),
        jumps=_jumps(pairs, errors),
        diverged_ns=_divergence_ns(errors),
        start_ns=int(pairs.stamp_ns[0]) if len(pairs.stamp_ns) else 0,
    )


def _gaps(stamp_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the rows after which poses are missing."""
    steps_s = np.diff(stamp_ns) / 1e9
    if not len(steps_s):
        return np.empty(0, np.intp)
    return np.flatnonzero(steps_s > max(GAP_INTERVALS * float(np.median(steps_s)), MIN_GAP_S))


def _cover(
    reference: ReferencePoses, stamp_ns: NDArray[np.int64], gaps: NDArray[np.intp]
) -> tuple[float, float]:
    """Return the reference's valid time, and how much of it has an estimate, in s."""
    steps_s = np.diff(reference.stamp_ns) / 1e9
    both = reference.valid[1:] & reference.valid[:-1] & (steps_s <= MAX_REFERENCE_STEP_S)
    middle_ns = reference.stamp_ns[:-1] + np.diff(reference.stamp_ns) // 2
    before = np.searchsorted(stamp_ns, middle_ns, side="right") - 1
    covered = both & (before >= 0) & (before < len(stamp_ns) - 1) & ~np.isin(before, gaps)
    return float(steps_s[both].sum()), float(steps_s[covered].sum())


def _jumps(pairs: PairedPoses, errors: ErrorSeries) -> tuple[Jump, ...]:
    if len(pairs.stamp_ns) < 3:
        return ()
    # In the fixed axes of frame station1: those of travel turn.
    shift = pairs.estimated[:, :3, 3] - pairs.reference[:, :3, 3]
    turn = rotation_errors(pairs) if pairs.has_orientation else np.full_like(shift, np.nan)
    move_m, turn_rad = (np.linalg.norm(np.diff(each, axis=0), axis=1) for each in (shift, turn))
    jumped = np.zeros(len(move_m), dtype=np.bool_)
    for size, least, columns in ((move_m, MIN_JUMP_M, slice(0, 3)), (turn_rad, MIN_JUMP_RAD, slice(3, 6))):
        noise = np.nan_to_num(np.linalg.norm(errors.components.sigma[1:, columns], axis=1))
        limit = np.maximum(max(least, JUMP_FACTOR * float(np.median(size))), JUMP_SIGMAS * noise)
        jumped |= size > limit  # never of NaN
    jumped[_gaps(pairs.stamp_ns)] = False  # Drift during a gap is no jump
    return tuple(
        Jump(int(pairs.stamp_ns[row + 1]), float(move_m[row]), float(turn_rad[row]))
        for row in np.flatnonzero(jumped).tolist()
    )


def _divergence_ns(errors: ErrorSeries) -> int | None:
    """Return from when on the estimate has diverged; None: it has not."""
    if not len(errors.position_m):
        return None
    usual_m = DIVERGENCE_QUARTILES * float(np.quantile(errors.position_m, 0.25))
    limit_m = np.maximum(DIVERGENCE_M + DIVERGENCE_SHARE * errors.path_m, usual_m)
    within = np.flatnonzero(errors.position_m <= limit_m)
    first = int(within[-1]) + 1 if len(within) else 0
    return int(errors.stamp_ns[first]) if first < len(errors.stamp_ns) else None
