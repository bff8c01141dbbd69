"""From a trajectory to poses as they leave the program: numbers, and whether they may be used. Live and at the desk."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.estimation.observations import middle_m
from tsgt.estimation.pose_batch import Kind, PoseBatch, Reason
from tsgt.geometry import state_at_point, quaternion_from_rotation, ros_covariance, with_second_order_terms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import States
    from tsgt.model import Parameters

NO_IDEA_RAD = 0.5
"""A pose whose rotation has a sigma beyond this is not given at all."""

_NEVER_NS = -(2**61)


class OfPrism(NamedTuple):
    """The measurements of one prism, as :class:`Seen` has those of all.

    Attributes
    ----------
    times_ns, stations, residuals_m
        Of the usable ones.
    unusable_ns
        Instants of those that were not usable.
    """

    times_ns: list[int]
    stations: list[int]
    residuals_m: list[float]
    unusable_ns: list[int]


@dataclass(frozen=True)  # no slots: it remembers of_prisms
class Seen:
    """The measurements that a trajectory rests on.

    Attributes
    ----------
    times_ns
        (M,) instants of the usable ones in their order, on the master's Unix clock.
    stations
        (M,) numbers of their stations.
    prisms
        (M,) their prisms as columns of the layout.
    residuals_m
        (M,) what they are off the trajectory by; NaN where that is not known.
    unusable_ns
        By column, the instants of those that were not usable, in their order.
    """

    times_ns: NDArray[np.int64]
    stations: NDArray[np.int64]
    prisms: NDArray[np.intp]
    residuals_m: NDArray[np.float64]
    unusable_ns: Sequence[NDArray[np.int64]]

    @cached_property
    def of_prisms(self) -> list[OfPrism]:
        """The same by column of the layout, to look up one instant at a time."""
        found = [OfPrism([], [], [], unusable_ns.tolist()) for unusable_ns in self.unusable_ns]
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


class ContinuousPoses:
    """Puts poses together.

    Parameters
    ----------
    parameters
        Limits, stations, layout.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._limits = parameters.pipeline
        self._prisms = tuple(prism.prism for prism in parameters.prisms)
        self._home_station = [
            next((station.station for station in parameters.stations if station.prism == prism), 0)
            for prism in self._prisms
        ]
        self._to_origin_m = -middle_m(parameters)

    def predicted(
        self,
        stamps_ns: Sequence[int],
        seen: Seen,
        states: States | None,
        covariance: NDArray[np.float64],
        *,
        settled: NDArray[np.bool_] | None = None,
    ) -> PoseBatch:
        """Make poses from measurements before their epochs; arguments and result as those of :meth:`smoothed`.

        Live they are due one by one, so that which measurement is the latest is looked up without arrays.
        """
        batch = PoseBatch.blank(np.array(stamps_ns, dtype=np.int64), self._prisms, Kind.PREDICTED)
        for row, stamp_ns in enumerate(stamps_ns):
            for column, home_station in enumerate(self._home_station):
                (
                    batch.station[row, column],
                    batch.age_s[row, column],
                    batch.prism_residual_m[row, column],
                    batch.prism_reason[row, column],
                ) = self._latest(seen.of_prisms[column], home_station, stamp_ns)
        return self._judged(batch, states, covariance, settled=settled)

    def smoothed(
        self,
        stamp_ns: NDArray[np.int64],
        seen: Seen,
        states: States | None,
        covariance: NDArray[np.float64],
        *,
        settled: NDArray[np.bool_] | None = None,
    ) -> PoseBatch:
        """Make poses from measurements on both sides of their epochs.

        Parameters
        ----------
        stamp_ns
            (N,) epochs.
        seen
            Measurements.
        states, covariance
            The trajectory of the prisms' middle at the epochs, and the covariance of the errors of its place and
            rotation, (N, 6, 6) or more of them; None where there is none.
        settled
            (N,) whether the trajectory can be believed there; no pose is valid where not. Everywhere when not given.

        Returns
        -------
        PoseBatch
            Of the origin of the robot frame. A pose is valid while the sigma of its position at the prisms' middle and that
            of its rotation, in the direction in which each is known worst, are within the limits, and its prisms are where
            the trajectory puts them. The reason of one that is too uncertain is that of the prism that is missing, or
            ``uncertain`` when none is.
        """
        batch = PoseBatch.blank(stamp_ns, self._prisms, Kind.SMOOTHED)
        for column in range(len(self._prisms)):
            self._describe(batch, column, seen)
        return self._judged(batch, states, covariance, settled=settled)

    def _latest(self, prism: OfPrism, home_station: int, epoch_ns: int) -> tuple[int, float, float, Reason]:
        """Look up what is known of a prism: station and age of its last measurement, residual, what is amiss."""
        latest = bisect.bisect_right(prism.times_ns, epoch_ns) - 1
        station, age_s, since_ns = home_station, math.nan, _NEVER_NS
        if latest >= 0:
            station, since_ns = prism.stations[latest], prism.times_ns[latest]
            age_s = (epoch_ns - since_ns) / 1e9
            if epoch_ns - since_ns <= self._limits.outage_limit_ns:
                first, second, last = (prism.residuals_m[max(latest - back, 0)] for back in (2, 1, 0))
                # The middle one; NaN where one is not known.
                middle = max(min(first, second), min(max(first, second), last))
                return station, age_s, middle if first + second + last >= 0 else math.nan, Reason.VALID
        newest = bisect.bisect_right(prism.unusable_ns, epoch_ns) - 1
        spoilt = newest >= 0 and prism.unusable_ns[newest] > since_ns
        return station, age_s, math.nan, Reason.STATION_STATUS if spoilt else Reason.OUTAGE

    def _describe(self, batch: PoseBatch, column: int, seen: Seen) -> None:
        """Fill in what is known of one prism: station, age of its last measurement, residual, what is amiss."""
        epochs_ns, unusable_ns = batch.stamp_ns, seen.unusable_ns[column]
        rows = np.flatnonzero(seen.prisms == column)
        times_ns = seen.times_ns[rows]
        latest = np.searchsorted(times_ns, epochs_ns, side="right") - 1
        known = latest >= 0
        since_ns = np.full(len(epochs_ns), _NEVER_NS)
        since_ns[known] = times_ns[latest[known]]
        batch.station[:, column] = self._home_station[column]
        batch.station[known, column] = seen.stations[rows][latest[known]]
        batch.age_s[known, column] = (epochs_ns[known] - since_ns[known]) / 1e9
        following = np.searchsorted(times_ns, epochs_ns)
        inside = following < len(rows)
        until_ns = np.full(len(epochs_ns), -_NEVER_NS)
        until_ns[inside] = times_ns[following[inside]]
        nearest = np.where(until_ns - epochs_ns < epochs_ns - since_ns, following, latest)
        out = until_ns - since_ns > self._limits.outage_limit_ns
        batch.prism_reason[out, column] = Reason.OUTAGE
        if len(unusable_ns):
            newest = np.searchsorted(unusable_ns, epochs_ns, side="right") - 1
            spoilt = out & (newest >= 0) & (unusable_ns[newest] > since_ns)
            batch.prism_reason[spoilt, column] = Reason.STATION_STATUS
        # One alone that does not fit is an outlier; two of three are the robot's, or the set-up is wrong.
        near = rows[np.minimum(np.maximum(nearest[~out] + np.arange(-1, 2)[:, None], 0), len(rows) - 1)]
        first, second, last = seen.residuals_m[near]
        batch.prism_residual_m[~out, column] = np.maximum(
            np.minimum(first, second), np.minimum(np.maximum(first, second), last)
        )

    def _judged(
        self,
        batch: PoseBatch,
        states: States | None,
        covariance: NDArray[np.float64],
        *,
        settled: NDArray[np.bool_] | None = None,
    ) -> PoseBatch:
        """Fill in the poses of which anything is known, and say which may not be used, and why."""
        missing = batch.prism_reason.max(axis=1)
        if states is None:
            batch.reason[:] = np.where(missing, missing, Reason.DEGENERATE_GEOMETRY)
            return batch
        limits, rotation = self._limits, states.rotation
        variance_m2 = np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1]
        sigma_m = np.sqrt(np.where(variance_m2 >= 0, variance_m2, np.nan))
        states, covariance = state_at_point(states, covariance, self._to_origin_m)
        covariance, sigma_rad = with_second_order_terms(rotation, covariance)
        unknown = ~(sigma_rad < NO_IDEA_RAD)
        batch.position_m[:] = states.position
        batch.orientation_xyzw[:] = quaternion_from_rotation(rotation)
        batch.covariance[:] = ros_covariance(rotation, covariance)
        batch.velocity_mps[:] = states.velocity
        batch.angular_velocity_radps[:] = states.angular_velocity
        told = np.isfinite(batch.prism_residual_m)
        squares = np.where(told, batch.prism_residual_m, 0.0) ** 2
        count = told.sum(axis=1)
        batch.residual_m[:] = np.where(count, np.sqrt(squares.sum(axis=1) / np.maximum(count, 1)), np.nan)
        if unknown.any():
            for numbers in (batch.position_m, batch.orientation_xyzw, batch.covariance):
                numbers[unknown] = np.nan
            for numbers in (batch.velocity_mps, batch.angular_velocity_radps, batch.residual_m):
                numbers[unknown] = np.nan
        # A covariance that rounding has spoilt has no sigma, which is below no limit.
        uncertain = unknown | ~(sigma_m <= limits.position_sigma_limit_m)
        uncertain |= sigma_rad > limits.rotation_sigma_limit_rad
        batch.reason[rotation[:, 2, 2] <= math.cos(limits.tilt_limit_rad)] = Reason.TILT
        batch.reason[batch.residual_m > limits.residual_limit_m] = Reason.RESIDUAL
        if settled is not None:
            batch.reason[~settled & (batch.reason == Reason.VALID)] = Reason.UNCERTAIN
        if uncertain.any():
            batch.reason[uncertain] = np.where(missing, missing, Reason.UNCERTAIN)[uncertain]
        return batch
