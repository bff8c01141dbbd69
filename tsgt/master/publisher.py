"""Publishes everything that leaves the master, in one order: to the stream, to the recording and to the observers.

A record with a stamp follows all poses that were due by that stamp. A replay makes the same calls with the same
instants and gives the same lines bit for bit.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

from tsgt.estimation import LiveEstimator, start_now
from tsgt.master import link_events
from tsgt.model import PolarMeasurement
from tsgt.recording import EventRecord, PoseRecord, encode_line

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.estimation import OdometryState, StartCheck
    from tsgt.master.station_events import StationEventDetector
    from tsgt.master.statistics import Statistics
    from tsgt.model import ImuSamples, Measurement, OdometrySamples, Parameters
    from tsgt.recording import (
        BeaconRecord,
        ClockRecord,
        DiskStatus,
        ImuStatus,
        OdometryStatus,
        RecordingStatus,
        SetupRecord,
        StatusRecord,
    )


class Observer:
    """Sees poses and measurements when they are published, and may add events."""

    def pose(self, _record: PoseRecord, _now_ns: int, /) -> Sequence[EventRecord]:
        """Take a pose that was published at an instant."""
        return ()

    def status(self, _record: StatusRecord, /) -> Sequence[EventRecord]:
        """Take a status."""
        return ()

    def measurement(self, _record: Measurement, /) -> Sequence[EventRecord]:
        """Take a measurement."""
        return ()

    def tick(self, _now_ns: int, /) -> Sequence[EventRecord]:
        """Return the events of time-outs that have expired."""
        return ()

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`tick` has to be called; None while no time-out is running."""
        return None


class Publisher:
    """Turns link events into records, puts them in order and emits them.

    Parameters
    ----------
    observers
        See each pose and measurement.
    emit
        Takes each record with its encoded line.
    now_ns
        Returns the present on the master's Unix clock.
    start_check
        How a check of the IMU's set-up is computed.
    """

    def __init__(
        self,
        parameters: Parameters,
        statistics: Statistics,
        detector: StationEventDetector,
        observers: Sequence[Observer],
        emit: Callable[[object, bytes], None],
        now_ns: Callable[[], int],
        start_check: StartCheck = start_now,
    ) -> None:
        self._start_check = start_check
        self._estimator = LiveEstimator(parameters, start_check)
        self._statistics = statistics
        self._no_poses = parameters.no_poses
        self._detector = detector
        self._observers = observers
        self._emit = emit
        self._now_ns = now_ns
        self._changed = asyncio.Event()

    def set_up(
        self, parameters: Parameters, observers: Sequence[Observer], record: Callable[[bytes], None]
    ) -> None:
        """Publish the poses that are due by now, and restart with other parameters; ``record`` takes their line.

        The set-up record has to follow, as in a replay.
        """
        estimator = LiveEstimator(parameters, self._start_check)
        self.advance(self._now_ns())
        record(encode_line(parameters))
        self._estimator = estimator
        self._no_poses = parameters.no_poses
        self._observers = observers

    def report(self, event: link_events.LinkEvent) -> None:
        """Count and publish what a link reports, with the events that follow from it."""
        statistics, detector, now_ns = self._statistics, self._detector, self._now_ns()
        match event:
            case link_events.MeasurementReceived(measurement):
                self.measurement(measurement)
                self._put_all(detector.measurement(measurement, now_ns))
            case link_events.StationResponded(station, rssi_dbm, snr_db):
                statistics.exchange(station, responded=True)
                self._put_all(detector.exchange(station, now_ns, responded=True))
                statistics.packet(station, now_ns, rssi_dbm=rssi_dbm, snr_db=snr_db)
            case link_events.NoResponse(station):
                statistics.exchange(station, responded=False)
                self._put_all(detector.exchange(station, now_ns, responded=False))
            case link_events.ReplyReceived(station):
                self._put_all(detector.reply(station, now_ns))
            case link_events.BeaconSent(record) | link_events.ClockUpdate(record):
                self.put(record)
            case link_events.SuperframeState():
                statistics.superframe_state(event)
                self._put_all(detector.battery(event.station, event.condition.battery_percent, now_ns))
            case link_events.TrackedPrism(station, prism):
                statistics.tracked_prism(station, prism)
            case link_events.TrackingResult(station, prism, tracks):
                self._put_all(detector.tracking_result(station, prism, now_ns, tracks=tracks))
            case link_events.ClockStepped(station):
                self.put(detector.clock_stepped(station, now_ns))
            case link_events.BeaconTimeRejected(station, count):
                self.put(detector.beacon_time_rejected(station, now_ns, count))
            case link_events.LinkDelayAnomaly(station):
                self.put(detector.link_delay_anomaly(station, now_ns))
            case link_events.MasterEvent(name, message):
                if name == "radio_failed":
                    statistics.radio_failed()
                self.put(EventRecord(stamp_ns=now_ns, event=name, message=message))

    def publish_status(
        self,
        link: link_events.LinkStatus,
        imu: ImuStatus | None = None,
        recording: RecordingStatus | None = None,
        disk: DiskStatus | None = None,
        *,
        odometry: OdometryStatus | None = None,
        realtime_ns: int,
    ) -> StatusRecord:
        """Publish the events of expired time-outs and a status record; ``realtime_ns`` is the machine's Unix clock."""
        now_ns = self._now_ns()
        self._put_all(self._detector.tick(now_ns, realtime_ns=realtime_ns))
        state = self._estimator.imu_state()
        if imu is not None and state is not None:
            imu = replace(
                imu,
                use=state.use.word,
                disagreement=state.disagreement,
                gyro_bias_radps=state.gyro_bias_radps,
                accelerometer_bias_mps2=state.accelerometer_bias_mps2,
            )
        if odometry is not None and state is not None and state.odometry is not None:
            odometry = _with_estimate(odometry, state.odometry)
        status = self._statistics.status(now_ns, link, imu, recording, disk, odometry=odometry)
        status = replace(status, no_poses=self._no_poses)
        self.put(status)
        for observer in self._observers:
            self._put_all(observer.status(status))
        return status

    def measurement(self, measurement: Measurement) -> None:
        """Publish a measurement and the poses that it completes."""
        self._send(self._estimator.measurement(measurement), measurement.received_ns)
        self._put_all(self._estimator.imu_setup_events())

    def imu_samples(self, samples: ImuSamples) -> None:
        """Record samples of the IMU, in the order of arrival among all other lines, after the poses due before them."""
        self._send(self._estimator.imu_samples(samples), samples.received_ns)

    @property
    def imu_shocks(self) -> int:
        """Number of shocks of the IMU, see :class:`~tsgt.estimation.LiveEstimator`."""
        return self._estimator.imu_shocks

    def odometry_samples(self, samples: OdometrySamples) -> None:
        """Record samples of the wheel odometry likewise."""
        self._send(self._estimator.odometry_samples(samples), samples.received_ns)

    def put(self, record: SetupRecord | StatusRecord | EventRecord | ClockRecord | BeaconRecord) -> None:
        """Publish a record after the poses that are due by its stamp."""
        self._send([*self._estimator.advance(record.stamp_ns), record], record.stamp_ns)

    def advance(self, now_ns: int) -> None:
        """Publish the poses that are due by now, and the observers' events."""
        self._send(self._estimator.advance(now_ns), now_ns)
        for observer in self._observers:
            self._put_all(observer.tick(now_ns))

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`advance` has to be called if nothing happens before."""
        deadlines_ns = [
            self._estimator.next_deadline_ns(),
            *(observer.next_deadline_ns() for observer in self._observers),
        ]
        return min((deadline_ns for deadline_ns in deadlines_ns if deadline_ns is not None), default=None)

    async def changed(self) -> None:
        """Return when something was published since the last call: the next deadline may have changed."""
        await self._changed.wait()
        self._changed.clear()

    def _put_all(self, events: Sequence[EventRecord]) -> None:
        for event in events:
            self.put(event)

    def _send(self, records: Sequence[object], now_ns: int) -> None:
        events: list[EventRecord] = []
        for record in records:
            self._emit(record, encode_line(record))
            if isinstance(record, PoseRecord):
                if record.kind != "smoothed":  # already counted when it was predicted
                    self._statistics.pose(valid=record.valid)
                for observer in self._observers:
                    events += observer.pose(record, now_ns)
            elif isinstance(record, PolarMeasurement):
                self._statistics.measurement(record)
                for observer in self._observers:
                    events += observer.measurement(record)
        outside_lag_window = self._estimator.outside_lag_window()
        if outside_lag_window is not None:
            self._statistics.outside_lag_window(outside_lag_window)
        self._put_all(events)
        self._changed.set()


def _with_estimate(status: OdometryStatus, state: OdometryState) -> OdometryStatus:
    """Return the status with what the estimator knows."""
    if (wheels := state.wheels) is None:
        return replace(status, use=state.use)
    return replace(
        status,
        use=state.use,
        scale=float(wheels.values[0]),
        scale_sigma=float(wheels.sigmas[0]),
        slip=float(wheels.values[1]),
        slip_sigma=float(wheels.sigmas[1]),
        rejected=wheels.rejected_share,
    )
