"""Poses as a file has them, and what reading repairs with a note: order, duplicates, rows without a pose, units of time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare import Estimate
from tsgt.errors import InputFileError
from tsgt.model import MAX_COORDINATE_M

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

MIN_POSES = 2

_SHORTEST, _LONGEST = 0.5, 2.0
"""Length of a written quaternion; outside, its columns are something else."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RawTrajectory:
    """M rows as written; NaN where a row has no such number."""

    stamp_ns: NDArray[np.int64]  # (M,)
    position_m: FloatArray  # (M, 3)
    orientation_xyzw: FloatArray | None  # (M, 4) of any length; zeros: unknown
    covariance: FloatArray | None = None  # (M, 6, 6) as in Estimate; NaN: unknown
    line: NDArray[np.int64] | None = None  # (M,) of the file
    notes: tuple[str, ...] = ()

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice, *notes: str) -> RawTrajectory:
        """Return some rows in the given order, with further notes."""
        return replace(
            self,
            stamp_ns=self.stamp_ns[rows],
            position_m=self.position_m[rows],
            orientation_xyzw=None if self.orientation_xyzw is None else self.orientation_xyzw[rows],
            covariance=None if self.covariance is None else self.covariance[rows],
            line=None if self.line is None else self.line[rows],
            notes=(*self.notes, *notes),
        )


def ordered(raw: RawTrajectory, path: Path) -> RawTrajectory:
    """Return the rows with a pose, sorted, each time once, quaternions of length one; each repair leaves a note.

    Raises InputFileError: fewer than two poses remain, or a quaternion is none.
    """
    raw = _with_pose(_unit(raw, path))
    if (np.diff(raw.stamp_ns) < 0).any():
        backwards = int((np.diff(raw.stamp_ns) < 0).sum())
        raw = raw.select(
            np.argsort(raw.stamp_ns, kind="stable"),
            f"times ran backwards {_times(backwards)}; the poses were sorted by time",
        )
    first = np.r_[True, np.diff(raw.stamp_ns) > 0][: len(raw.stamp_ns)]
    if not first.all():
        repeated = int((~first).sum())
        raw = raw.select(
            first, f"{_poses(repeated)} with the time of another left out; the first one was kept"
        )
    if len(raw.stamp_ns) < MIN_POSES:
        reasons = f" ({'; '.join(raw.notes)})" if raw.notes else ""
        raise InputFileError(f"holds fewer than two poses{reasons}", path=path)
    return raw


def estimate_of(raw: RawTrajectory, *, name: str, source: str, path: Path) -> Estimate:
    """Return an estimate from the rows of a file; raises InputFileError as :func:`ordered`."""
    raw = ordered(raw, path)
    orientation, notes = raw.orientation_xyzw, raw.notes
    if orientation is not None and (orientation == orientation[0]).all():
        orientation = None
        notes = (*notes, "the orientation never changes: positions alone are used")
    covariance = raw.covariance
    if covariance is not None and np.isnan(covariance[:, 0, 0]).all():
        covariance = None
    return Estimate(
        name=name,
        stamp_ns=raw.stamp_ns,
        position_m=raw.position_m,
        orientation_xyzw=orientation,
        covariance=covariance,
        source=source,
        notes=notes,
    )


def usable_covariance(covariance: FloatArray) -> FloatArray:
    """Return covariances as ROS messages have them, (M, 6, 6), NaN where unknown.

    All zero, -1 in the first entry, a negative variance or a number that is not finite say that it is unknown.
    """
    diagonal = np.diagonal(covariance, axis1=1, axis2=2)
    with np.errstate(invalid="ignore"):
        known: NDArray[np.bool_] = np.asarray(
            np.isfinite(covariance).all(axis=(1, 2))
            & (diagonal >= 0).all(axis=1)
            & (diagonal > 0).any(axis=1)
        )
    return np.where(known[:, None, None], 0.5 * (covariance + np.swapaxes(covariance, 1, 2)), np.nan)


def _unit(raw: RawTrajectory, path: Path) -> RawTrajectory:
    """Scale quaternions to length one; those of length zero become NaN."""
    if raw.orientation_xyzw is None:
        return raw
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        length: FloatArray = np.linalg.norm(raw.orientation_xyzw, axis=1)
        odd: NDArray[np.bool_] = np.asarray((length > 0.0) & ~((length >= _SHORTEST) & (length <= _LONGEST)))
        if odd.any():
            row = int(np.argmax(odd))
            raise InputFileError(
                f"the quaternion has length {length[row]:.3g} instead of 1: are the columns those of another format?",
                path=path,
                line=None if raw.line is None else int(raw.line[row]),
            )
        return replace(raw, orientation_xyzw=raw.orientation_xyzw / length[:, None])


def _with_pose(raw: RawTrajectory) -> RawTrajectory:
    with np.errstate(invalid="ignore"):
        near = np.abs(raw.position_m) <= MAX_COORDINATE_M
    finite = np.isfinite(raw.position_m).all(axis=1)
    if raw.orientation_xyzw is not None:
        finite &= np.isfinite(raw.orientation_xyzw).all(axis=1)
    used: NDArray[np.bool_] = finite & np.asarray(near.all(axis=1))
    notes = []
    if not finite.all():
        notes.append(
            f"{_poses(int((~finite).sum()))} without numbers (NaN, empty or zero quaternion) left out"
        )
    if (finite & ~used).any():
        far = int((finite & ~used).sum())
        notes.append(f"{_poses(far)} farther away than {MAX_COORDINATE_M:g} m left out")
    return raw.select(used, *notes) if notes else raw


def _poses(count: int) -> str:
    return f"{count} pose{'' if count == 1 else 's'}"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
