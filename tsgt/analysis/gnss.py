"""Distances over time between GNSS receivers on a robot, and between its prisms for comparison.

The distance between two receivers on a rigid robot is constant, as that between two prisms: the same figure rates both
systems, in the open and under trees (Vaidis et al. 2021, section IV-F).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import distances_at_epochs
from tsgt.analysis.formats import QUALITIES, SECOND_NS
from tsgt.analysis.text_file import utf8_name
from tsgt.errors import InputFileError, MissingExtraError, RecordingError
from tsgt.geometry import interpolate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.formats import PosFile, TimeSystem
    from tsgt.estimation import Track
    from tsgt.model import Parameters

JST_OFFSET_NS = 9 * 3600 * SECOND_NS

OUTAGE_LIMIT_NS = SECOND_NS  # No interpolation across more, as the paper does for prisms
INSIDE_EARTH_M = 6.3e6  # From the Earth's centre; RTKLIB writes the centre itself without a solution
QUALITY_ORDER = (1, 2, 6, 4, 3, 5, 7, 0)  # RTKLIB's Q, best first
_RANK = np.argsort(QUALITY_ORDER)

# GPS - UTC grew by 1 s at the beginning of each of these months: IERS Bulletin C. None has been announced since 2017.
_LEAP_SECONDS = (
    "1981-07 1982-07 1983-07 1985-07 1988-01 1990-01 1991-01 1992-07 1993-07 "
    "1994-07 1996-01 1997-07 1999-01 2006-01 2009-01 2012-07 2015-07 2017-01"
)
_MONTHS_S = np.array(_LEAP_SECONDS.split(), dtype="datetime64[s]").astype(np.int64)
_FROM_GPS_NS = (_MONTHS_S + np.arange(1, len(_MONTHS_S) + 1)) * SECOND_NS


@dataclass(frozen=True, slots=True)
class Receiver:
    """Positions of one receiver at M Unix times, strictly increasing.

    ``points_m``: (M, 3) east, north and up in the local frame common to all receivers. ``quality``: (M,) RTKLIB's Q.
    ``satellites``: (M,). ``without_position``: number of epochs in the file without a position.
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
        """Return the part within a time interval; ``without_position`` remains that of the file."""
        inside = (self.times_ns >= start_ns) & (self.times_ns <= end_ns)
        columns = ("times_ns", "points_m", "quality", "satellites")
        return replace(self, **{name: getattr(self, name)[inside] for name in columns})


@dataclass(frozen=True, slots=True)
class DistanceErrorStatistics:
    """Statistics of |distance - reference| in mm; NaN without distances. The standard deviation has divisor n."""

    valid: int
    mean_abs_error: float
    std_abs_error: float
    p95: float
    max: float

    @classmethod
    def of(cls, errors_m: NDArray[np.float64]) -> DistanceErrorStatistics:
        """Summarise (N,) absolute errors."""
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
    """Distances over time between two receivers or two prisms, with the name of the pair in reports.

    ``times_ns``, ``distances_m``: (N,) Unix times and distances. ``reference_m``: true distance; NaN if unknown. ``quality``: (N,)
    the worse Q of the two positions; None for prisms. ``invalid_ns``: (K,) Unix times of epochs without a distance.
    """

    name: str
    times_ns: NDArray[np.int64]
    distances_m: NDArray[np.float64]
    reference_m: float
    quality: NDArray[np.int64] | None
    invalid_ns: NDArray[np.int64]

    @property
    def errors_m(self) -> NDArray[np.float64]:
        """(N,) |distance - reference|."""
        return np.abs(self.distances_m - self.reference_m)

    def by_quality(self) -> dict[int, NDArray[np.float64]]:
        """Return the errors in m by Q, best first."""
        if self.quality is None:
            return {}
        errors_m = self.errors_m
        return {q: errors_m[self.quality == q] for q in QUALITY_ORDER if np.any(self.quality == q)}

    def between(self, start_ns: int, end_ns: int) -> DistanceSeries:
        """Return the part within a time interval."""
        inside = (self.times_ns >= start_ns) & (self.times_ns <= end_ns)
        return replace(
            self,
            times_ns=self.times_ns[inside],
            distances_m=self.distances_m[inside],
            quality=None if self.quality is None else self.quality[inside],
            invalid_ns=self.invalid_ns[(self.invalid_ns >= start_ns) & (self.invalid_ns <= end_ns)],
        )


def utc_from_gps(gps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert GPS time, (N,) ns from 1970-01-01 00:00:00 on the calendar of GPS time, to Unix time in ns.

    Unix time cannot represent a leap second: during one it runs through the first second of the new day, which then repeats.
    """
    return gps_ns - np.searchsorted(_FROM_GPS_NS, gps_ns, side="right").astype(np.int64) * SECOND_NS


def receivers(files: Sequence[PosFile]) -> tuple[Receiver, ...]:
    """Convert solutions to Unix time and one local frame, tangential to the WGS84 ellipsoid at the first position of the first.

    Raises InputFileError if a file contains no position at all, MissingExtraError if pymap3d is not installed.
    """
    try:
        from pymap3d import ecef2enu, ecef2geodetic  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise MissingExtraError("GNSS files", library="pymap3d", extra="gnss") from error
    positions_m = [_ecef_m(file) for file in files]
    usable = [
        (np.linalg.norm(position, axis=1) > INSIDE_EARTH_M) & (file.quality > 0)
        for file, position in zip(files, positions_m, strict=True)
    ]
    for file, rows in zip(files, usable, strict=True):
        if not rows.any():
            raise InputFileError("contains no valid position in any epoch", path=file.path)
    names = _names([file.path for file in files])
    origin = ecef2geodetic(*positions_m[0][usable[0]][0], deg=False)
    return tuple(
        Receiver(
            name=name,
            path=file.path,
            time_system=file.time_system,
            times_ns=unix_times_ns(file)[rows],
            points_m=np.column_stack(ecef2enu(*position[rows].T, *origin, deg=False)),
            quality=file.quality[rows],
            satellites=file.satellites[rows],
            without_position=int(np.sum(~rows)),
        )
        for name, file, position, rows in zip(names, files, positions_m, usable, strict=True)
    )


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the shortest names that distinguish the files."""
    for names in (
        [utf8_name(path.stem) for path in paths],
        [utf8_name(f"{path.absolute().parent.name}/{path.stem}") for path in paths],
    ):
        if len(set(names)) == len(names):
            return names
    return [utf8_name(str(path)) for path in paths]


def unix_times_ns(file: PosFile) -> NDArray[np.int64]:
    """Convert a file's times to Unix time in ns, (M,)."""
    match file.time_system:
        case "GPST":
            return utc_from_gps(file.times_ns)
        case "UTC":
            return file.times_ns
        case "JST":
            return file.times_ns - JST_OFFSET_NS


def _ecef_m(file: PosFile) -> NDArray[np.float64]:
    """Return Earth-centred, Earth-fixed coordinates, (M, 3)."""
    from pymap3d import enu2ecef, geodetic2ecef  # noqa: PLC0415 (an extra)

    match file.coordinates:
        case "ecef":
            return file.positions
        case "geodetic":
            return np.column_stack(geodetic2ecef(*file.positions.T, deg=False))
        case "baseline":
            assert file.base is not None  # noqa: S101 (read_pos ensures it)
            return np.column_stack(enu2ecef(*file.positions.T, *file.base, deg=False))


def receiver_distances(
    found: Sequence[Receiver], references_m: Sequence[float] | None = None
) -> tuple[DistanceSeries, ...]:
    """Measure the distances between all receivers over time, one series per pair.

    The second receiver of a pair is interpolated linearly to the epochs of the first, because the clocks of low-cost
    receivers differ by some milliseconds; invalid are epochs outside its time or between positions more than 1 s apart. The
    references are for the pairs 1-2, 1-3, ..., 2-3, ...; without them the median of the distances from fixed positions (Q =
    1), or of all without fixed ones, which hides constant errors.
    """
    pairs = []
    for number, (a, b) in enumerate(combinations(found, 2)):
        at_epochs = interpolate(b.times_ns, b.points_m, a.times_ns, OUTAGE_LIMIT_NS)
        # Common epochs are not interpolated and therefore valid next to an outage too.
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
    """Return the share of each quality among a receiver's positions, best first."""
    counts = {QUALITIES[q]: int(np.sum(receiver.quality == q)) for q in QUALITY_ORDER}
    return {name: count / len(receiver.quality) for name, count in counts.items() if count}


def prism_distances(
    parameters: Parameters, tracks: Mapping[int, Track], path: Path
) -> tuple[DistanceSeries, ...]:
    """Measure the distances between all prisms over time, as ``tsgt evaluate`` does: at 20 Hz, all pairs or none.

    ``tracks``: one per prism, in frame ``station1``. Raises RecordingError if a prism was not measured or there is only one.
    """
    missing = [prism.prism for prism in parameters.prisms if not len(tracks[prism.prism])]
    if missing or len(parameters.prisms) < 2:
        reason = f"prism {missing[0]} was not measured" if missing else "it has one prism only"
        raise RecordingError(f"no distances between prisms: {reason}", path=path)
    found = distances_at_epochs(parameters, tracks)
    return tuple(
        DistanceSeries(
            name=f"{a}-{b}",
            times_ns=found.stamp_ns[found.valid],
            distances_m=distances_m[found.valid],
            reference_m=found.references_m[a, b],
            quality=None,
            invalid_ns=found.stamp_ns[~found.valid],
        )
        for (a, b), distances_m in found.distances_m.items()
    )


def common_interval(
    gnss: Sequence[DistanceSeries], prisms: Sequence[DistanceSeries], path: Path
) -> tuple[tuple[DistanceSeries, ...], tuple[DistanceSeries, ...]]:
    """Cut distances between receivers and between prisms to their common time. Raises RecordingError if there is none."""
    gnss_span, prism_span = time_span(gnss), time_span(prisms)
    if gnss_span is None or prism_span is None:
        which = "receivers" if gnss_span is None else "prisms"
        raise RecordingError(f"nothing to compare: there are no distances between {which}", path=path)
    start_ns, end_ns = max(gnss_span[0], prism_span[0]), min(gnss_span[1], prism_span[1])
    if start_ns > end_ns:
        late = prism_span[0] > gnss_span[1]
        raise RecordingError(
            f"its distances {'begin' if late else 'end'} {(start_ns - end_ns) / 1e9:.1f} s "
            f"{'after the end' if late else 'before the start'} of the receivers'; was the master's clock right?",
            path=path,
        )
    both = tuple(tuple(pair.between(start_ns, end_ns) for pair in pairs) for pairs in (gnss, prisms))
    if None in map(time_span, both):
        raise RecordingError(
            "while its prisms were measured the receivers had no common positions", path=path
        )
    return both[0], both[1]


def time_span(pairs: Sequence[DistanceSeries]) -> tuple[int, int] | None:
    """Return the first and the last time of any distance; None without one."""
    times = np.concatenate([np.empty(0, np.int64), *(pair.times_ns for pair in pairs)])
    return (int(times.min()), int(times.max())) if len(times) else None
