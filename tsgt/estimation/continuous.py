"""The estimator ``continuous``, live. Sans-I/O.

Each epoch (the whole multiples of a period in Unix time) gets a pose *predicted* from all measurements that were added
before, and a lag later one *smoothed* by the measurements on both sides. Smoothed poses are computed in groups, with the
first prediction of each half second, which is cheaper. At each of the configured delays below the lag there is one more,
smoothed by the measurements that have arrived by the first epoch at which the delay has passed. With an IMU the predictions
integrate its samples from the newest measurement on; :mod:`~tsgt.estimation.inertial.selection` says when it is used. The poses depend only on the order of the calls, not on when the
estimator is asked: a replay gives the same poses bit for bit.
"""

from __future__ import annotations

import bisect
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation.inertial.selection import ImuSelector, unconfirmed_covariance
from tsgt.estimation.noise_scales import noise_scales
from tsgt.estimation.observations import build_observations, centroid_m
from tsgt.estimation.pose_batch import Degradation, Kind, PoseBatch, Reason
from tsgt.estimation.pose_cache import PoseCache, SmoothedStateCache
from tsgt.estimation.pose_output import ContinuousPoseOutput, MeasurementHistory
from tsgt.estimation.setup_uncertainty import InertialSetupUncertainty, setup_jacobian
from tsgt.estimation.tracks import has_plausible_time, measured_at_ns, usable
from tsgt.geometry import check_layout
from tsgt.geometry.batch import scale_noise
from tsgt.geometry.inertial import InertialFixedLagSmoother, SaturationMonitor
from tsgt.geometry.trajectory import POSE_DIM, FixedLagSmoother, concatenate_states
from tsgt.model import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.estimation.inertial import ImuSetupMonitor, ImuState
    from tsgt.estimation.pose_output import PoseNumbers
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import MeasurementWindow, States
    from tsgt.model import ImuSamples, Measurement, OdometrySamples, Parameters

SMOOTHING_INTERVAL_NS = 500_000_000
TILTED = 2  # Successive measurements by which a single instrument that is not level has moved

_NONE = np.empty((0, POSE_DIM, POSE_DIM))


class ContinuousEstimator:
    """The estimator ``continuous``, with the interface of :class:`~tsgt.estimation.linear.LinearEstimator`.

    ``imu_setup``: monitors the set-up of the IMU, fed beside; None: nothing does. ``outside_lag_window``: by station, how many measurements arrived after the poses of their time had been smoothed.
    Raises DegenerateGeometryError if prisms of the layout coincide or, without an IMU, are fewer than three or collinear.
    """

    def __init__(self, parameters: Parameters, imu_setup: ImuSetupMonitor | None = None) -> None:
        self._parameters = parameters
        self._limits = parameters.pipeline
        self._columns = {prism.prism: column for column, prism in enumerate(parameters.prisms)}
        layout = [prism.position_m for prism in parameters.prisms]
        check_layout(layout, names=tuple(self._columns), imu=parameters.imu is not None)
        self._stations = {station.station: station for station in parameters.stations}
        self._noise_scales = noise_scales(parameters)
        self._poses = ContinuousPoseOutput(parameters)
        self._without_imu = FixedLagSmoother(self._limits.motion, setup_jacobian(parameters))
        # What one window with the IMU has learned of the device's limits holds for the next.
        self._saturation = None if parameters.imu is None else SaturationMonitor(parameters.imu)
        self._imu = (
            None
            if parameters.imu is None
            else ImuSelector(
                parameters.imu,
                self._without_imu,
                self._create_with_imu,
                imu_setup,
                prisms=len(layout),
                odometry=parameters.odometry,
            )
        )
        self._pending: list[Measurement] = []
        self._tilted = 0  # Successive measurements whose instrument was not level
        none = np.empty(0, np.int64)
        self._unusable: list[list[int]] = [[] for _ in self._columns]
        self._history = MeasurementHistory(
            none, none, none.astype(np.intp), np.empty(0), [none for _ in self._columns]
        )
        self._origin_ns = 0
        self._next_epoch_ns: int | None = None
        self._next_smoothed_ns = 0
        self._first_epoch_ns = 0
        self._pose_cache = PoseCache(self._without_imu, self._poses, self._limits.period_ns)
        self._smoothed_cache = SmoothedStateCache(self._limits.period_ns)
        # The oldest epoch first. The window still has the states: a delay is below the lag.
        self._delays_ns = [*sorted(self._limits.smoothed_delays_ns, reverse=True), 0]
        # In whole periods
        self._ages_ns = [
            -(-each // self._limits.period_ns) * self._limits.period_ns for each in self._delays_ns
        ]
        self.outside_lag_window: Counter[int] = Counter()
        self._none = PoseBatch.blank(none, tuple(self._columns), Kind.PREDICTED)

    def imu_state(self) -> ImuState | None:
        """Return what is known of the IMU; None without one."""
        return None if self._imu is None else self._imu.state()

    @property
    def _window(self) -> MeasurementWindow:
        return self._without_imu if self._imu is None else self._imu.window

    def _create_with_imu(self, min_prisms: int) -> InertialFixedLagSmoother:
        assert self._parameters.imu is not None  # noqa: S101 (only called with one)
        uncertainty = InertialSetupUncertainty.of(self._parameters)
        return InertialFixedLagSmoother(
            self._parameters.imu,
            self._limits.motion,
            reference_m=centroid_m(self._parameters),
            setup_jacobian=uncertainty.setup_jacobian,
            mounting_factor=uncertainty.mounting_factor,
            odometry=self._parameters.odometry,
            saturation=self._saturation,
            min_prisms=min_prisms,
        )

    def begin_at(self, now_ns: int) -> None:
        """Start with the first epoch after an instant."""
        if self._next_epoch_ns is None:
            self._origin_ns = now_ns
            if self._imu is not None:
                self._imu.begin(now_ns)
            self._next_epoch_ns = (now_ns // self._limits.period_ns + 1) * self._limits.period_ns
            self._next_smoothed_ns = self._first_epoch_ns = self._next_epoch_ns

    def add(self, measurement: Measurement) -> None:
        """Add a measurement; implausible ones and those of unknown stations or prisms are ignored."""
        station, column = self._stations.get(measurement.station), self._columns.get(measurement.prism)
        if station is None or column is None or not has_plausible_time(measurement, station):
            return
        self.begin_at(measurement.received_ns)
        self._tilted = self._tilted + 1 if measurement.status is Status.TILT else 0
        if self._imu is not None and len(self._columns) == 1 and self._tilted == TILTED:
            self._imu.contradict()
        if usable(measurement):
            self._pending.append(measurement)
        else:
            bisect.insort(self._unusable[column], measured_at_ns(measurement, station))
            self._update_unusable()

    def add_samples(self, samples: ImuSamples) -> None:
        """Add samples of the IMU; ignored where none is configured."""
        if self._imu is not None:
            self._imu.add_samples(samples)

    def add_odometry(self, samples: OdometrySamples) -> None:
        """Add samples of the wheel odometry; ignored where no IMU or no odometry is configured."""
        if self._imu is not None:
            self._imu.add_odometry(samples)

    def advance(self, now_ns: int) -> PoseBatch:
        """Return the predicted poses of new epochs up to now, and the poses that are smoothed with them."""
        batches: list[PoseBatch] = []
        while self._next_epoch_ns is not None and self._next_epoch_ns <= now_ns:
            epoch_ns, period_ns = self._next_epoch_ns, self._limits.period_ns
            jump_from = self._take_pending(epoch_ns)
            if epoch_ns // SMOOTHING_INTERVAL_NS != (epoch_ns - period_ns) // SMOOTHING_INTERVAL_NS:
                batches.append(self._smoothed_until(epoch_ns - self._limits.lag_ns))
            batches.append(self._due(epoch_ns, jump_from))
            self._next_epoch_ns = epoch_ns + period_ns
        return PoseBatch.concatenated(batches or [self._none])

    def next_deadline_ns(self) -> int | None:
        """Return when the next pose is due; None before the first measurement."""
        return self._next_epoch_ns

    def _take_pending(self, epoch_ns: int) -> States | None:
        """Use the measurements that were added; with an IMU return what was predicted for an epoch, if that has changed."""
        if self._imu is None:
            self._use_pending()
            return None
        epoch_s = (epoch_ns - self._origin_ns) / 1e9
        self._imu.take_samples()
        before, window = None, self._window
        if self._pending and window.converged:
            before = window.predict(epoch_s, dim=POSE_DIM)[0]
        self._use_pending()
        self._imu.choose(epoch_s)
        if self._window is not window:
            self._record(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.intp))
            if before is None and window.converged:
                before = window.predict(epoch_s, dim=POSE_DIM)[0]
        return before if self._window.converged else None

    def _use_pending(self) -> None:
        if not self._pending:
            return
        observations, sources = build_observations(self._parameters, self._pending, origin_ns=self._origin_ns)
        self._pending.clear()
        # A station may deliver a backlog of hours.
        target = self._imu or self._without_imu
        late = observations.time_s < max(target.horizon_s, -self._limits.lag_ns / 1e9)
        self.outside_lag_window.update(
            source.station for source, is_late in zip(sources, late, strict=True) if is_late
        )
        times_ns = np.array([measured_at_ns(m, self._stations[m.station]) for m in sources], dtype=np.int64)
        stations = np.array([m.station for m in sources], dtype=np.int64)
        known = set(zip(self._history.times_ns.tolist(), self._history.stations.tolist(), strict=True))
        repeated = [key in known for key in zip(times_ns.tolist(), stations.tolist(), strict=True)]
        taken = ~late & ~np.array(repeated, dtype=bool)
        if not taken.any():
            return
        if not taken.all():
            observations = observations.select(taken)
        target.update(scale_noise(observations, self._noise_scales))
        self._record(times_ns[taken], stations[taken], observations.prism)

    def _record(
        self, times_ns: NDArray[np.int64], stations: NDArray[np.int64], prisms: NDArray[np.intp]
    ) -> None:
        history = self._history
        times_ns = np.concatenate([history.times_ns, times_ns])
        stations = np.concatenate([history.stations, stations])
        prisms = np.concatenate([history.prisms, prisms])
        places = {station: place for place, station in enumerate(self._stations)}
        rows = np.array([places[station] for station in stations.tolist()])
        order = np.lexsort((rows, prisms, times_ns))
        # What the window has marginalised, or not taken yet, precedes the rest, which has the same order.
        found_m = np.linalg.norm(self._window.residuals_m, axis=1)
        residuals_m = np.concatenate([history.residuals_m[: len(order) - len(found_m)], found_m])
        self._history = MeasurementHistory(
            times_ns[order],
            stations[order],
            prisms[order],
            residuals_m,
            history.unusable_ns,
        )

    def _due(self, epoch_ns: int, jump_from: States | None) -> PoseBatch:
        """Return the predicted pose of an epoch after the smoothed ones whose delay has passed with it."""
        # Those of epochs that had a predicted pose
        count = sum(epoch_ns - age_ns >= self._first_epoch_ns for age_ns in self._ages_ns)
        ages_ns, delays_ns = self._ages_ns[-count:], self._delays_ns[-count:]
        stamps_ns = [epoch_ns - age_ns for age_ns in ages_ns]
        window, time_s = self._window, self._times_s(stamps_ns)
        numbers: PoseNumbers | None = None
        jump: tuple[float, float] | None = None
        if window.initialised:
            if self._imu is None:
                numbers = self._pose_cache.due(epoch_ns, ages_ns, self._origin_ns)
            else:
                states, covariance, common = self._states_at(stamps_ns)
                numbers = self._poses.numbers(states, self._with_allowance(covariance), common)
                if jump_from is not None:
                    jump = self._poses.distance(jump_from, states.select(slice(-1, None)))
        batch = self._poses.due(
            stamps_ns,
            delays_ns,
            epoch_ns,
            self._history,
            numbers,
            converged=[
                *self._converged_at(time_s[:-1]).tolist(),
                window.converged and not window.ambiguous,
            ],
            ambiguous=window.recently_ambiguous_at(time_s).tolist(),
        )
        if jump is not None:
            batch.jump[-1] = jump
        return self._with_imu_use(batch)

    def _states_at(self, stamps_ns: list[int]) -> tuple[States, FloatArray, FloatArray | None]:
        """Return states, their covariance and its common part at epochs: smoothed, and at the last one predicted."""
        *smoothed_ns, epoch_ns = stamps_ns
        time_s = float((epoch_ns - self._origin_ns) / 1e9)
        states, covariance = self._window.predict(time_s, dim=POSE_DIM)
        common = self._window.common_at(time_s, dim=POSE_DIM)
        if not smoothed_ns:
            return states, covariance, common
        smoothed, smoothed_covariance, smoothed_common = self._smoothed_cache.at(
            self._window.smoothed_trajectory(), smoothed_ns, self._origin_ns
        )
        if common is not None and smoothed_common is not None:
            common = np.concatenate([smoothed_common, common])
        return (
            concatenate_states([smoothed, states]),
            np.concatenate([smoothed_covariance, covariance]),
            common,
        )

    def _times_s(self, stamps_ns: Sequence[int]) -> FloatArray:
        """(N,) times on the trajectory's scale."""
        return (np.array(stamps_ns, dtype=np.int64) - self._origin_ns) / 1e9

    def _converged_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether the trajectory is reliable at times, (N,), that have been smoothed."""
        reliable = (time_s >= self._window.reliable_from_s) & (time_s < self._window.ambiguous_from_s)
        reliable &= ~self._window.ambiguous_at(time_s)
        return np.asarray(reliable & self._window.converged)

    def _with_imu_use(self, batch: PoseBatch) -> PoseBatch:
        """Fill in whether poses rest on the IMU."""
        if self._imu is not None:
            batch.imu[:] = self._imu.use
            if self._imu.station_contradicted:
                batch.reason[batch.valid] = Reason.CONTRADICTED
                batch.degraded[:] = 0
            if self._imu.disagrees:
                batch.degraded[batch.valid] |= Degradation.IMU_DISAGREES
            if self._imu.unconfirmed:
                # Over an outage what is wrong in the set-up grows far beyond the allowance.
                unseen = batch.valid & (batch.prism_reason != int(Reason.VALID)).all(axis=1)
                batch.reason[unseen], batch.degraded[unseen] = Reason.OUTAGE, 0
                batch.degraded[batch.valid] |= Degradation.IMU_UNCONFIRMED
        return batch

    def _with_allowance(self, covariance: FloatArray) -> FloatArray:
        """Return the (N, 6, 6) covariance of poses, with what an unconfirmed set-up of the IMU may have wrong."""
        if self._imu is None or not self._imu.unconfirmed:
            return covariance
        return covariance + unconfirmed_covariance(self._imu.shocks)

    def _smoothed_until(self, last_ns: int) -> PoseBatch:
        """Return the smoothed poses of the epochs up to an instant, and discard what only they needed."""
        stamp_ns = np.arange(self._next_smoothed_ns, last_ns + 1, self._limits.period_ns, dtype=np.int64)
        if not len(stamp_ns):
            return self._none
        poses = self._smoothed(stamp_ns)
        self._next_smoothed_ns = int(stamp_ns[-1]) + self._limits.period_ns
        self._discard_old()
        return poses

    def _smoothed(self, stamp_ns: NDArray[np.int64]) -> PoseBatch:
        """Return the smoothed poses of epochs in the window, as far as they are final."""
        states: States | None = None
        covariance = _NONE
        common: FloatArray | None = None
        time_s = (stamp_ns - self._origin_ns) / 1e9
        if self._window.initialised:
            trajectory = self._window.smoothed_trajectory()
            states, covariance = trajectory.at(time_s, dim=POSE_DIM)
            common = trajectory.common_at(time_s, dim=POSE_DIM)
        return self._with_imu_use(
            self._poses.smoothed(
                stamp_ns,
                self._history,
                states,
                self._with_allowance(covariance),
                common=common,
                converged=self._converged_at(time_s),
                ambiguous=self._window.recently_ambiguous_at(time_s),
            )
        )

    def _update_unusable(self) -> None:
        unusable_ns = [np.array(each, dtype=np.int64) for each in self._unusable]
        self._history = replace(self._history, unusable_ns=unusable_ns)

    def _discard_old(self) -> None:
        (self._imu or self._without_imu).marginalise_before((self._next_smoothed_ns - self._origin_ns) / 1e9)
        history = self._history
        kept = history.times_ns >= self._next_smoothed_ns - self._limits.outage_limit_ns
        held = len(self._window.residuals_m) if self._imu is None else self._imu.held
        kept[len(kept) - held :] = True
        for column, unusable_ns in enumerate(self._unusable):
            kept[np.flatnonzero(history.prisms == column)[-1:]] = True  # the last one is needed for its age
            del unusable_ns[: max(0, bisect.bisect_right(unusable_ns, self._next_smoothed_ns) - 1)]
        self._history = MeasurementHistory(
            history.times_ns[kept],
            history.stations[kept],
            history.prisms[kept],
            history.residuals_m[kept],
            (),
        )
        self._update_unusable()
