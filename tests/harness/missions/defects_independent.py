"""Planted defects by somebody who had read the user documentation only, not the checkers.

As in `defects.py`, each function replaces one right function by a defective one. What a user would see is in
`benchmarks/missions/independent_defects.py`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.estimation import linear, tracks
from tsgt.estimation.pose_batch import ImuUse, PoseBatch
from tsgt.geometry import rotation_from_quaternion
from tsgt.master import reacquisition_hints, statistics
from tsgt.master.monitors.disk import DiskMonitor
from tsgt.master.publisher import Publisher
from tsgt.master.recording_thread import RecordingThread
from tsgt.master.station_events import StationEventDetector
from tsgt.master.statistics import Statistics
from tsgt.master.stream_server import StreamServer
from tsgt.master.superframe import link as master_link
from tsgt.radio.classic import MeasurementMessage
from tsgt.radio.superframe import condition
from tsgt.recording.setup_record import SetupRecord
from tsgt.station.links.superframe import SuperframeLink
from tsgt.station.session import ClientSession

if TYPE_CHECKING:
    from collections.abc import Callable

    from harness.missions.defects import Planting


# --- Client -----------------------------------------------------------------------------------------------------


def number_from_zero_again(planting: Planting) -> None:
    """Restart the numbers of measurements at 0 at each start of a client."""

    def begin(original: Any) -> Any:
        def defective(self: Any, station: int, prism: int, first_sequence: int = 0) -> None:  # noqa: ARG001
            original(self, station, prism, 0)

        return defective

    planting.replace_attribute(ClientSession, "__init__", begin)


def journal_too_many_acknowledged(planting: Planting) -> None:
    """Journal an acknowledgement that is 40 measurements ahead."""

    def write(original: Any) -> Any:
        def defective(self: Any) -> None:
            self._acknowledged += 40
            original(self)
            self._acknowledged -= 40

        return defective

    planting.replace_attribute(SuperframeLink, "_write_acknowledged", write)


def change_client_status(**constants: Any) -> Callable[[Planting], None]:
    """Return a planting: the status of a client always has these values."""

    def plant(planting: Planting) -> None:
        def status(original: Any) -> Any:
            return lambda *args, **named: replace(original(*args, **named), **constants)

        planting.replace_attribute(ClientSession, "status", status)

    return plant


# --- Radio ------------------------------------------------------------------------------------------------------


def truncate_times(planting: Planting) -> None:
    """Send times in whole 10 ms over classic."""

    def encoded(original: Any) -> Any:
        return lambda self: original(replace(self, time_ns=self.time_ns // 10_000_000 * 10_000_000))

    planting.replace_attribute(MeasurementMessage, "to_bytes", encoded)


def direct_in_wrong_frame(planting: Planting) -> None:
    """Send a station directions in the frame of station 1."""
    planting.replace_attribute(reacquisition_hints, "invert", lambda _: lambda T: np.eye(4) + 0 * T)


def report_full_batteries(planting: Planting) -> None:
    """Report batteries with 30 percentage points more than they have."""

    def items(original: Any) -> Any:
        def defective(found: Any) -> Any:
            percent = found.battery_percent
            more = None if percent is None else min(percent + 30, 100)
            return original(replace(found, battery_percent=more))

        return defective

    planting.replace_attribute(condition, "condition_items", items)


# --- Status and events of the master ----------------------------------------------------------------------------


def change_station_status(change: Callable[[Any], dict[str, Any]]) -> Callable[[Planting], None]:
    """Return a planting: fields of a station's status are changed."""

    def plant(planting: Planting) -> None:
        def status_at(original: Any) -> Any:
            def defective(*arguments: Any) -> Any:
                right = original(*arguments)
                return replace(right, **change(right))

            return defective

        planting.replace_attribute(statistics._Station, "status_at", status_at)

    return plant


def reverse_drain(right: Any) -> dict[str, Any]:
    """Return the drain rate with the other sign, and the time that follows from it."""
    rate_hz = None if right.drain_rate_hz is None else -right.drain_rate_hz
    drain_s = right.outstanding / rate_hz if rate_hz is not None and rate_hz > 0 else None
    return {"drain_rate_hz": rate_hz, "drain_s": drain_s}


def bound_in_microseconds(right: Any) -> dict[str, Any]:
    """Return the bound of the newest stamp in us, as ns."""
    bound_ns = right.stamp_bound_ns
    return {"stamp_bound_ns": None if bound_ns is None else bound_ns // 1000}


def hide_outstanding(right: Any) -> dict[str, Any]:
    """Return that nothing is outstanding."""
    return {"outstanding": None if right.outstanding is None else 0}


def show_neighbours_offset(planting: Planting) -> None:
    """Show each station the clock offset of the next one."""

    def status(original: Any) -> Any:
        def defective(*args: Any, **named: Any) -> Any:
            right = original(*args, **named)
            offsets = [each.clock_offset_ns for each in right.stations]
            moved = zip(right.stations, [*offsets[1:], *offsets[:1]], strict=True)
            return replace(
                right, stations=tuple(replace(each, clock_offset_ns=offset) for each, offset in moved)
            )

        return defective

    planting.replace_attribute(Statistics, "status", status)


def name_next_station(planting: Planting) -> None:
    """Name the next station in the event of a lost one."""

    def tick(original: Any) -> Any:
        def defective(self: Any, now_ns: int, *, realtime_ns: int) -> Any:
            return [
                replace(each, station=each.station % 3 + 1) if each.event == "station_lost" else each
                for each in original(self, now_ns, realtime_ns=realtime_ns)
            ]

        return defective

    planting.replace_attribute(StationEventDetector, "tick", tick)


def omit_events(owner: Any, method: str, name: str) -> Callable[[Planting], None]:
    """Return a planting: a method returns no events of this name."""

    def plant(planting: Planting) -> None:
        def make(original: Any) -> Any:
            def defective(*args: Any, **named: Any) -> Any:
                found = original(*args, **named)
                return [each for each in found if getattr(each, "event", getattr(each, "name", "")) != name]

            return defective

        planting.replace_attribute(owner, method, make)

    return plant


omit_recovered_station = omit_events(StationEventDetector, "exchange", "station_recovered")
omit_recovered_disk = omit_events(DiskMonitor, "update", "disk_recovered")


# --- Estimation -------------------------------------------------------------------------------------------------


def change_batch(change: Callable[[Any], None]) -> Callable[[Planting], None]:
    """Return a planting: arrays of all poses are changed in place before they become records."""

    def plant(planting: Planting) -> None:
        def records(original: Any) -> Any:
            def defective(batch: Any) -> Any:
                batch = batch.select(np.arange(len(batch)))
                change(batch)
                return original(batch)

            return defective

        planting.replace_attribute(PoseBatch, "records", records)

    return plant


def put_w_first(batch: Any) -> None:
    """Give quaternions as w, x, y, z."""
    batch.orientation_xyzw[:] = batch.orientation_xyzw[:, [3, 0, 1, 2]]


def swap_covariance_blocks(batch: Any) -> None:
    """Give rotation before position in the covariance."""
    order = [3, 4, 5, 0, 1, 2]
    batch.covariance[:] = batch.covariance[:, order][:, :, order]


def covariance_about_robot_axes(batch: Any) -> None:
    """Give the covariance of rotations about the robot's axes."""
    rows = np.isfinite(batch.position_m[:, 0])
    turn = np.zeros((int(rows.sum()), 6, 6))
    turn[:, :3, :3] = np.eye(3)
    turn[:, 3:, 3:] = rotation_from_quaternion(batch.orientation_xyzw[rows]).swapaxes(1, 2)
    batch.covariance[rows] = turn @ batch.covariance[rows] @ turn.swapaxes(1, 2)


def angular_velocity_in_world(batch: Any) -> None:
    """Give the angular velocity in the frame of the poses."""
    rows = np.isfinite(batch.position_m[:, 0])
    rotation = rotation_from_quaternion(batch.orientation_xyzw[rows])
    batch.angular_velocity_radps[rows] = np.einsum("nij,nj->ni", rotation, batch.angular_velocity_radps[rows])


def stamp_delayed_late(batch: Any) -> None:
    """Stamp poses at a delay one epoch late."""
    batch.stamp_ns[:] += np.where(batch.delay_ns > 0, 50_000_000, 0)


def forget_degradation(batch: Any) -> None:
    """Call every valid pose good."""
    batch.degraded[:] = 0


def name_other_stations(batch: Any) -> None:
    """Name the wrong station of each prism."""
    batch.station[:] = np.roll(batch.station, 1, axis=1)


def no_jumps(batch: Any) -> None:
    """State that no prediction was moved."""
    batch.jump[:] *= 0


def imu_always_used(batch: Any) -> None:
    """State that every pose rests on the IMU."""
    batch.imu[:] = np.where(batch.imu, int(ImuUse.USED), 0)


def add_constant_twice(planting: Planting) -> None:
    """Add the prism constant twice."""

    def corrected(original: Any) -> Any:
        return lambda slope_m, *, constant_m, ppm: original(slope_m, constant_m=2 * constant_m, ppm=ppm)

    planting.replace_attribute(tracks, "corrected_distance", corrected)


def interpolate_over_outages(planting: Planting) -> None:
    """Interpolate over outages of any length."""

    def interpolated(original: Any) -> Any:
        return lambda times, points, counts, epochs, limit_ns: original(
            times, points, counts, epochs, 20 * limit_ns
        )

    planting.replace_attribute(linear, "interpolate_prisms", interpolated)


def report_bias_in_degrees(planting: Planting) -> None:
    """Report the gyro's bias in degrees per second."""

    def publish_status(original: Any) -> Any:
        def defective(self: Any, *args: Any, **named: Any) -> Any:
            estimator = self._estimator

            class Wrong:
                def __getattr__(self, name: str) -> Any:
                    return getattr(estimator, name)

                def imu_state(self) -> Any:
                    state = estimator.imu_state()
                    bias = None if state is None else state.gyro_bias_radps
                    if bias is None:
                        return state
                    return state._replace(gyro_bias_radps=tuple(57.3 * each for each in bias))

            self._estimator = Wrong()
            try:
                return original(self, *args, **named)
            finally:
                self._estimator = estimator

        return defective

    planting.replace_attribute(Publisher, "publish_status", publish_status)


# --- Recording and stream ---------------------------------------------------------------------------------------


def record_no_status(planting: Planting) -> None:
    """Leave statuses out of the recording."""

    def put(original: Any) -> Any:
        def defective(self: Any, line: bytes) -> None:
            if not line.startswith(b'{"type":"status"'):
                original(self, line)

        return defective

    planting.replace_attribute(RecordingThread, "put", put)


def record_next_beacon(planting: Planting) -> None:
    """Record each beacon with the number of the next one."""

    def record(original: Any) -> Any:
        return lambda **named: original(**{**named, "counter": named["counter"] + 1})

    planting.replace_attribute(master_link, "BeaconRecord", record)


def invert_frames_in_setup(planting: Planting) -> None:
    """Publish the rotations of the stations' frames inverted."""

    def begun(original: Any) -> Any:
        def of(*args: Any, **named: Any) -> Any:
            right = original.__func__(SetupRecord, *args[1:], **named)
            stations = []
            for each in right.stations:
                x, y, z, w = each.orientation_xyzw
                stations.append(replace(each, orientation_xyzw=(-x, -y, -z, w)))
            return replace(right, stations=tuple(stations))

        return classmethod(of)

    planting.replace_attribute(SetupRecord, "of", begun)


def send_no_setup_to_late_readers(planting: Planting) -> None:
    """Greet readers without the set-up in force."""

    def new_reader(original: Any) -> Any:
        def defective(self: Any) -> Any:
            self._setup = b""
            return original(self)

        return defective

    planting.replace_attribute(StreamServer, "_new_reader", new_reader)
