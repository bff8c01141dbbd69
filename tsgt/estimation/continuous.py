"""Measurements in, poses out: the estimator ``continuous``, live.

Pure: no clock, no sockets. At each epoch (the whole multiples of a period in Unix time) there is a pose *predicted* from all
measurements that were added before, stamped with the epoch; and for each epoch, a lag later, one *smoothed* by what was
measured on both sides of it. Smoothed poses come some at a time, with the first prediction of each half second: so they
cost less, and nobody is in a hurry for them. What a pose was made from depends on the order of the calls alone, not on
when the pipeline was asked: a replay gives the same poses, bit for bit.
"""

from __future__ import annotations

import bisect
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation.observations import build_observations
from tsgt.estimation.pose_batch import Kind, PoseBatch
from tsgt.estimation.pose_output import ContinuousPoses, Seen
from tsgt.estimation.tracks import believable, measured_at_ns, usable
from tsgt.geometry import FixedLagSmoother, check_layout, concatenate_states

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import States
    from tsgt.model import Measurement, Parameters

SMOOTHED_EVERY_NS = 500_000_000

_POSE = 6
"""Parts of a state's error that poses tell of."""

_NONE = np.empty((0, _POSE, _POSE))


class ContinuousPipeline:
    """The estimator ``continuous``, with the surface of :class:`~tsgt.estimation.linear.Pipeline`.

    Parameters
    ----------
    parameters
        Stations, prisms and limits in force.

    Attributes
    ----------
    outside_lag_window
        By station, how many measurements came when the time of their making had been smoothed for good.

    Raises
    ------
    DegenerateGeometryError
        The prisms of the layout are fewer than three, coincide, or lie in a line.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._limits = parameters.pipeline
        self._columns = {prism.prism: column for column, prism in enumerate(parameters.prisms)}
        check_layout([prism.position_m for prism in parameters.prisms], names=tuple(self._columns))
        self._stations = {station.station: station for station in parameters.stations}
        self._poses = ContinuousPoses(parameters)
        self._window = FixedLagSmoother(self._limits.motion)
        self._pending: list[Measurement] = []
        none = np.empty(0, np.int64)
        self._unusable: list[list[int]] = [[] for _ in self._columns]
        self._seen = Seen(none, none, none.astype(np.intp), np.empty(0), [none for _ in self._columns])
        self._origin_ns = 0
        self._next_epoch_ns: int | None = None
        self._next_smoothed_ns = 0
        self.outside_lag_window: Counter[int] = Counter()
        self._none = PoseBatch.blank(none, tuple(self._columns), Kind.PREDICTED)

    def begin_at(self, now_ns: int) -> None:
        """Make poses from an instant on."""
        if self._next_epoch_ns is None:
            self._origin_ns = now_ns
            self._next_epoch_ns = (now_ns // self._limits.period_ns + 1) * self._limits.period_ns
            self._next_smoothed_ns = self._next_epoch_ns

    def add(self, measurement: Measurement) -> None:
        """Take a measurement; passed over are those that :meth:`Pipeline.add` passes over."""
        station, column = self._stations.get(measurement.station), self._columns.get(measurement.prism)
        if station is None or column is None or not believable(measurement, station):
            return
        self.begin_at(measurement.received_ns)
        if usable(measurement):
            self._pending.append(measurement)
        else:
            bisect.insort(self._unusable[column], measured_at_ns(measurement, station))
            self._see_unusable()

    def advance(self, now_ns: int) -> PoseBatch:
        """Return the poses of all epochs up to now that were not returned before, and those that are smoothed with them."""
        batches: list[PoseBatch] = []
        while self._next_epoch_ns is not None and self._next_epoch_ns <= now_ns:
            epoch_ns, period_ns = self._next_epoch_ns, self._limits.period_ns
            self._take_pending()
            if epoch_ns // SMOOTHED_EVERY_NS != (epoch_ns - period_ns) // SMOOTHED_EVERY_NS:
                batches.append(self._smoothed_until(epoch_ns - self._limits.lag_ns))
            # Up to where the next ones are smoothed they rest on the same.
            next_smoothing_ns = (epoch_ns // SMOOTHED_EVERY_NS + 1) * SMOOTHED_EVERY_NS
            due_ns = range(epoch_ns, min(now_ns + 1, next_smoothing_ns), period_ns)
            batches.append(self._predicted(due_ns))
            self._next_epoch_ns = due_ns[-1] + period_ns
        return PoseBatch.concatenated(batches or [self._none])

    def next_deadline_ns(self) -> int | None:
        """Return when the next pose is due; None before the first measurement."""
        return self._next_epoch_ns

    def _take_pending(self) -> None:
        if not self._pending:
            return
        observations, sources = build_observations(self._parameters, self._pending, origin_ns=self._origin_ns)
        self._pending.clear()
        # A station that has measured for hours without a master may send all of it now.
        late = observations.time_s < max(self._window.horizon_s, -self._limits.lag_ns / 1e9)
        self.outside_lag_window.update(source.station for source, is_late in zip(sources, late, strict=True) if is_late)
        times_ns = np.array([measured_at_ns(m, self._stations[m.station]) for m in sources], dtype=np.int64)
        stations = np.array([m.station for m in sources], dtype=np.int64)
        known = set(zip(self._seen.times_ns.tolist(), self._seen.stations.tolist(), strict=True))
        again = [key in known for key in zip(times_ns.tolist(), stations.tolist(), strict=True)]
        taken = ~late & ~np.array(again, dtype=bool)
        if not taken.any():
            return
        if not taken.all():
            observations = observations.select(taken)
        self._window.update(replace(observations, sigmas_m=observations.sigmas_m * self._limits.noise_scale))
        self._see(times_ns[taken], stations[taken], observations.prism)

    def _see(
        self, times_ns: NDArray[np.int64], stations: NDArray[np.int64], prisms: NDArray[np.intp]
    ) -> None:
        seen = self._seen
        times_ns = np.concatenate([seen.times_ns, times_ns])
        stations = np.concatenate([seen.stations, stations])
        prisms = np.concatenate([seen.prisms, prisms])
        places = {station: place for place, station in enumerate(self._stations)}
        rows = np.array([places[station] for station in stations.tolist()])
        order = np.lexsort((rows, prisms, times_ns))
        # What the window has let go of was before the rest, and the rest is in the same order.
        before = len(order) - len(self._window.residuals_m)
        residuals_m = np.concatenate(
            [seen.residuals_m[:before], np.linalg.norm(self._window.residuals_m, axis=1)]
        )
        self._seen = Seen(
            times_ns[order],
            stations[order],
            prisms[order],
            residuals_m,
            seen.unusable_ns,
        )

    def _predicted(self, epochs_ns: range) -> PoseBatch:
        if not self._window.initialised:
            return self._poses.predicted(epochs_ns, self._seen, None, _NONE)
        settled = np.full(len(epochs_ns), self._window.converged and not self._window.ambiguous)
        found = [
            self._window.predict((epoch_ns - self._origin_ns) / 1e9, dim=_POSE) for epoch_ns in epochs_ns
        ]
        if len(found) == 1:
            return self._poses.predicted(epochs_ns, self._seen, *found[0], settled=settled)
        states = concatenate_states([state for state, _ in found])
        covariance = np.concatenate([each for _, each in found])
        return self._poses.predicted(epochs_ns, self._seen, states, covariance, settled=settled)

    def _smoothed_until(self, last_ns: int) -> PoseBatch:
        """Return the smoothed poses of the epochs up to an instant, and let go of what they needed."""
        stamp_ns = np.arange(self._next_smoothed_ns, last_ns + 1, self._limits.period_ns, dtype=np.int64)
        if not len(stamp_ns):
            return self._none
        states: States | None = None
        covariance = _NONE
        if self._window.initialised:
            states, covariance = self._window.trajectory().at((stamp_ns - self._origin_ns) / 1e9, dim=_POSE)
        time_s = (stamp_ns - self._origin_ns) / 1e9
        sure = (time_s >= self._window.reliable_from_s) & (time_s < self._window.ambiguous_from_s)
        sure &= ~self._window.ambiguous_at(time_s)
        poses = self._poses.smoothed(
            stamp_ns, self._seen, states, covariance, settled=sure & self._window.converged
        )
        self._next_smoothed_ns = int(stamp_ns[-1]) + self._limits.period_ns
        self._forget()
        return poses

    def _see_unusable(self) -> None:
        unusable_ns = [np.array(each, dtype=np.int64) for each in self._unusable]
        self._seen = replace(self._seen, unusable_ns=unusable_ns)

    def _forget(self) -> None:
        self._window.marginalise_before((self._next_smoothed_ns - self._origin_ns) / 1e9)
        seen = self._seen
        kept = seen.times_ns >= self._next_smoothed_ns - self._limits.outage_limit_ns
        kept[len(kept) - len(self._window.residuals_m) :] = True
        for column, unusable_ns in enumerate(self._unusable):
            kept[np.flatnonzero(seen.prisms == column)[-1:]] = True  # the last one, for its age
            del unusable_ns[: max(0, bisect.bisect_right(unusable_ns, self._next_smoothed_ns) - 1)]
        self._seen = Seen(
            seen.times_ns[kept],
            seen.stations[kept],
            seen.prisms[kept],
            seen.residuals_m[kept],
            (),
        )
        self._see_unusable()
