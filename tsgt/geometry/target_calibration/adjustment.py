"""Station frames from targets: the joint solution, the causes of a misfit, and an uncertainty that includes the misfit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from tsgt.errors import DegenerateGeometryError
from tsgt.geometry.polar import measurement_covariance
from tsgt.geometry.target_calibration.causes import (
    MIN_BLUNDER_M,
    MIN_FURTHER_BLUNDER_M,
    Cause,
    CauseKind,
    SelectionRules,
    outvoted,
    rejected_readings,
    select_causes,
)
from tsgt.geometry.target_calibration.frame_fit import PointPairs, PointSet
from tsgt.geometry.target_calibration.initialisation import robust_frame
from tsgt.geometry.target_calibration.network import (
    DATA_SHEET_SIGMA,
    ERRORS,
    LEVELLED_COLUMNS,
    POSE_COLUMNS,
    TARGET_CONSTANT,
    InstrumentError,
    Linearisation,
    Network,
    linearise,
    solve,
)
from tsgt.geometry.target_calibration.prisms import MIN_POINTS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.target_calibration.network import Column, TargetReadings
    from tsgt.model import InstrumentNoise

MISFIT_LEVEL = 0.01  # Probability of a misfit by chance below which covariances are scaled by it
MAX_ROUNDS = 4  # Of selecting causes and solving with them


@dataclass(frozen=True, slots=True)
class FitQuality:
    """Squared normalised residuals of some readings."""

    chi_squared: float
    redundancy: float  # Degrees of freedom; of a part of the readings the sum of their redundancy numbers

    @property
    def p_value(self) -> float:
        """Probability of at least this misfit by chance."""
        return float(chdtrc(self.redundancy, self.chi_squared)) if self.redundancy > 0 else 1.0

    @property
    def noise_scale(self) -> float:
        """Factor on the stated noise that the residuals show."""
        return float(np.sqrt(self.chi_squared / self.redundancy)) if self.redundancy > 0 else 1.0


@dataclass(frozen=True, slots=True)
class ErrorEstimate:
    """An instrument error: estimated with the data sheet's sigma as prior; without, if it is a selected cause."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class NetworkCalibration:
    """Joint solution of all stations' targets."""

    readings: TargetReadings
    kept: NDArray[np.bool_]  # (n,) readings that the solution uses
    network: Network
    linear: Linearisation  # Of the kept readings, at the solution
    # Columns of ``covariance``: poses of the stations but the first, then all instrument errors
    columns: tuple[Column, ...]
    covariance: FloatArray  # Scaled by the misfit where that is significant, and with the errors that are not estimated
    scale: float  # Factor on the sigmas of the noise; 1 where the misfit is not significant
    causes: tuple[Cause, ...]  # Selected; sights among them are rejected, instrument errors estimated
    suspects: tuple[Cause, ...]  # What would explain the rest, if more or smaller errors were accepted
    errors: dict[tuple[int, InstrumentError], ErrorEstimate]  # By row of the station
    overall: FitQuality
    by_station: tuple[FitQuality, ...]
    by_component: tuple[FitQuality, FitQuality, FitQuality]  # Along, horizontally and vertically across
    levelled: bool
    max_residual_m: float | None  # As requested

    @property
    def unidentified(self) -> tuple[Cause, ...]:
        """Selected sights for which the readings do not exclude another target or an instrument error, and the reverse."""
        return tuple(
            cause
            for cause in self.causes
            if (cause.kind is CauseKind.SIGHT and any(_differs(cause, other) for other in cause.alternatives))
            or (
                cause.kind in (CauseKind.INSTRUMENT, CauseKind.TARGET_CONSTANT)
                and any(other.kind is CauseKind.SIGHT for other in cause.alternatives)
            )
        )


def calibrate_network(
    readings: TargetReadings,
    noise: InstrumentNoise,
    *,
    levelled: bool = False,
    max_residual_m: float | None = None,
) -> NetworkCalibration:
    """Solve all station frames from targets that each station has in common with the first.

    ``max_residual_m``: leave out further sights, the worst first, until no residual is larger. Raises
    DegenerateGeometryError if a station has fewer than three targets in common with the first, or they lie in a line
    (levelled: above one another).
    """
    start = _start(readings, noise, levelled=levelled)
    components = LEVELLED_COLUMNS if levelled else POSE_COLUMNS
    rows = range(len(readings.stations))
    known = {(row, c): np.inf for row in rows[1:] for c in components}
    known |= {(row, 6 + c): DATA_SHEET_SIGMA[error] for row in rows for c, error in enumerate(ERRORS)}
    rules = SelectionRules(MIN_BLUNDER_M, MIN_FURTHER_BLUNDER_M, levelled=levelled)
    network = start
    causes: tuple[Cause, ...] = ()
    for _ in range(MAX_ROUNDS):
        previous = {cause.label for cause in causes}
        base = network.without_errors()
        causes = outvoted(readings, select_causes(readings, linearise(readings, base, known, noise), rules))
        kept = ~_left_out(readings, causes)
        network, linear = solve(readings.select(kept), base, known | _freed(causes), noise)
        if {cause.label for cause in causes} == previous:
            break
    while max_residual_m is not None:
        largest = _largest_residual(readings, kept, network)
        if largest.size_m <= max_residual_m:
            break
        causes = (*causes, largest)
        kept = ~_left_out(readings, causes)
        # Raises if too few are left.
        for points, reference in _kept_sets(readings.select(kept), noise):
            _common(points, reference, levelled=levelled)
        network, linear = solve(readings.select(kept), network, known | _freed(causes), noise)
    overall, by_station, by_component = _qualities(readings.select(kept), linear)
    scale = overall.noise_scale if overall.p_value < MISFIT_LEVEL else 1.0
    columns, covariance = _covariance(linear, max(scale, 1.0))
    return NetworkCalibration(
        readings=readings,
        kept=kept,
        network=network,
        linear=linear,
        columns=columns,
        covariance=covariance,
        scale=max(scale, 1.0),
        causes=causes,
        suspects=_suspects(readings, network, known, noise, causes, overall, levelled=levelled),
        errors=_errors(network, columns, covariance),
        overall=overall,
        by_station=by_station,
        by_component=by_component,
        levelled=levelled,
        max_residual_m=max_residual_m,
    )


def _start(readings: TargetReadings, noise: InstrumentNoise, *, levelled: bool) -> Network:
    """Robust frames of the single stations, and each target at the median of its places."""
    sets = mean_points(readings, None, noise)
    rotations, translations = [np.eye(3)], [np.zeros(3)]
    places: list[list[FloatArray]] = [[] for _ in readings.targets]
    for row, (station, points) in enumerate(zip(readings.stations, sets, strict=True)):
        if row:
            try:
                fit = robust_frame(_common(points, sets[0], levelled=levelled))
            except DegenerateGeometryError as error:
                raise DegenerateGeometryError(
                    f"station {station} against station {readings.stations[0]}: {error}"
                ) from error
            rotations.append(fit.rotation)
            translations.append(fit.translation_m)
        for target, point in zip(points.names, points.points_m, strict=True):
            places[readings.targets.index(int(target))].append(rotations[row] @ point + translations[row])
    return Network(
        rotation=np.stack(rotations),
        translation_m=np.stack(translations),
        errors=np.zeros((len(readings.stations), len(ERRORS))),
        points_m=np.stack([np.median(each, axis=0) if each else np.ones(3) for each in places]),
    )


def _common(points: PointSet, reference: PointSet, *, levelled: bool) -> PointPairs:
    common = [name for name in reference.names if name in points.names]
    if len(common) < MIN_POINTS:
        listed = ", ".join(map(str, common)) or "none"
        raise DegenerateGeometryError(
            f"expected at least {MIN_POINTS} targets in common, got {len(common)} ({listed}); measure more of them"
        )
    return PointPairs(points.select(common), reference.select(common), levelled)


def mean_points(readings: TargetReadings, network: Network | None, noise: InstrumentNoise) -> list[PointSet]:
    """Mean position of each target in the frame of each station, without a network's instrument errors."""
    ideal = np.zeros((len(readings.stations), len(ERRORS)))
    points = (
        readings.points_m(ideal)
        if network is None
        else readings.points_m(network.errors, network.target_constant_m)
    )
    covariances = measurement_covariance(
        readings.horizontal_rad, readings.zenith_rad, readings.distance_m, noise
    )
    sets = []
    for row in range(len(readings.stations)):
        own = readings.station == row
        targets = np.unique(readings.target[own])
        of_target = [own & (readings.target == target) for target in targets]
        sets.append(
            PointSet(
                tuple(readings.targets[target] for target in targets),
                np.array([points[rows].mean(axis=0) for rows in of_target]).reshape(-1, 3),
                np.array(
                    [covariances[rows].mean(axis=0) / np.count_nonzero(rows) for rows in of_target]
                ).reshape(-1, 3, 3),
            )
        )
    return sets


def _left_out(readings: TargetReadings, causes: Sequence[Cause]) -> NDArray[np.bool_]:
    """Rejected readings; a target of which either of two stations may be wrong is left out as a whole."""
    whole = [
        replace(cause, either_station=True)
        if any(other.kind is CauseKind.SIGHT and other.target == cause.target for other in cause.alternatives)
        else cause
        for cause in causes
    ]
    return rejected_readings(readings, whole)


def _freed(causes: Sequence[Cause]) -> dict[Column, float]:
    """Instrument errors to estimate, with the sigma of a prior where the readings do not tell two of them apart."""
    freed: dict[Column, float] = {}
    for cause in causes:
        if cause.kind is CauseKind.TARGET_CONSTANT:
            freed[TARGET_CONSTANT] = np.inf
        if cause.kind is not CauseKind.INSTRUMENT or cause.error is None or cause.value is None:
            continue
        others = [o for o in cause.alternatives if o.kind is CauseKind.INSTRUMENT and o.error is not None]
        size = abs(float(cause.value[0]))
        for each in (cause, *others):
            assert each.error is not None  # noqa: S101 (filtered above)
            column = (each.station, 6 + ERRORS.index(each.error))
            if each is cause and not others:
                sigma = np.inf
            else:
                sigma = size if each.error is cause.error else 10 * DATA_SHEET_SIGMA[each.error]
            freed[column] = max(freed.get(column, 0.0), sigma)
    return freed


def pair_residuals(
    readings: TargetReadings, network: Network, station: int, targets: Sequence[int]
) -> FloatArray:
    """(t, 3) position of targets as measured by the first station, less that by another, in the first one's frame."""
    points = readings.points_m(network.errors, network.target_constant_m)

    def place(row: int, target: int) -> FloatArray:
        mean: FloatArray = points[(readings.station == row) & (readings.target == target)].mean(axis=0)
        moved: FloatArray = mean @ network.rotation[row].T + network.translation_m[row]
        return moved

    return np.array([place(0, target) - place(station, target) for target in targets]).reshape(-1, 3)


def common_targets(readings: TargetReadings, station: int) -> list[int]:
    """Rows of the targets that a station and the first one have measured."""
    of_first, of_other = (set(readings.target[readings.station == row].tolist()) for row in (0, station))
    return sorted(of_first & of_other)


def _largest_residual(readings: TargetReadings, kept: NDArray[np.bool_], network: Network) -> Cause:
    """Return the sight with the largest residual; of the first station if its target disagrees with several others."""
    used = readings.select(kept)
    residuals: dict[tuple[int, int], FloatArray] = {}
    for row in range(1, len(readings.stations)):
        common = common_targets(used, row)
        of_station = pair_residuals(used, network, row, common)
        residuals |= {(row, each): residual for each, residual in zip(common, of_station, strict=True)}
    lengths = {key: float(np.linalg.norm(residual)) for key, residual in residuals.items()}
    station, target = max(lengths, key=lambda key: lengths[key])
    others = [lengths[key] for key in lengths if key[1] == target and key[0] != station]
    wrong = 0 if others and min(others) > lengths[station, target] / 2 else station
    value = residuals[station, target] * (1.0 if wrong == 0 else -1.0)
    return Cause(CauseKind.SIGHT, wrong, target, either_station=not others, value=value)


def _kept_sets(readings: TargetReadings, noise: InstrumentNoise) -> list[tuple[PointSet, PointSet]]:
    sets = mean_points(readings, None, noise)
    return [(points, sets[0]) for points in sets[1:]]


def _differs(cause: Cause, other: Cause) -> bool:
    return other.kind in (CauseKind.INSTRUMENT, CauseKind.TARGET_CONSTANT) or (
        other.kind is CauseKind.SIGHT and other.target != cause.target
    )


def _qualities(
    readings: TargetReadings, linear: Linearisation
) -> tuple[FitQuality, tuple[FitQuality, ...], tuple[FitQuality, FitQuality, FitQuality]]:
    squares = linear.y**2
    hat = np.einsum("nia,ab,nib->ni", linear.D, linear.covariance, linear.D)
    hat += np.einsum("nij,njk,nik->ni", linear.B, linear.point_covariances_m2[linear.target], linear.B)
    numbers = 1 - hat

    def quality(rows: NDArray[np.bool_], columns: Sequence[int]) -> FitQuality:
        part = np.ix_(rows, np.array(columns))
        return FitQuality(float(squares[part].sum()), float(numbers[part].sum()))

    everything = np.ones(len(squares), dtype=bool)
    along, horizontal, vertical = (quality(everything, [column]) for column in range(3))
    return (
        FitQuality(linear.chi_squared, float(linear.redundancy)),
        tuple(quality(readings.station == row, range(3)) for row in range(len(readings.stations))),
        (along, horizontal, vertical),
    )


def _covariance(linear: Linearisation, scale: float) -> tuple[tuple[Column, ...], FloatArray]:
    """Joint covariance of poses and instrument errors, for noise ``scale`` times the stated one and priors as they are."""
    kept = [place for place, column in enumerate(linear.active) if column != TARGET_CONSTANT]
    given = linear.covariance
    joint = scale**2 * given - (scale**2 - 1.0) * (given * linear.prior_information) @ given
    joint = joint[np.ix_(kept, kept)]
    return tuple(linear.active[place] for place in kept), (joint + joint.T) / 2


def _errors(
    network: Network, columns: tuple[Column, ...], covariance: FloatArray
) -> dict[tuple[int, InstrumentError], ErrorEstimate]:
    sigmas = np.sqrt(np.diag(covariance))
    return {
        (row, ERRORS[component - 6]): ErrorEstimate(float(network.errors[row, component - 6]), float(sigma))
        for (row, component), sigma in zip(columns, sigmas, strict=True)
        if component >= 6
    }


def _suspects(
    readings: TargetReadings,
    network: Network,
    known: dict[Column, float],
    noise: InstrumentNoise,
    causes: Sequence[Cause],
    overall: FitQuality,
    *,
    levelled: bool,
) -> tuple[Cause, ...]:
    """Causes that a selection without limits finds beyond the selected ones, if there is a misfit at all."""
    if overall.p_value > MISFIT_LEVEL:
        return ()
    rules = SelectionRules(0.0, 0.0, levelled=levelled)
    base = network.without_errors()
    found = select_causes(readings, linearise(readings, base, known, noise), rules)
    selected = {cause.label for cause in causes}
    return tuple(cause for cause in found if cause.label not in selected)
