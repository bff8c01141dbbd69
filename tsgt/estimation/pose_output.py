"""Trajectory states to poses of the reference point, with their validity. Sans-I/O."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.estimation.observations import centroid_m
from tsgt.estimation.pose_batch import Kind, PoseBatch, Reason
from tsgt.estimation.pose_quality import degradation_of_one, degradations, sigma_limits, worst_sigma
from tsgt.estimation.reference_point import moved_poses, transform_of
from tsgt.geometry import log_so3, quaternion_from_rotation
from tsgt.geometry.trajectory import ros_covariance, state_at_point, with_second_order_terms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.trajectory import States
    from tsgt.model import Parameters

MAX_ROTATION_SIGMA_RAD = 0.5  # a pose whose rotation has a larger sigma is not computed

_NEVER_NS = -(2**61)
# Plain numbers, which numpy compares and assigns several times as fast
_VALID, _TILT, _RESIDUAL, _UNCERTAIN, _OUTAGE, _STATION_STATUS = (
    int(each)
    for each in (
        Reason.VALID,
        Reason.TILT,
        Reason.RESIDUAL,
        Reason.UNCERTAIN,
        Reason.OUTAGE,
        Reason.STATION_STATUS,
    )
)


class PrismHistory(NamedTuple):
    """:class:`MeasurementHistory` of one prism."""

    times_ns: list[int]
    stations: list[int]
    residuals_m: list[float]
    unusable_ns: list[int]


@dataclass(frozen=True)  # no slots, because of cached_property
class MeasurementHistory:
    """The measurements that a trajectory is based on."""

    times_ns: NDArray[np.int64]  # (M,) instants of the usable ones in their order, on the master's Unix clock
    stations: NDArray[np.int64]  # (M,) numbers of their stations
    prisms: NDArray[np.intp]  # (M,) their prisms as columns of the layout
    residuals_m: NDArray[np.float64]  # (M,) their distances from the trajectory; NaN where unknown
    unusable_ns: Sequence[NDArray[np.int64]]  # by column, the instants of the unusable ones, in their order

    @cached_property
    def by_prism(self) -> list[PrismHistory]:
        """The same by column of the layout, to look up single instants."""
        found = [PrismHistory([], [], [], unusable_ns.tolist()) for unusable_ns in self.unusable_ns]
        each = (
            self.prisms.tolist(),
            self.times_ns.tolist(),
            self.stations.tolist(),
            self.residuals_m.tolist(),
        )
        for column, time_ns, station, residual_m in zip(*each, strict=True):
            found[column].times_ns.append(time_ns)
            found[column].stations.append(station)
            found[column].residuals_m.append(residual_m)
        return found


class PoseNumbers(NamedTuple):
    """N poses of the reference point from states alone. Which of them are valid depends on the measurements, too."""

    position_m: NDArray[np.float64]  # This and the next five are as in PoseBatch
    orientation_xyzw: NDArray[np.float64]
    covariance: NDArray[np.float64]
    covariance_common: NDArray[np.float64]
    velocity_mps: NDArray[np.float64]
    angular_velocity_radps: NDArray[np.float64]
    # (N, 2) of position and rotation in the least certain direction, in m and rad; NaN where rounding made it negative
    sigmas: NDArray[np.float64]
    tilt_cosine: NDArray[np.float64]  # (N,)

    def select(self, rows: list[int]) -> PoseNumbers:
        """Return the poses of some rows."""
        return PoseNumbers(*(each[rows] for each in self))

    def without(self, unknown: NDArray[np.bool_] | list[bool]) -> PoseNumbers:
        """Return these with NaN where a pose, (N,), is unknown."""
        copies = PoseNumbers(*(each.copy() for each in self))
        for each in copies[:6]:
            each[unknown] = np.nan
        return copies

    @classmethod
    def none(cls, count: int) -> PoseNumbers:
        """Return N poses of which nothing is known."""
        shapes = (3,), (4,), (6, 6), (6, 6), (3,), (3,), (2,), ()
        return cls(*(np.full((count, *shape), np.nan) for shape in shapes))


class _Verdict(NamedTuple):
    """Validity of one pose."""

    reason: int  # Of Reason
    degraded: int  # Of Degradation
    residual_m: float
    unknown: bool  # It is not computed


class ContinuousPoseOutput:
    """Computes poses and their validity."""

    def __init__(self, parameters: Parameters) -> None:
        self._limits = parameters.pipeline
        self._prisms = tuple(prism.prism for prism in parameters.prisms)
        self._home_station = [
            next((station.station for station in parameters.stations if station.prism == prism), 0)
            for prism in self._prisms
        ]
        self._to_origin_m = -centroid_m(parameters)
        self._reference_point = parameters.reference_point
        self._T_robot_point = transform_of(parameters.reference_point)
        self._sigma_limits = sigma_limits(np.array(list(Kind), np.int8), self._limits).tolist()
        self._min_tilt_cosine = math.cos(self._limits.tilt_limit_rad)
        self._undetermined = int(Reason.DEGENERATE_GEOMETRY if parameters.imu is None else Reason.UNCERTAIN)

    def numbers(
        self, states: States, covariance: NDArray[np.float64], common: NDArray[np.float64] | None = None
    ) -> PoseNumbers:
        """Return the poses of states, whatever the measurements; arguments as for :meth:`smoothed`."""
        rotation = states.rotation
        if common is None:
            covariance_common = np.full((len(states), 6, 6), np.nan)
        else:
            covariance = covariance[:, :6, :6] + common
            covariance_common = ros_covariance(rotation, state_at_point(states, common, self._to_origin_m)[1])
        states, covariance = state_at_point(states, covariance, self._to_origin_m)
        covariance, sigma_rad = with_second_order_terms(rotation, covariance)
        poses = moved_poses(
            self._T_robot_point,
            states.position,
            quaternion_from_rotation(rotation),
            ros_covariance(rotation, covariance),
            covariance_common,
            states.velocity,
            states.angular_velocity,
            second_order=np.ones(len(states), np.bool_),
        )
        sigmas = np.column_stack([worst_sigma(poses[2][:, :3, :3]), sigma_rad])
        return PoseNumbers(*poses, sigmas, rotation[:, 2, 2])

    def due(
        self,
        stamps_ns: Sequence[int],
        delays_ns: Sequence[int],
        now_ns: int,
        history: MeasurementHistory,
        numbers: PoseNumbers | None,
        *,
        converged: Sequence[bool],
        ambiguous: Sequence[bool],
    ) -> PoseBatch:
        """Return the poses that are due live at an epoch ``now_ns``: a few, whose validity is found without arrays.

        A pose with a delay is one of :meth:`smoothed` that is sent before it is final: the next measurement of a prism must
        have arrived, unless the last one is within the outage limit, and a pose without any measurement from its epoch on is
        not computed. One without a delay is predicted from earlier measurements.
        """
        newest_ns = int(history.times_ns.max(initial=_NEVER_NS))
        rows = []
        for row, (stamp_ns, delay_ns) in enumerate(zip(stamps_ns, delays_ns, strict=True)):
            kind = Kind.SMOOTHED if delay_ns else Kind.PREDICTED
            prisms = [
                self._describe_one(prism, home_station, stamp_ns, now_ns if delay_ns else None)
                for prism, home_station in zip(history.by_prism, self._home_station, strict=True)
            ]
            stations, ages_s, residuals_m, reasons = zip(*prisms, strict=True)
            verdict = _Verdict(max(reasons) or self._undetermined, 0, math.nan, False)
            if numbers is not None:
                verdict = self._verdict(
                    kind,
                    (ages_s, residuals_m, reasons),
                    numbers.sigmas[row].tolist(),
                    float(numbers.tilt_cosine[row]),
                    known=not delay_ns or stamp_ns <= newest_ns,
                    converged=converged[row],
                    ambiguous=ambiguous[row],
                )
            rows.append((int(kind), *verdict, stations, ages_s, residuals_m, reasons))
        kinds, reasons, degraded, residual_m, unknown, stations, ages_s, residuals_m, prism_reasons = zip(
            *rows, strict=True
        )
        count = len(rows)
        if numbers is None:
            numbers = PoseNumbers.none(count)
        elif any(unknown):
            numbers = numbers.without(list(unknown))
        return PoseBatch(
            stamp_ns=np.array(stamps_ns, dtype=np.int64),
            kind=np.array(kinds, np.int8),
            delay_ns=np.array(delays_ns, dtype=np.int64),
            reason=np.array(reasons, np.int8),
            degraded=np.array(degraded, np.int8),
            position_m=numbers.position_m,
            orientation_xyzw=numbers.orientation_xyzw,
            covariance=numbers.covariance,
            covariance_common=numbers.covariance_common,
            velocity_mps=numbers.velocity_mps,
            angular_velocity_radps=numbers.angular_velocity_radps,
            residual_m=np.array(residual_m),
            station=np.array(stations, np.int64),
            age_s=np.array(ages_s),
            prism_residual_m=np.array(residuals_m),
            prism_reason=np.array(prism_reasons, np.int8),
            imu=np.zeros(count, np.int8),
            jump=np.full((count, 2), np.nan),
            prisms=self._prisms,
            reference_point=self._reference_point,
        )

    def _verdict(
        self,
        kind: Kind,
        prisms: tuple[tuple[float, ...], tuple[float, ...], tuple[int, ...]],
        sigmas: list[float],
        tilt_cosine: float,
        *,
        known: bool,
        converged: bool,
        ambiguous: bool,
    ) -> _Verdict:
        """Judge one pose as :meth:`_with_poses` does many; ``prisms``: their ages, residuals and reasons."""
        ages_s, residuals_m, reasons = prisms
        known = known and sigmas[1] < MAX_ROTATION_SIGMA_RAD
        residual_m = _root_mean_square(residuals_m) if known else math.nan
        limits, missing, reason = self._sigma_limits[kind], max(reasons), _VALID
        if residual_m > self._limits.residual_limit_m:
            reason = _RESIDUAL
        elif tilt_cosine <= self._min_tilt_cosine:
            reason = _TILT
        elif not converged:
            reason = _UNCERTAIN
        # NaN is below no limit.
        if not (known and sigmas[0] <= limits[0] and sigmas[1] <= limits[1]):
            reason = missing or (_RESIDUAL if reason == _RESIDUAL else _UNCERTAIN)
        if reason:
            return _Verdict(reason, 0, residual_m, not known)
        degraded = degradation_of_one(
            kind, ages_s, reasons, residual_m, sigmas, limits, self._limits, ambiguous=ambiguous
        )
        return _Verdict(_VALID, degraded, residual_m, unknown=False)

    def smoothed(
        self,
        stamp_ns: NDArray[np.int64],
        history: MeasurementHistory,
        states: States | None,
        covariance: NDArray[np.float64],
        *,
        common: NDArray[np.float64] | None = None,
        converged: NDArray[np.bool_] | None = None,
        ambiguous: NDArray[np.bool_] | None = None,
    ) -> PoseBatch:
        """Return poses of the reference point from measurements on both sides of their epochs.

        A pose is valid while the sigmas of its position at the reference point and of its rotation, each in its least
        certain direction, are within the limits, and the prisms' residuals are. The reason of an uncertain pose is that
        of a missing prism, or ``uncertain`` without any.

        Parameters
        ----------
        stamp_ns
            (N,) epochs.
        states, covariance
            The trajectory of the prisms' centroid at the epochs, and the covariance of its position and rotation
            errors, (N, 6, 6) or larger; None without a trajectory.
        common
            (N, 6, 6) what the set-up's uncertainty adds to that covariance; None: unknown.
        converged
            (N,) whether the trajectory is reliable there; no other pose is valid. Default: everywhere.
        ambiguous
            (N,) whether the state was ambiguous shortly before, which degrades a pose. Default: nowhere.
        """
        batch = PoseBatch.blank(stamp_ns, self._prisms, Kind.SMOOTHED)
        for column in range(len(self._prisms)):
            self._describe(batch, column, history)
        numbers = None if states is None else self.numbers(states, covariance, common)
        return self._with_poses(batch, numbers, converged=converged, ambiguous=ambiguous)

    def distance(self, before: States, after: States) -> tuple[float, float]:
        """Return the distance of two states' reference points in m, and the rotation between them in rad."""
        lever_arm = self._to_origin_m + np.array(self._reference_point.position_m)
        moved = after.position + after.rotation @ lever_arm - before.position - before.rotation @ lever_arm
        turned = log_so3(before.rotation.swapaxes(1, 2) @ after.rotation)
        return float(np.linalg.norm(moved)), float(np.linalg.norm(turned))

    def _describe_one(
        self, prism: PrismHistory, home_station: int, epoch_ns: int, now_ns: int | None
    ) -> tuple[int, float, float, int]:
        """Return station and age of a prism's last measurement before an epoch, its residual and its reason.

        ``now_ns``: when a smoothed pose is sent; None: a predicted one.
        """
        times_ns, residuals_m = prism.times_ns, prism.residuals_m
        latest = bisect.bisect_right(times_ns, epoch_ns) - 1
        station, age_s, since_ns = home_station, math.nan, _NEVER_NS
        if latest >= 0:
            station, since_ns = prism.stations[latest], times_ns[latest]
            age_s = (epoch_ns - since_ns) / 1e9
        if now_ns is None:
            until_ns, near = epoch_ns, (latest - 2, latest - 1, latest)
        else:
            following = bisect.bisect_left(times_ns, epoch_ns)
            until_ns, nearest = now_ns, latest
            if following < len(times_ns):
                until_ns = times_ns[following]
                nearest = following if until_ns - epoch_ns < epoch_ns - since_ns else latest
            near = (nearest - 1, nearest, min(nearest + 1, len(times_ns) - 1))
        if until_ns - since_ns <= self._limits.outage_limit_ns:
            # The median of three: a single large residual is an outlier, two are a wrong pose or set-up.
            first, second, last = (residuals_m[max(each, 0)] for each in near)
            median = max(min(first, second), min(max(first, second), last))
            # NaN where one is unknown.
            return station, age_s, median if first + second + last >= 0 else math.nan, _VALID
        newest = bisect.bisect_right(prism.unusable_ns, epoch_ns) - 1
        unusable = newest >= 0 and prism.unusable_ns[newest] > since_ns
        return station, age_s, math.nan, _STATION_STATUS if unusable else _OUTAGE

    def _describe(self, batch: PoseBatch, column: int, history: MeasurementHistory) -> None:
        """Fill in station and age of a prism's last measurement, its residual and its reason."""
        epochs_ns, unusable_ns = batch.stamp_ns, history.unusable_ns[column]
        rows = np.flatnonzero(history.prisms == column)
        times_ns = history.times_ns[rows]
        latest = np.searchsorted(times_ns, epochs_ns, side="right") - 1
        known = latest >= 0
        since_ns = np.full(len(epochs_ns), _NEVER_NS)
        since_ns[known] = times_ns[latest[known]]
        batch.station[:, column] = self._home_station[column]
        batch.station[known, column] = history.stations[rows][latest[known]]
        batch.age_s[known, column] = (epochs_ns[known] - since_ns[known]) / 1e9
        following = np.searchsorted(times_ns, epochs_ns)
        inside = following < len(rows)
        until_ns = np.full(len(epochs_ns), -_NEVER_NS)
        until_ns[inside] = times_ns[following[inside]]
        nearest = np.where(until_ns - epochs_ns < epochs_ns - since_ns, following, latest)
        out = until_ns - since_ns > self._limits.outage_limit_ns
        batch.prism_reason[out, column] = _OUTAGE
        if len(unusable_ns):
            newest = np.searchsorted(unusable_ns, epochs_ns, side="right") - 1
            unusable = out & (newest >= 0) & (unusable_ns[newest] > since_ns)
            batch.prism_reason[unusable, column] = _STATION_STATUS
        # The median of three: a single large residual is an outlier, two are a wrong pose or set-up.
        near = rows[np.minimum(np.maximum(nearest[~out] + np.arange(-1, 2)[:, None], 0), len(rows) - 1)]
        first, second, last = history.residuals_m[near]
        batch.prism_residual_m[~out, column] = np.maximum(
            np.minimum(first, second), np.minimum(np.maximum(first, second), last)
        )

    def _with_poses(
        self,
        batch: PoseBatch,
        numbers: PoseNumbers | None,
        *,
        converged: NDArray[np.bool_] | None,
        ambiguous: NDArray[np.bool_] | None,
    ) -> PoseBatch:
        """Fill in the poses, and the reasons of invalid ones."""
        missing = batch.prism_reason.max(axis=1)
        if numbers is None:
            batch.reason[:] = np.where(missing, missing, self._undetermined)
            return replace(batch, reference_point=self._reference_point)
        limits = self._limits
        unknown = ~(numbers.sigmas[:, 1] < MAX_ROTATION_SIGMA_RAD)
        known = numbers.without(unknown)
        for name in PoseNumbers._fields[:6]:
            getattr(batch, name)[:] = getattr(known, name)
        fitted = np.isfinite(batch.prism_residual_m)
        squares = np.where(fitted, batch.prism_residual_m, 0.0) ** 2
        count = fitted.sum(axis=1)
        residual_m = np.sqrt(squares.sum(axis=1) / np.maximum(count, 1))
        batch.residual_m[:] = np.where((count > 0) & ~unknown, residual_m, np.nan)
        # Rounding may make a variance negative; its sigma is NaN, which is below no limit.
        uncertain = unknown | ~(numbers.sigmas <= sigma_limits(batch.kind, limits)).all(axis=1)
        batch.reason[numbers.tilt_cosine <= self._min_tilt_cosine] = _TILT
        batch.reason[batch.residual_m > limits.residual_limit_m] = _RESIDUAL
        if converged is not None:
            batch.reason[~converged & (batch.reason == _VALID)] = _UNCERTAIN
        if uncertain.any():
            # A wrong layout makes poses uncertain too: its outliers have little weight.
            present = np.where(batch.reason == _RESIDUAL, _RESIDUAL, _UNCERTAIN)
            batch.reason[uncertain] = np.where(missing, missing, present)[uncertain]
        batch.degraded[:] = degradations(batch, numbers.sigmas, limits, ambiguous=ambiguous)
        return replace(batch, reference_point=self._reference_point)


def _root_mean_square(residuals_m: tuple[float, ...]) -> float:
    """Of those that are known; NaN without any."""
    squares = [each * each for each in residuals_m if not math.isnan(each)]
    return math.sqrt(sum(squares) / len(squares)) if squares else math.nan
