"""The estimator ``linear``, live and for post-processing. Sans-I/O.

Epochs are the multiples of a period in Unix time, *decided* when each prism has a measurement at or after it or can get no
useful one any more: all made before now minus the transport limit have arrived, and its last one is older than the outage
limit. A measurement after a gap in the sequence numbers counts when that is closed or past the transport limit. What is
decided does not depend on when the estimator is asked: a replay gives the same poses.
"""

from __future__ import annotations

import bisect
import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation.completeness import CompletenessTracker
from tsgt.estimation.pose_batch import PoseBatch, Reason
from tsgt.estimation.pose_quality import degradations
from tsgt.estimation.reference_point import poses_at
from tsgt.estimation.setup_uncertainty import PointUncertainty
from tsgt.estimation.tracks import Track, build_tracks, has_plausible_time, measured_at_ns, usable
from tsgt.geometry import (
    check_layout,
    covariance_scale,
    interpolate_prisms,
    interpolated_covariance,
    interpolation_error_s2,
    interpolation_errors,
    pose_covariance,
    pose_displacement,
    poses_from_prisms,
    quaternion_from_rotation,
    squared_misfit,
    twists,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import Interpolated
    from tsgt.model import Measurement, Parameters

# Limits the memory of intermediate arrays; results do not depend on it.
_MAX_BATCH_EPOCHS = 8192


class LinearEstimator:
    """The paper's estimator (Vaidis et al. 2021, section III-D), with reasons, covariance and velocity.

    A prism that is never measured keeps every pose invalid. Raises DegenerateGeometryError if the prisms of the layout
    are fewer than three, coincident or collinear.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._limits = parameters.pipeline
        self._prisms = tuple(prism.prism for prism in parameters.prisms)
        self._layout = np.array([prism.position_m for prism in parameters.prisms])
        check_layout(self._layout, names=self._prisms)
        self._uncertainty = PointUncertainty.of(parameters)
        self._stations = {station.station: station for station in parameters.stations}
        self._home_station = {s.prism: s.station for s in reversed(parameters.stations)}
        self._tracks = {prism: Track.empty() for prism in self._prisms}
        self._unusable_ns: dict[int, list[int]] = {prism: [] for prism in self._prisms}
        self._pending: list[Measurement] = []
        self._trackers = {
            prism: {s.station for s in parameters.stations if s.prism == prism} for prism in self._prisms
        }
        self._completeness = {
            s.station: CompletenessTracker(self._limits.transport_limit_ns) for s in parameters.stations
        }
        self._now_ns = 0
        self._not_before_ns = 0
        self._next_epoch_ns: int | None = None
        self._started = False
        self._none = PoseBatch.blank(np.empty(0, np.int64), self._prisms)

    def begin_at(self, now_ns: int) -> None:
        """Compute no poses before an instant minus the transport limit.

        For live use: a first measurement from a backlog, or with the time of a clock that is years behind, must not
        start the stream there.
        """
        self._not_before_ns = now_ns - self._limits.transport_limit_ns

    def add(self, measurement: Measurement) -> None:
        """Add a measurement; implausible ones and those of unknown stations or prisms are ignored."""
        station = self._stations.get(measurement.station)
        if (
            station is None
            or measurement.prism not in self._tracks
            or not has_plausible_time(measurement, station)
        ):
            return
        time_ns = measured_at_ns(measurement, station)
        first_epoch = -(-max(time_ns, self._not_before_ns) // self._limits.period_ns) * self._limits.period_ns
        if self._next_epoch_ns is None or (not self._started and first_epoch < self._next_epoch_ns):
            self._next_epoch_ns = first_epoch
        self._trackers[measurement.prism].add(station.station)
        self._completeness[station.station].add(measurement.sequence, time_ns)
        if usable(measurement):
            self._pending.append(measurement)
        else:
            self._unusable_ns[measurement.prism].append(time_ns)

    def advance(self, now_ns: int) -> PoseBatch:
        """Return the poses of all epochs that were decided since the last call.

        ``now_ns`` is the present on the master's Unix clock; measurements made more than the transport limit before it
        are assumed to have arrived.
        """
        self._now_ns = now_ns
        self._take_pending()
        period = self._limits.period_ns
        start = self._next_epoch_ns
        decided = min(self._decided_until_ns(prism, now_ns) for prism in self._prisms)
        if start is None or decided < start:
            return self._none
        epochs = np.arange(start, decided + 1, period, dtype=np.int64)
        chunks = [epochs[at : at + _MAX_BATCH_EPOCHS] for at in range(0, len(epochs), _MAX_BATCH_EPOCHS)]
        poses = PoseBatch.concatenated([self._poses(chunk) for chunk in chunks])
        self._started = True
        self._next_epoch_ns = int(epochs[-1]) + period
        self._discard_before(self._next_epoch_ns)
        return poses

    def next_deadline_ns(self) -> int | None:
        """Return when the next epoch is decided if nothing more arrives; None before the first one."""
        self._take_pending()
        epoch = self._next_epoch_ns
        if epoch is None:
            return None
        complete_ns = [self._complete_at_ns(prism, epoch) for prism in self._prisms]
        return max([epoch, *(at_ns + self._limits.transport_limit_ns + 1 for at_ns in complete_ns if at_ns)])

    def _take_pending(self) -> None:
        if self._pending:
            for prism, track in build_tracks(self._parameters, self._pending).items():
                if len(track):
                    self._tracks[prism] = self._tracks[prism].merged(track)
            self._pending.clear()

    def _decided_until_ns(self, prism: int, now_ns: int) -> int:
        arrived_ns = now_ns - self._limits.transport_limit_ns - 1
        complete_ns = (self._completeness[station].complete_ns(now_ns) for station in self._trackers[prism])
        known_ns = max(arrived_ns, min(complete_ns, default=0))
        times = self._tracks[prism].times_ns
        before = int(times.searchsorted(known_ns, side="right"))
        if not before:
            return arrived_ns
        last_ns = int(times[before - 1])
        return arrived_ns if arrived_ns >= last_ns + self._limits.outage_limit_ns else last_ns

    def _complete_at_ns(self, prism: int, epoch_ns: int) -> int | None:
        """Return up to when everything must have arrived to decide an epoch; None if nothing is waited for."""
        times = self._tracks[prism].times_ns
        after = int(np.searchsorted(times, epoch_ns))
        lost_ns = epoch_ns
        if after:
            lost_ns = max(epoch_ns, int(times[after - 1]) + self._limits.outage_limit_ns)
        if after == len(times):
            return lost_ns
        bracket_ns = int(times[after])
        trackers = [self._completeness[station] for station in self._trackers[prism]]
        incomplete = [each for each in trackers if each.complete_ns(self._now_ns) < bracket_ns]
        if not incomplete:
            return None
        # The gaps may end before the bracket itself is old enough.
        gaps_ns = max(each.last_gap_end_ns(bracket_ns) or bracket_ns for each in incomplete)
        return min(bracket_ns, lost_ns, gaps_ns)

    def _discard_before(self, epoch_ns: int) -> None:
        for prism, track in self._tracks.items():
            self._tracks[prism] = track.since(epoch_ns)
            times = self._unusable_ns[prism] = sorted(self._unusable_ns[prism])
            # Of the past, only the newest one before the epoch can still be a reason.
            del times[: max(0, bisect.bisect_right(times, epoch_ns) - 1)]

    def _poses(self, epochs_ns: NDArray[np.int64]) -> PoseBatch:
        batch = PoseBatch.blank(epochs_ns, self._prisms)
        tracks = [self._tracks[prism] for prism in self._prisms]
        samples = Track.joined(tracks)
        between = interpolate_prisms(
            samples.times_ns,
            samples.points_m,
            [len(track) for track in tracks],
            epochs_ns,
            self._limits.outage_limit_ns,
        )
        self._describe(batch, tracks, between)
        batch.reason[:] = batch.prism_reason.max(axis=1)

        usable_rows = np.flatnonzero(batch.valid)
        if len(usable_rows):
            self._fit(batch, usable_rows, samples, between)
        batch.degraded[:] = degradations(batch, np.zeros((len(batch), 2)), self._limits)
        return poses_at(batch, self._parameters.reference_point)

    def _describe(self, batch: PoseBatch, tracks: Sequence[Track], between: Interpolated) -> None:
        """Fill in each prism's reason, and station and age of its last measurement."""
        epochs_ns = batch.stamp_ns
        batch.prism_reason[~between.valid] = Reason.OUTAGE
        for column, (prism, track) in enumerate(zip(self._prisms, tracks, strict=True)):
            latest = track.times_ns.searchsorted(epochs_ns, side="right") - 1
            known = latest >= 0
            batch.station[:, column] = self._home_station.get(prism, 0)
            batch.station[known, column] = track.stations[latest[known]]
            batch.age_s[known, column] = (epochs_ns[known] - track.times_ns[latest[known]]) / 1e9
            lost = ~between.valid[:, column]
            if self._unusable_ns[prism] and lost.any():
                unusable_ns = np.sort(np.array(self._unusable_ns[prism], dtype=np.int64))
                newest = np.searchsorted(unusable_ns, epochs_ns, side="right") - 1
                since_ns = np.where(known, track.times_ns[latest] if len(track) else 0, -(2**63))
                unusable = lost & (newest >= 0) & (unusable_ns[newest] > since_ns)
                batch.prism_reason[unusable, column] = Reason.STATION_STATUS

    def _fit(self, batch: PoseBatch, rows: NDArray[np.intp], samples: Track, between: Interpolated) -> None:
        """Fit the layout to the prisms in the rows where all of them are known."""
        points, velocities = between.points[rows], between.velocities_mps[rows]
        covariances = _interpolated_covariances(samples, between, rows)
        error_s2 = interpolation_error_s2(between.fraction[rows], between.gap_ns[rows])
        poses = poses_from_prisms(self._layout, points)
        batch.reason[rows[poses.degenerate]] = Reason.DEGENERATE_GEOMETRY
        fitted = ~poses.degenerate
        rows, rotation, residual = rows[fitted], poses.rotation[fitted], poses.rms_m[fitted]
        velocity, angular_velocity = twists(self._layout, rotation, velocities[fitted])
        batch.position_m[rows] = poses.translation_m[fitted]
        batch.orientation_xyzw[rows] = quaternion_from_rotation(rotation)
        common_errors = interpolation_errors(
            self._layout,
            rotation,
            error_s2[fitted],
            acceleration_sigma_mps2=self._limits.acceleration_sigma_mps2,
            angular_acceleration_sigma_radps2=self._limits.angular_acceleration_sigma_radps2,
        )
        if self._uncertainty is not None:
            setup_errors = self._uncertainty.displacements(
                points[fitted], velocities[fitted], batch.station[rows], rotation
            )
            displacement = pose_displacement(self._layout, rotation, setup_errors)
            batch.covariance_common[rows] = displacement @ displacement.swapaxes(1, 2)
            common_errors = np.concatenate([common_errors, setup_errors], axis=3)
        displacement = pose_displacement(self._layout, rotation, common_errors)
        covariance = pose_covariance(self._layout, rotation, covariances[fitted])
        covariance += displacement @ np.ascontiguousarray(displacement.swapaxes(1, 2))
        misfit, freedom = squared_misfit(
            self._layout,
            rotation,
            poses.translation_m[fitted],
            points[fitted],
            covariances[fitted],
            common_errors,
        )
        batch.covariance[rows] = covariance_scale(misfit, freedom)[:, None, None] * covariance
        batch.velocity_mps[rows] = velocity
        batch.angular_velocity_radps[rows] = angular_velocity
        batch.residual_m[rows] = residual
        batch.prism_residual_m[rows] = poses.residuals_m[fitted]
        batch.reason[rows[rotation[:, 2, 2] <= math.cos(self._limits.tilt_limit_rad)]] = Reason.TILT
        batch.reason[rows[residual > self._limits.residual_limit_m]] = Reason.RESIDUAL


def _interpolated_covariances(
    samples: Track, between: Interpolated, rows: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return covariances (R, P, 3, 3) of interpolated positions, from instrument noise and uncertain times."""
    after, fraction = between.after[rows], between.fraction[rows]
    before = after - 1
    covariance = interpolated_covariance(
        samples.covariances_m2[before], samples.covariances_m2[after], fraction
    )
    sigmas_s = samples.time_sigmas_ns / 1e9
    time_variance = (1.0 - fraction) ** 2 * sigmas_s[before] ** 2 + fraction**2 * sigmas_s[after] ** 2
    velocity = between.velocities_mps[rows]
    return np.add(
        covariance, time_variance[..., None, None] * velocity[..., :, None] * velocity[..., None, :]
    )
