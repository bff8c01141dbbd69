"""Satellite receivers on a robot: how far the distances between them stray, beside those between its prisms.

Whatever the robot does, the distance between two receivers on it does not change, as that between two prisms. So the
same figure judges both systems, in the open and under trees (Vaidis et al., section IV-F).

From GPS time to UTC: GPS counts every second since 1980, UTC has had leap seconds put in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.formats import QUALITIES, SECOND_NS
from tsgt.analysis.gnss.leap_seconds import utc_from_gps
from tsgt.errors import InputFileError, MissingExtraError
from tsgt.geometry import interpolate

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.formats import PosFile, TimeSystem

JST_AHEAD_NS = 9 * 3600 * SECOND_NS

OUTAGE_LIMIT_NS = SECOND_NS
"""Between two positions further apart nobody knows where the second receiver was; as the paper has it for prisms."""

INSIDE_EARTH_M = 6.3e6
"""RTKLIB writes the centre of the Earth where it has no position yet; everything on the ground is above this."""

QUALITY_ORDER = (1, 2, 6, 4, 3, 5, 7, 0)
"""RTKLIB's Q in the order of what the positions are worth."""
_RANK = np.argsort(QUALITY_ORDER)


@dataclass(frozen=True, slots=True)
class Receiver:
    """One receiver's positions.

    Attributes
    ----------
    name
        What it is called in reports.
    path, time_system
        Its file, and what the times there are.
    times_ns
        (M,) Unix times in ns, strictly increasing.
    points_m
        (M, 3) east, north and up in m, in the local frame that all receivers share.
    quality
        (M,) RTKLIB's Q.
    satellites
        (M,) how many satellites each position is from.
    without_position
        How many epochs of the file hold none.
    """

    name: str
    path: Path
    time_system: TimeSystem
    times_ns: NDArray[np.int64]
    points_m: NDArray[np.float64]
    quality: NDArray[np.int64]
    satellites: NDArray[np.int64]
    without_position: int

    def between(self, start_ns: int, end_ns: int) -> Receiver:
        """Return the part within a span of time; epochs without a position remain those of the file."""
        inside = (self.times_ns >= start_ns) & (self.times_ns <= end_ns)
        columns = ("times_ns", "points_m", "quality", "satellites")
        return replace(self, **{name: getattr(self, name)[inside] for name in columns})


@dataclass(frozen=True, slots=True)
class DistanceErrorStatistics:
    """How far distances stray from what they should be, in mm; NaN without distances.

    Attributes
    ----------
    valid
        How many distances there are.
    mean_abs_error, std_abs_error, p95, max
        Mean, standard deviation (divisor n), 95th percentile and maximum of |distance - reference|.
    """

    valid: int
    mean_abs_error: float
    std_abs_error: float
    p95: float
    max: float

    @classmethod
    def of(cls, errors_m: NDArray[np.float64]) -> DistanceErrorStatistics:
        """Sum up (N,) absolute errors."""
        if not len(errors_m):
            return cls(0, math.nan, math.nan, math.nan, math.nan)
        errors = 1e3 * errors_m
        return cls(
            valid=len(errors),
            mean_abs_error=float(np.mean(errors)),
            std_abs_error=float(np.std(errors)),
            p95=float(np.percentile(errors, 95)),
            max=float(np.max(errors)),
        )


@dataclass(frozen=True, slots=True)
class DistanceSeries:
    """Distances over time between two receivers or two prisms.

    Attributes
    ----------
    name
        The pair as it is called in reports.
    times_ns
        (N,) Unix times in ns.
    distances_m
        (N,) distances in m.
    reference_m
        What they should be in m; NaN without any distance to tell.
    quality
        (N,) the worse Q of the positions that each is from; None of prisms.
    invalid_ns
        (K,) Unix times in ns of the epochs without a distance.
    """

    name: str
    times_ns: NDArray[np.int64]
    distances_m: NDArray[np.float64]
    reference_m: float
    quality: NDArray[np.int64] | None
    invalid_ns: NDArray[np.int64]

    @property
    def errors_m(self) -> NDArray[np.float64]:
        """(N,) |distance - reference| in m."""
        return np.abs(self.distances_m - self.reference_m)

    def by_quality(self) -> dict[int, NDArray[np.float64]]:
        """Errors in m by the worse Q, best first."""
        if self.quality is None:
            return {}
        errors_m = self.errors_m
        return {q: errors_m[self.quality == q] for q in QUALITY_ORDER if np.any(self.quality == q)}

    def between(self, start_ns: int, end_ns: int) -> DistanceSeries:
        """Return the part within a span of time."""
        inside = (self.times_ns >= start_ns) & (self.times_ns <= end_ns)
        return replace(
            self,
            times_ns=self.times_ns[inside],
            distances_m=self.distances_m[inside],
            quality=None if self.quality is None else self.quality[inside],
            invalid_ns=self.invalid_ns[(self.invalid_ns >= start_ns) & (self.invalid_ns <= end_ns)],
        )


def receivers(files: Sequence[PosFile]) -> tuple[Receiver, ...]:
    """Put receivers on one clock and into one local frame.

    Parameters
    ----------
    files
        One per receiver.

    Returns
    -------
    tuple of Receiver
        In the same order. The local frame is tangential to WGS84's ellipsoid at the first position of the first.

    Raises
    ------
    InputFileError
        A file holds no position at all.
    MissingExtraError
        pymap3d is not installed.
    """
    try:
        from pymap3d import ecef2enu, ecef2geodetic  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise MissingExtraError("GNSS files", library="pymap3d", extra="gnss") from error
    places = [_ecef_m(file) for file in files]
    usable = [
        (np.linalg.norm(place, axis=1) > INSIDE_EARTH_M) & (file.quality > 0)
        for file, place in zip(files, places, strict=True)
    ]
    for file, rows in zip(files, usable, strict=True):
        if not rows.any():
            raise InputFileError("RTKLIB found no position in any of its epochs", path=file.path)
    names = _names([file.path for file in files])
    origin = ecef2geodetic(*places[0][usable[0]][0], deg=False)
    found = []
    for name, file, place, rows in zip(names, files, places, usable, strict=True):
        found.append(
            Receiver(
                name=name,
                path=file.path,
                time_system=file.time_system,
                times_ns=unix_times_ns(file)[rows],
                points_m=np.column_stack(ecef2enu(*place[rows].T, *origin, deg=False)),
                quality=file.quality[rows],
                satellites=file.satellites[rows],
                without_position=int(np.sum(~rows)),
            )
        )
    return tuple(found)


def _names(paths: Sequence[Path]) -> list[str]:
    """Name files as shortly as they can be told apart."""
    for names in (
        [path.stem for path in paths],
        [f"{path.absolute().parent.name}/{path.stem}" for path in paths],
    ):
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in paths]


def unix_times_ns(file: PosFile) -> NDArray[np.int64]:
    """Convert a file's times to Unix time in ns, (M,)."""
    match file.time_system:
        case "GPST":
            return utc_from_gps(file.times_ns)
        case "UTC":
            return file.times_ns
        case "JST":
            return file.times_ns - JST_AHEAD_NS


def _ecef_m(file: PosFile) -> NDArray[np.float64]:
    """Return Earth-fixed coordinates in m, (M, 3)."""
    from pymap3d import enu2ecef, geodetic2ecef  # noqa: PLC0415 (an extra)

    match file.coordinates:
        case "ecef":
            return file.positions
        case "geodetic":
            return np.column_stack(geodetic2ecef(*file.positions.T, deg=False))
        case "baseline":
            assert file.base is not None  # noqa: S101 (the reader sees to it)
            return np.column_stack(enu2ecef(*file.positions.T, *file.base, deg=False))


def receiver_distances(
    found: Sequence[Receiver], references_m: Sequence[float] | None = None
) -> tuple[DistanceSeries, ...]:
    """Measure the distances between all receivers over time.

    The second receiver of a pair is interpolated by a straight line to the epochs of the first: clocks of cheap
    receivers drift, so that theirs lie some milliseconds apart.

    Parameters
    ----------
    found
        As :func:`receivers` returns them.
    references_m
        What the distances should be in m, for the pairs 1-2, 1-3, ..., 2-3, ...; None: the median of those from fixed
        positions (Q = 1), or of all if none is. A median cannot show an error that is always there.

    Returns
    -------
    tuple of Distances
        One per pair. Epochs of the first receiver outside the time of the second, and those between two of its
        positions more than 1 s apart, are counted as invalid.
    """
    pairs = []
    for number, (a, b) in enumerate(combinations(found, 2)):
        at_epochs = interpolate(b.times_ns, b.points_m, a.times_ns, OUTAGE_LIMIT_NS)
        # Where both have the same epochs nothing is interpolated, and no neighbour can be too far away.
        same, after = np.isin(a.times_ns, b.times_ns), np.searchsorted(b.times_ns, a.times_ns)
        valid = at_epochs.valid | same
        points_m = at_epochs.points.copy()
        points_m[same] = b.points_m[after[same]]
        after = after[valid]
        before = np.where(same[valid], after, after - 1)
        distances_m = np.linalg.norm(a.points_m[valid] - points_m[valid], axis=1)
        ranks = [_RANK[a.quality[valid]], _RANK[b.quality[before]], _RANK[b.quality[after]]]
        quality = np.array(QUALITY_ORDER)[np.max(ranks, axis=0)]
        reference_m = _median(distances_m, quality) if references_m is None else references_m[number]
        pairs.append(
            DistanceSeries(
                name=f"{a.name}-{b.name}",
                times_ns=a.times_ns[valid],
                distances_m=distances_m,
                reference_m=reference_m,
                quality=quality,
                invalid_ns=a.times_ns[~valid],
            )
        )
    return tuple(pairs)


def _median(distances_m: NDArray[np.float64], quality: NDArray[np.int64]) -> float:
    fixed = distances_m[quality == 1]
    best = fixed if len(fixed) else distances_m
    return float(np.median(best)) if len(best) else math.nan


def quality_shares(receiver: Receiver) -> dict[str, float]:
    """Tell which share of a receiver's positions has which quality, best first."""
    counts = {QUALITIES[q]: int(np.sum(receiver.quality == q)) for q in QUALITY_ORDER}
    return {name: count / len(receiver.quality) for name, count in counts.items() if count}
