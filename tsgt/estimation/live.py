"""Live estimation: measurements and samples of the IMU in; these and poses out, in the order of stream and recording. Sans-I/O.

The output depends only on the order of the calls and their instants, which are recorded. So a replay, which makes the same
calls, gives the same lines bit for bit.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from tsgt.estimation.continuous import ContinuousEstimator
from tsgt.estimation.inertial import ImuSetupMonitor, start_now
from tsgt.estimation.linear import LinearEstimator

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.estimation.inertial import ImuState, StartCheck
    from tsgt.model import ImuSamples, Measurement, OdometrySamples, Parameters
    from tsgt.recording import EventRecord, PoseRecord


class LiveEstimator:
    """Turns arriving measurements into records: each measurement, followed by the poses that it completes.

    With parameters that allow no poses (``no_poses``) there are none, and no deadlines.

    ``start_check``: how a check of the IMU's set-up is computed.
    """

    def __init__(self, parameters: Parameters, start_check: StartCheck = start_now) -> None:
        calibrated = parameters.no_poses is None
        self._setup = None
        if calibrated and parameters.imu is not None:
            self._setup = ImuSetupMonitor(parameters, start_check)
        self._continuous: ContinuousEstimator | None = None
        self._estimator: ContinuousEstimator | LinearEstimator | None = None
        if calibrated and parameters.pipeline.estimator == "continuous":
            self._estimator = self._continuous = ContinuousEstimator(parameters, self._setup)
        elif calibrated:
            self._estimator = LinearEstimator(parameters)
        self._with_imu = None if parameters.imu is None else self._continuous
        self._now_ns = -(2**63)
        self._begun = False

    def measurement(self, measurement: Measurement) -> list[Measurement | PoseRecord]:
        """Take a measurement at its ``received_ns``; return it after the poses due before it, before those it completes.

        A ``received_ns`` before an earlier call's instant is set to the latter, in the record too: a replay must pass on
        the measurement at the same point.
        """
        if measurement.received_ns < self._now_ns:
            measurement = dataclasses.replace(measurement, received_ns=self._now_ns)
        if self._estimator is None:
            self.advance(measurement.received_ns)
            return [measurement]
        if not self._begun:
            self._estimator.begin_at(measurement.received_ns)
            self._begun = True
        due = self.advance(measurement.received_ns)
        self._estimator.add(measurement)
        if self._setup is not None:
            self._setup.measurement(measurement)
        return [*due, measurement, *self.advance(measurement.received_ns)]

    def imu_samples(self, samples: ImuSamples) -> list[ImuSamples | PoseRecord]:
        """Take samples of the IMU at their ``received_ns``, as :meth:`measurement`; return them after the poses due before."""
        if self._with_imu is None:
            self._check_setup(samples)
            return [samples]
        if samples.received_ns < self._now_ns:
            samples = dataclasses.replace(samples, received_ns=self._now_ns)
        due = self.advance(samples.received_ns)
        self._with_imu.add_samples(samples)
        self._check_setup(samples)
        return [*due, samples]

    def odometry_samples(self, samples: OdometrySamples) -> list[OdometrySamples | PoseRecord]:
        """Take samples of the wheel odometry, as :meth:`imu_samples`."""
        if self._with_imu is None:
            return [samples]
        if samples.received_ns < self._now_ns:
            samples = dataclasses.replace(samples, received_ns=self._now_ns)
        due = self.advance(samples.received_ns)
        self._with_imu.add_odometry(samples)
        return [*due, samples]

    def _check_setup(self, samples: ImuSamples) -> None:
        if self._setup is not None:
            self._setup.samples(samples)

    def advance(self, now_ns: int) -> list[PoseRecord]:
        """Return the poses that are due by now; call it before another record is published."""
        self._now_ns = max(self._now_ns, now_ns)
        return [] if self._estimator is None else list(self._estimator.advance(self._now_ns).records())

    def imu_setup_events(self) -> Sequence[EventRecord]:
        """Return the events on the set-up of the IMU since the last call; a replay finds them in its recording."""
        return () if self._setup is None else self._setup.take_events()

    @property
    def imu_shocks(self) -> int:
        """Number of shocks after which no drive has confirmed the IMU's set-up, those before the start included."""
        return 0 if self._setup is None else self._setup.shocks

    def outside_lag_window(self) -> Mapping[int, int] | None:
        """Return by station how many measurements arrived outside the lag window; None with ``linear``."""
        return None if self._continuous is None else self._continuous.outside_lag_window

    def imu_state(self) -> ImuState | None:
        """Return what the estimator knows of the IMU; None if it uses none."""
        return None if self._continuous is None else self._continuous.imu_state()

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`advance` has to be called if nothing arrives before; None while nothing is due."""
        return None if self._estimator is None else self._estimator.next_deadline_ns()
