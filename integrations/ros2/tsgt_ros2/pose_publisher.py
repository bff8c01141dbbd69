#!/usr/bin/env python3
"""ROS 2 node that publishes the stream of tsgt-master; besides rclpy it needs tsgt.client (`pip install --no-deps tsgt`).

    python3 pose_publisher.py --ros-args -p source:=/run/tsgt/poses.sock -p world_frame:=map -p robot_frame:=base_link

docs/how-to/use-poses-in-ros-2.md has the topics and parameters.
"""

from __future__ import annotations

import signal
import sys
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from tsgt.client import (
    LIVE,
    Hello,
    Measurement,
    Pose,
    Setup,
    StationStatus,
    Status,
    Stream,
    default_max_age_s,
    measured_point,
    monotonic_ns,
)
from tsgt.errors import ConfigError, TsgtError

if TYPE_CHECKING:
    from collections.abc import Sequence

STREAM_SILENT_S = 2.0  # status lines come every second
STATUS_SILENT_S = 3.0
LATE_PERIODS = 2  # one pose may be missing
LAST_SECOND = 2**31 - 1  # builtin_interfaces/Time has 32 bits

# Of a station, as in tsgt.recording.conditions, which needs more than the client.
MAX_AGE_S = 3.0
MAX_UNASKED_S = 60.0
LOW_BATTERY_PERCENT = 20
UNUSABLE = {
    "angle_only": "no distance",
    "no_target": "no prism",
    "tilt": "not level",
    "wrong_distance": "wrong target",
    "error": "instrument error",
}


class PosePublisher(Node):  # type: ignore[misc]  # rclpy has no types
    """Publishes each line of the stream as it is handed in; the diagnostics once per second."""

    def __init__(self) -> None:
        super().__init__("tsgt_pose_publisher")
        self.source = self._text("source", "/run/tsgt/poses.sock")
        self.key_file = self._text("key_file", "")
        self._series = self._text("series", LIVE)
        self._world_frame = self._text("world_frame", "")
        self._robot_frame = self._text("robot_frame", "")
        self._stamp = self._choice("stamp", "pose", "local")
        reliability = self._choice("reliability", "reliable", "best_effort")
        depth = self.declare_parameter("depth", 10).value
        self._publishes_tf = self.declare_parameter("publish_tf", value=True).value
        self._qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=depth,
            reliability=ReliabilityPolicy.RELIABLE
            if reliability == "reliable"
            else ReliabilityPolicy.BEST_EFFORT,
        )
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._poses = self.create_publisher(PoseWithCovarianceStamped, "/tsgt/pose", self._qos)
        self._odometry = self.create_publisher(Odometry, "/tsgt/odometry", self._qos)
        self._points: dict[int, Any] = {}
        self._transforms = self.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        self._static_transforms = self.create_publisher(TFMessage, "/tf_static", latched)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self._lock = threading.Lock()
        self._setup: Setup | None = None
        self._status: Status | None = None
        self._no_poses: str | None = None
        self._pose: Pose | None = None
        self._came_stale = False
        self._stale_poses = 0
        self._arrived_ns = 0
        self._status_ns = 0
        self.stream: Stream | None = None
        self.create_timer(1.0, self._publish_diagnostics)

    def take(self, record: object) -> None:
        """Publish what a record of the stream holds."""
        with self._lock:
            self._arrived_ns = monotonic_ns()
            if isinstance(record, Pose):
                self._take_pose(record)
            elif isinstance(record, Measurement):
                self._take_measurement(record)
            elif isinstance(record, Hello):  # another session, with other poses and stations
                self._pose = self._status = None
                self._no_poses = record.no_poses
            elif isinstance(record, Setup):
                self._setup = record
                self._no_poses = record.no_poses
                self._static_transforms.publish(TFMessage(transforms=self._static()))
            elif isinstance(record, Status):
                self._status, self._status_ns = record, self._arrived_ns
                self._no_poses = record.no_poses

    def _take_pose(self, pose: Pose) -> None:
        live = pose.kind in ("predicted", "interpolated")
        if pose.series != self._series and not (live and self._series == LIVE):
            return
        self._pose = pose
        position, orientation = pose.position_m, pose.orientation_xyzw
        stale = self._came_stale = pose.age_s() > self._max_age_s(pose)
        self._stale_poses += stale
        if not pose.valid or stale or position is None or orientation is None:
            return
        stamp = self._time(pose.stamp_ns, pose.age_s())
        if stamp is None:
            return
        world, robot = self._world_frame or pose.frame, self._robot_frame or pose.child_frame
        header = Header(stamp=stamp, frame_id=world)
        message = PoseWithCovarianceStamped(header=header)
        _set_xyz(message.pose.pose.position, position)
        _set_quaternion(message.pose.pose.orientation, orientation)
        if pose.covariance is not None:
            message.pose.covariance = list(pose.covariance)
        self._poses.publish(message)
        if self._publishes_tf:
            self._transforms.publish(TFMessage(transforms=[_transform(header, robot, position, orientation)]))
        if pose.velocity_mps is not None and pose.angular_velocity_radps is not None:
            odometry = Odometry(header=header, child_frame_id=robot, pose=message.pose)
            _set_xyz(odometry.twist.twist.linear, rotated_back(pose.velocity_mps, orientation))
            _set_xyz(odometry.twist.twist.angular, pose.angular_velocity_radps)
            self._odometry.publish(odometry)

    def _max_age_s(self, pose: Pose) -> float:
        """Return the age on arrival from which a pose is stale."""
        return default_max_age_s(pose, None if self._setup is None else self._setup.lag_s)

    def _next_due_s(self, pose: Pose) -> float:
        """Return the age from which the newest pose is stale, because the next one should have come."""
        setup, limit_s = self._setup, self._max_age_s(pose)
        if setup is None or setup.rate_hz <= 0:
            return limit_s
        if pose.kind == "interpolated":  # waits for the next measurement of each prism
            limit_s += setup.limits.outage_s
        return limit_s + LATE_PERIODS / setup.rate_hz

    def _take_measurement(self, measurement: Measurement) -> None:
        point = None if self._setup is None else measured_point(measurement, self._setup)
        stamp = self._time(measurement.stamp_ns, measurement.age_s())
        if point is None or stamp is None or self._setup is None:
            return
        publisher = self._points.get(measurement.prism)
        if publisher is None:
            publisher = self.create_publisher(PointStamped, f"/tsgt/prism{measurement.prism}", self._qos)
            self._points[measurement.prism] = publisher
        message = PointStamped(header=Header(stamp=stamp, frame_id=self._world_frame or self._setup.frame))
        _set_xyz(message.point, point)
        publisher.publish(message)

    def _static(self) -> list[Any]:
        """Return the frames of stations, robot and prisms: a frame has one parent, so the robot hangs on the reference point."""
        setup = self._setup
        assert setup is not None  # noqa: S101 (called with one)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._world_frame or setup.frame)
        transforms = [
            _transform(header, f"station{station.id}", station.position_m, station.orientation_xyzw)
            for station in setup.stations
            if f"station{station.id}" != header.frame_id
        ]
        point = setup.reference_point
        parent = self._robot_frame or setup.child_frame
        robot = parent if setup.child_frame == "robot" else "robot"
        if setup.child_frame != "robot":
            if parent == robot:
                raise ConfigError(
                    f"parameter robot_frame is 'robot', but poses are those of {setup.child_frame!r}, and `robot` is the "
                    "frame of the prisms: choose another name"
                )
            x, y, z, w = point.orientation_xyzw
            position = rotated_back(tuple(-value for value in point.position_m), point.orientation_xyzw)
            transforms.append(
                _transform(Header(stamp=header.stamp, frame_id=parent), robot, position, (-x, -y, -z, w))
            )
        transforms += [
            _transform(
                Header(stamp=header.stamp, frame_id=robot),
                f"prism{prism.id}",
                prism.position_m,
                (0.0, 0.0, 0.0, 1.0),
            )
            for prism in setup.prisms
        ]
        return transforms

    def _publish_diagnostics(self) -> None:
        with self._lock:
            now_ns = monotonic_ns()
            silent_s = (now_ns - self._arrived_ns) / 1e9
            why = "no connection yet" if self.stream is None else self.stream.problem
            if not why and silent_s > STREAM_SILENT_S:
                why = f"no line for {silent_s:.0f} s" if self._arrived_ns else "no line yet"
            statuses = [_stream_diagnosis(self.source, why), self._pose_diagnosis()]
            if self._status is not None:
                status_age_s = (now_ns - self._status_ns) / 1e9
                statuses += [_station_diagnosis(station, status_age_s) for station in self._status.stations]
            began = self._arrived_ns > 0
        if why:
            for status in statuses[1:]:
                status.level = DiagnosticStatus.STALE
                status.message = "the stream has stopped" if began else status.message
        header = Header(stamp=self.get_clock().now().to_msg())
        self._diagnostics.publish(DiagnosticArray(header=header, status=statuses))

    def _pose_diagnosis(self) -> Any:
        pose = self._pose
        if pose is None:
            message = f"no poses: {self._no_poses}" if self._no_poses else "no pose yet"
            return _diagnosis(
                "pose", DiagnosticStatus.ERROR, message, series=self._series, stale_poses=self._stale_poses
            )
        stale = self._came_stale or pose.age_s() > self._next_due_s(pose)
        return _pose_diagnosis(pose, self._stale_poses, stale=stale)

    def _time(self, stamp_ns: int, age_s: float) -> Any | None:
        if self._stamp == "local":
            stamp_ns = self.get_clock().now().nanoseconds - round(age_s * 1e9)
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        if not 0 <= seconds <= LAST_SECOND:
            self.get_logger().error(
                f"a time of {seconds} s does not fit into a ROS time: is the master's clock wrong?",
                throttle_duration_sec=60.0,
            )
            return None
        return Time(sec=seconds, nanosec=nanoseconds)

    def _text(self, name: str, default: str) -> str:
        return str(self.declare_parameter(name, default).value)

    def _choice(self, name: str, *values: str) -> str:
        value = self._text(name, values[0])
        if value not in values:
            raise SystemExit(f"parameter {name} is {value!r}: choose {' or '.join(values)}")
        return value


def rotated_back(vector: Sequence[float], orientation_xyzw: Sequence[float]) -> tuple[float, float, float]:
    """Return R^T v: a vector in the axes of the child frame, by two cross products."""
    vx, vy, vz = vector
    x, y, z, w = orientation_xyzw
    tx, ty, tz = 2 * (z * vy - y * vz), 2 * (x * vz - z * vx), 2 * (y * vx - x * vy)
    return (vx + w * tx + z * ty - y * tz, vy + w * ty + x * tz - z * tx, vz + w * tz + y * tx - x * ty)


def _set_xyz(target: Any, values: Sequence[float]) -> None:
    target.x, target.y, target.z = values


def _set_quaternion(target: Any, values: Sequence[float]) -> None:
    target.x, target.y, target.z, target.w = values


def _transform(header: Any, child: str, position: Sequence[float], orientation: Sequence[float]) -> Any:
    message = TransformStamped(header=header, child_frame_id=child)
    _set_xyz(message.transform.translation, position)
    _set_quaternion(message.transform.rotation, orientation)
    return message


def _diagnosis(name: str, level: bytes, message: str, **values: object) -> Any:
    pairs = [
        KeyValue(key=key, value="unknown" if value is None else str(value)) for key, value in values.items()
    ]
    return DiagnosticStatus(
        name=f"tsgt: {name}", hardware_id="tsgt", level=level, message=message, values=pairs
    )


def _stream_diagnosis(source: str, problem: str) -> Any:
    level = DiagnosticStatus.STALE if problem else DiagnosticStatus.OK
    return _diagnosis("stream", level, problem or "connected", source=source)


def _pose_diagnosis(pose: Pose, stale_poses: int, *, stale: bool) -> Any:
    if stale:
        level, message = DiagnosticStatus.STALE, f"{pose.age_s():.1f} s old"
    elif not pose.valid:
        level, message = DiagnosticStatus.ERROR, f"invalid: {pose.reason}"
    elif pose.quality == "degraded":
        level, message = DiagnosticStatus.WARN, f"degraded by {', '.join(pose.degraded_by)}"
    else:
        level, message = DiagnosticStatus.OK, "good"
    return _diagnosis(
        "pose",
        level,
        message,
        kind=pose.kind,
        age_s=f"{pose.age_s():.3f}",
        residual_m=pose.residual_m,
        imu=pose.imu,
        stale_poses=stale_poses,
    )


def _station_diagnosis(station: StationStatus, status_age_s: float) -> Any:
    level, message = _station_condition(station)
    if status_age_s > STATUS_SILENT_S:
        level, message = DiagnosticStatus.STALE, f"no status for {status_age_s:.0f} s"
    elif action := _action_required(station):
        message = action if level == DiagnosticStatus.OK else f"{message}; {action}"
        level = max(level, DiagnosticStatus.WARN)
    return _diagnosis(
        f"station {station.id}",
        level,
        message,
        rate_hz=station.rate_hz,
        age_s=station.age_s,
        last_heard_s=station.last_heard_s,
        loss=station.loss,
        rssi_dbm=station.rssi_dbm,
        snr_db=station.snr_db,
        clock_bound_ns=station.clock_bound_ns,
        battery_percent=station.battery_percent,
    )


def _station_condition(station: StationStatus) -> tuple[bytes, str]:
    """Return level and message, by what the master receives from a station."""
    heard_s = station.last_heard_s
    if heard_s is None:
        return DiagnosticStatus.ERROR, "not received yet"
    if heard_s > MAX_AGE_S and (not station.answering or heard_s > MAX_UNASKED_S):
        return DiagnosticStatus.ERROR, f"silent for {heard_s:.0f} s"
    if station.status is None or station.age_s is None:
        return DiagnosticStatus.WARN, "no measurement yet"
    if station.status not in ("ok", "low_accuracy"):
        return DiagnosticStatus.WARN, UNUSABLE.get(station.status, station.status)
    if station.age_s - heard_s > MAX_AGE_S:
        return DiagnosticStatus.WARN, f"no measurement for {station.age_s:.0f} s"
    return DiagnosticStatus.OK, "measures"


def _action_required(station: StationStatus) -> str:
    """Return what the operator has to do at a station although it may measure; empty for nothing."""
    charge = station.battery_percent
    if not station.problem and charge is not None and charge < LOW_BATTERY_PERCENT:
        return f"battery {charge} %"
    return station.problem or ""


def main() -> int:
    """Publish until SIGINT or SIGTERM; return the exit status."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    node = PosePublisher()
    spinning = threading.Thread(target=_spin, args=(node,))
    spinning.start()
    try:
        with _stream(node) as stream:
            node.stream = stream
            for record in stream:
                node.take(record)
    except KeyboardInterrupt:
        return 0
    except TsgtError as error:
        node.get_logger().fatal(str(error))
        return 1
    finally:
        rclpy.try_shutdown()
        spinning.join()
    return 0


def _stream(node: PosePublisher) -> Stream:
    try:
        return Stream(node.source, key=node.key_file or None)
    except ValueError as error:
        raise ConfigError(f"parameter source: {error}") from error


def _spin(node: Node) -> None:
    """Run the timer of the diagnostics."""
    with suppress(ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    sys.exit(main())
