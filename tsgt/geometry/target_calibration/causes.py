"""Causes of a misfit of target measurements: instrument errors, wrong sights of targets, a tripod that moved.

A *sight* is all readings of one target by one station. The causes that the readings support are selected together, so that
an index error is not taken for bad far targets nor the reverse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.target_calibration.cause_search import CauseSearch, exchanged
from tsgt.geometry.target_calibration.network import (
    ERRORS,
    TARGET_CONSTANT,
    InstrumentError,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.target_calibration.cause_search import Subset
    from tsgt.geometry.target_calibration.network import Linearisation, TargetReadings


class CauseKind(StrEnum):
    """What a cause is."""

    INSTRUMENT = "instrument"
    TARGET_CONSTANT = "target_constant"  # Of all stations alike
    SIGHT = "sight"
    TRIPOD = "tripod"  # Moved between two of a station's sights
    TILT = "tilt"  # Of a station that is taken as levelled


NOISE_SCALE_PENALTY = 10.0  # By how much an unknown noise scale must lower twice the negative log-likelihood
MIN_NOISE_SCALE = 1.1  # Without any cause; below, a larger noise explains nothing
MAX_NOISE_ROUNDS = 6
NOISE_SCALE_TOLERANCE = 0.05
MAX_SIGHTS = 60  # Candidates; of a larger set those with the largest residuals
ODDS: dict[CauseKind, float] = {
    CauseKind.INSTRUMENT: 4.0,
    CauseKind.TARGET_CONSTANT: 6.0,
    CauseKind.SIGHT: 10.0,
    CauseKind.TRIPOD: 18.0,
    CauseKind.TILT: 6.0,
}
"""Twice the negative logarithm of the odds: one in 7 for an instrument outside its data sheet, one in 150 for a wrong sight, one in
8000 for a tripod that moves between two given sights, of which there are some fifty. Of several wrong sights of a station only the first counts."""
PENALTIES: dict[CauseKind, float] = {
    CauseKind.INSTRUMENT: 8.0,
    CauseKind.TARGET_CONSTANT: 8.0,
    CauseKind.SIGHT: 12.0,
    CauseKind.TRIPOD: 16.0,
    CauseKind.TILT: 8.0,
}
"""By how much the unknowns of a cause must lower twice the negative log-likelihood, beside the odds: four for each unknown, as many
causes are tried, and eight at least."""
LARGEST_ERROR = {
    InstrumentError.VERTICAL_INDEX: 2e-3,
    InstrumentError.COLLIMATION: 2e-3,
    InstrumentError.RANGE_SCALE: 3e-4,
    InstrumentError.RANGE_CONSTANT: 0.05,
}
"""Beyond, something else is wrong: 2 mrad are 7 arcminutes, 300 ppm an atmosphere of 300 degrees, 50 mm more than any two
reflectors differ."""
MIN_BLUNDER_M = 0.010
"""Smallest displacement of a sight that is rejected: a constant wrong by 10 mm moves single targets of the authors' sets by as much."""
MIN_FURTHER_BLUNDER_M = 0.006  # Of a sight beside a larger one of the same station
MIN_TARGETS_PER_ROUND = 3  # Before and after a tripod moved, to tell it from wrong sights


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """One possible cause, and its size if it was selected."""

    kind: CauseKind
    station: int  # Row; 0 if it concerns all
    target: int | None = None  # Row; of a tripod the first one measured after it moved
    error: InstrumentError | None = None
    # Only two stations measured the target: which of them is wrong cannot be seen
    either_station: bool = False
    # INSTRUMENT: (1,) its value beyond what the data sheet explains; TARGET_CONSTANT: (1,) m; SIGHT: (3,) displacement in the first station's frame in m;
    # TRIPOD: (4,) displacement in m and heading in rad; TILT: (2,) rad
    value: FloatArray | None = None
    alternatives: tuple[Cause, ...] = ()  # Causes that the readings do not exclude in its place

    @property
    def label(self) -> tuple[CauseKind, int, int | None, InstrumentError | None]:
        """What identifies it."""
        return self.kind, self.station, self.target, self.error

    @property
    def size_m(self) -> float:
        """Length of a displacement."""
        assert self.value is not None  # noqa: S101 (of selected causes)
        return float(np.linalg.norm(self.value[:3]))


@dataclass(frozen=True, slots=True)
class SelectionRules:
    """What may be selected.

    ``blunder_m``: smallest displacement of a sight, ``further_m``: beside a larger one of the same station; ``levelled``: look
    for tilts.
    """

    blunder_m: float
    further_m: float
    levelled: bool


def max_rejected(targets: int) -> int:
    """Most targets of a station that may be rejected: at least four remain, and most of all."""
    return max((targets - 3) // 2, 0)


class _Selection(NamedTuple):
    causes: tuple[Cause, ...]
    cost: float  # Twice the negative log-likelihood, penalised, up to a constant
    noise_scale: float  # Factor on the assumed noise that the residuals show


def select_causes(
    readings: TargetReadings, linear: Linearisation, rules: SelectionRules
) -> tuple[Cause, ...]:
    """Select the causes that explain the misfit of a linearisation without any of them.

    The noise is as stated or, at a price, of unknown scale: noise larger than stated is not taken for many causes.
    """
    stated = _selected(readings, linear, rules)
    redundancy = max(linear.redundancy, 1)
    scale = float(np.sqrt(np.sum(linear.y * linear.project(linear.y[:, :, None])[:, :, 0]) / redundancy))
    if scale < MIN_NOISE_SCALE:
        return stated.causes
    # From above: with too little noise anything is significant.
    for _ in range(MAX_NOISE_ROUNDS):
        scaled = _selected(readings, linear.with_noise(scale), rules)
        if abs(scaled.noise_scale - 1.0) < NOISE_SCALE_TOLERANCE:
            break
        scale = max(scale * scaled.noise_scale, 1.0)
    cost = scaled.cost + 2.0 * redundancy * math.log(scale) + NOISE_SCALE_PENALTY
    return scaled.causes if cost < stated.cost else stated.causes


def _selected(readings: TargetReadings, linear: Linearisation, rules: SelectionRules) -> _Selection:
    """Causes with the noise of a linearisation."""
    candidates = _candidates(readings, linear, rules)
    while True:
        columns = np.concatenate([columns for _, columns, _ in candidates], axis=2)
        residuals = linear.project(linear.y[:, :, None])[:, :, 0]
        ends = np.cumsum([0, *(each.shape[2] for _, each, _ in candidates)])
        causes = [cause for cause, _, _ in candidates]
        search = CauseSearch(
            columns.reshape(-1, columns.shape[2]),
            linear.project(columns).reshape(-1, columns.shape[2]),
            residuals.ravel(),
            chi_squared=float(np.sum(linear.y * residuals)),
            blocks=[range(a, b) for a, b in pairwise(ends)],
            penalties=np.array([penalty for _, _, penalty in candidates]),
            odds=np.array([ODDS[cause.kind] for cause in causes]),
            groups=np.array(
                [cause.station if cause.kind is CauseKind.SIGHT else -1 for cause in causes], np.intp
            ),
            allowed=lambda subset, causes=causes: _is_possible([causes[row] for row in subset]),  # type: ignore[misc]
        )
        chosen = search.best()
        values = search.estimates(chosen)
        implausible = _implausible({row: causes[row] for row in chosen}, values, rules)
        if not implausible:
            break
        candidates = [each for row, each in enumerate(candidates) if row not in implausible]
    alternatives = search.alternatives(chosen)
    preferable = next((each for each in alternatives if _is_preferable(readings, causes, *each)), None)
    if preferable is not None:
        chosen = exchanged(chosen, *preferable)
        values = search.estimates(chosen)
        alternatives = search.alternatives(chosen)

    def is_possible(old: Subset, new: Subset) -> bool:
        subset = exchanged(chosen, old, new)
        if not _is_possible([causes[each] for each in subset]):
            return False
        implausible = _implausible({each: causes[each] for each in subset}, search.estimates(subset), rules)
        return not implausible & set(new)

    possible: dict[int, dict[int, None]] = {row: {} for row in chosen}
    for old, new in alternatives:
        if is_possible(old, new):
            for row in old:
                possible[row] |= dict.fromkeys(new)
    found = tuple(
        replace(
            causes[row],
            value=values[row][: ends[row + 1] - ends[row]],
            alternatives=tuple(causes[other] for other in possible[row]),
        )
        for row in chosen
    )
    misfit = float(search.misfits(np.array([chosen], np.intp))[0])
    freedom = linear.redundancy - sum(int(ends[row + 1] - ends[row]) for row in chosen)
    return _Selection(found, float(search.costs([chosen])[0]), math.sqrt(misfit / max(freedom, 1)))


def _is_preferable(readings: TargetReadings, causes: Sequence[Cause], old: Subset, new: Subset) -> bool:
    """Whether one chosen cause is better replaced by others that the readings do not tell from it.

    By a tilt an instrument error, as a tilt fails a check where the error would be applied. A tripod that moved by wrong sights, which
    are more frequent; of two sights those measured before it moved, without which the frame is right either way.
    """
    (cause, *more), others = [causes[row] for row in old], [causes[row] for row in new]
    if more:
        return False
    if cause.kind is CauseKind.INSTRUMENT:
        return [other.kind for other in others] == [CauseKind.TILT]
    if cause.kind is not CauseKind.TRIPOD or any(
        other.kind is not CauseKind.SIGHT or other.station != cause.station for other in others
    ):
        return False
    own = readings.target[readings.station == cause.station].tolist()
    return len(others) == 1 or all(own.index(other.target) < own.index(cause.target) for other in others)


_Candidate = tuple[Cause, "FloatArray", float]  # Cause, columns (n, 3, c), penalty


def _candidates(readings: TargetReadings, linear: Linearisation, rules: SelectionRules) -> list[_Candidate]:
    stations = range(len(readings.stations))
    instruments = [
        (Cause(CauseKind.INSTRUMENT, station, error=error), linear.columns(((station, 6 + row),)))
        for station in stations
        for row, error in enumerate(ERRORS)
    ]
    instruments.append((Cause(CauseKind.TARGET_CONSTANT, 0), linear.columns((TARGET_CONSTANT,))))
    sights = _sights(readings, linear)
    tripods = _tripods(readings, linear)
    tilts = (
        [
            (Cause(CauseKind.TILT, station), linear.columns(((station, 3), (station, 4))))
            for station in stations[1:]
        ]
        if rules.levelled
        else []
    )
    return [
        (cause, columns, PENALTIES[cause.kind])
        for cause, columns in (*instruments, *sights, *tripods, *tilts)
    ]


def _sights(readings: TargetReadings, linear: Linearisation) -> list[tuple[Cause, FloatArray]]:
    """Displacements of targets as measured by one station."""
    residuals = np.sum(linear.project(linear.y[:, :, None]) ** 2, axis=(1, 2))
    found = []
    for target in range(len(readings.targets)):
        of_target = readings.target == target
        measured_by = np.unique(readings.station[of_target])
        either = len(measured_by) == 2
        for station in measured_by[1:] if either else measured_by:
            rows = of_target & (readings.station == station)
            if len(measured_by) > 1:
                cause = Cause(CauseKind.SIGHT, int(station), target, either_station=either)
                found.append((float(residuals[rows].sum()), cause, rows))
    found.sort(key=lambda each: -each[0])
    return [(cause, linear.B * rows[:, None, None]) for _, cause, rows in found[:MAX_SIGHTS]]


def _tripods(readings: TargetReadings, linear: Linearisation) -> list[tuple[Cause, FloatArray]]:
    """Displacements and turns of a station after some of its readings, in their order."""
    found = []
    for station in range(len(readings.stations)):
        own = np.flatnonzero(readings.station == station)
        splits = 0
        for place in range(1, len(own)):
            before, after = own[:place], own[place:]
            if readings.target[before[-1]] == readings.target[after[0]]:
                continue
            sizes = [len(np.unique(readings.target[rows])) for rows in (before, after)]
            if min(sizes) < MIN_TARGETS_PER_ROUND or splits >= MAX_SIGHTS // 3:
                continue
            splits += 1
            later = np.zeros(len(readings.station), dtype=bool)
            later[after] = True
            cause = Cause(CauseKind.TRIPOD, station, int(readings.target[after[0]]))
            pose = tuple((station, component) for component in (0, 1, 2, 5))
            found.append((cause, linear.columns(pose) * later[:, None, None]))
    return found


def _implausible(
    chosen: Mapping[int, Cause], values: Mapping[int, FloatArray], rules: SelectionRules
) -> set[int]:
    """Chosen causes whose size makes no sense."""
    sizes = {row: float(np.linalg.norm(values[row][:3])) for row in chosen}
    blundered = {
        cause.station
        for row, cause in chosen.items()
        if cause.kind is CauseKind.SIGHT and sizes[row] >= rules.blunder_m
    }

    def is_plausible(row: int, cause: Cause) -> bool:
        if cause.kind is CauseKind.SIGHT:
            return sizes[row] >= (rules.further_m if cause.station in blundered else rules.blunder_m)
        if cause.kind is CauseKind.TARGET_CONSTANT:
            return sizes[row] <= LARGEST_ERROR[InstrumentError.RANGE_CONSTANT]
        return cause.error is None or sizes[row] <= LARGEST_ERROR[cause.error]

    return {row for row, cause in chosen.items() if not is_plausible(row, cause)}


def _is_possible(causes: Sequence[Cause]) -> bool:
    """No instrument error twice, and no tripod that moved twice."""
    once = [
        (cause.kind, cause.station, cause.error)
        for cause in causes
        if cause.kind in (CauseKind.INSTRUMENT, CauseKind.TRIPOD)
    ]
    return len(set(once)) == len(once)


def outvoted(readings: TargetReadings, causes: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return the causes without the sights of stations of which too many targets are wrong to reject them."""
    refused: set[int] = set()
    for station in range(1, len(readings.stations)):
        of_first, of_other = (set(readings.target[readings.station == row].tolist()) for row in (0, station))
        rejected = rejected_targets(causes, station)
        if len(rejected) > max_rejected(len(of_first & of_other)):
            refused |= rejected
    return tuple(
        cause for cause in causes if cause.kind is not CauseKind.SIGHT or cause.target not in refused
    )


def rejected_targets(causes: Collection[Cause], station: int) -> set[int]:
    """Return the rows of the targets that a station, or the first one, measured wrong."""
    return {
        cause.target
        for cause in causes
        if cause.kind is CauseKind.SIGHT and cause.station in (0, station) and cause.target is not None
    }


def rejected_readings(readings: TargetReadings, causes: Collection[Cause]) -> NDArray[np.bool_]:
    """Rows of the readings that causes of kind SIGHT leave out."""
    rejected = np.zeros(len(readings.station), dtype=bool)
    for cause in causes:
        if cause.kind is CauseKind.SIGHT:
            of_target = readings.target == cause.target
            rejected |= of_target if cause.either_station else of_target & (readings.station == cause.station)
    return rejected
