"""Records of the stream as text, one line each, in degrees and millimetres."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from tsgt.cli.output import printable
from tsgt.model import PointMeasurement, PolarMeasurement
from tsgt.recording import (
    ClockRecord,
    EventRecord,
    HelloRecord,
    ImuStatus,
    OdometryStatus,
    PoseRecord,
    SetupRecord,
    SetupStation,
    StationStatus,
    StatusRecord,
    ValidityLimits,
    decode,
)

if TYPE_CHECKING:
    from tsgt.model import Row4


def render(kind: str, line: bytes) -> str | None:
    """Return a line of the stream as text; None for an unknown type.

    Parameters
    ----------
    kind
        The line's ``type``.
    line
        The JSON object.

    Raises
    ------
    ValueError
        The type is known, but a field is missing or invalid.
    """
    match kind:
        case "hello":
            return _hello(decode(HelloRecord, line))
        case "setup":
            return _setup(decode(SetupRecord, line))
        case "measurement":
            return _polar(decode(PolarMeasurement, line))
        case "point":
            return _point(decode(PointMeasurement, line))
        case "pose":
            return _pose(decode(PoseRecord, line))
        case "clock":
            return _clock(decode(ClockRecord, line))
        case "status":
            return _status(decode(StatusRecord, line))
        case "event":
            event = decode(EventRecord, line)
            return f"{clock_time(event.stamp_ns)}  event {event.event}: {event.message}"
        case _:
            return None


def _hello(hello: HelloRecord) -> str:
    text = f"tsgt {hello.version}, stream protocol {hello.protocol}: {', '.join(hello.capabilities)}"
    if hello.limits is not None:
        text += f". Valid: {hello.limits.promise}{_limits(hello.limits)}"
    if hello.no_poses is not None:
        text += f". No poses: {printable(hello.no_poses)}"
    return text


def _limits(limits: ValidityLimits) -> str:
    """Return the limits of the sigmas, if there are any."""
    kinds = (
        ("smoothed", limits.position_sigma_m, limits.rotation_sigma_rad),
        ("predicted", limits.predicted_position_sigma_m, limits.predicted_rotation_sigma_rad),
    )
    parts = [
        f"{kind} {1e3 * position_m:g} mm, {math.degrees(rotation_rad):.3g} deg"
        for kind, position_m, rotation_rad in kinds
        if position_m is not None and rotation_rad is not None
    ]
    return f" Limits at {limits.reference_point}: {'; '.join(parts)}." if parts else ""


def _setup(setup: SetupRecord) -> str:
    parts = [
        f"{clock_time(setup.stamp_ns)}  setup  {setup.child_frame} in {setup.frame}, {setup.estimator}, {setup.rate_hz:g} Hz",
        *map(_setup_station, setup.stations),
        *(f"geofence {fence.name}" for fence in setup.geofences),
        *(["IMU"] if setup.imu else []),
    ]
    if setup.protocol is not None:
        parts.append(f"{setup.protocol}{'' if setup.authenticated else ', not authenticated'}")
    if setup.recording is not None:
        parts.append(f"recorded in {setup.recording}")
    return "; ".join(parts)


def _setup_station(station: SetupStation) -> str:
    text = f"station {station.id} on prism {station.prism} at {_vector(station.position_m)} m"
    if station.covariance is None or not any(station.covariance):
        return text
    sigmas_mm = " ".join(
        f"{1e3 * math.sqrt(max(0.0, station.covariance[7 * axis])):.1f}" for axis in range(3)
    )
    return f"{text} (sigmas {sigmas_mm} mm)"


def _polar(polar: PolarMeasurement) -> str:
    distance = "no distance" if polar.slope_distance_m is None else f"{polar.slope_distance_m:.4f} m"
    return (
        f"{clock_time(polar.stamp_ns)}  station {polar.station} prism {polar.prism}  "
        f"horizontal {math.degrees(polar.horizontal_angle_rad):.4f} deg  "
        f"zenith {math.degrees(polar.zenith_angle_rad):.4f} deg  {distance}  {polar.status}"
    )


def _point(point: PointMeasurement) -> str:
    return (
        f"{clock_time(point.stamp_ns)}  station {point.station} prism {point.prism}  "
        f"{_vector(point.position_m)} m  {point.status}"
    )


def _pose(pose: PoseRecord) -> str:
    validity = "valid" if pose.valid else f"invalid ({pose.reason})"
    if pose.degraded_by:
        validity += f", degraded ({', '.join(pose.degraded_by)})"
    kind = pose.kind if pose.delay_s is None else f"{pose.kind} at {pose.delay_s:g} s"
    parts = [clock_time(pose.stamp_ns), "pose", kind, validity]
    if pose.position_m is not None and pose.orientation_xyzw is not None:
        yaw, pitch, roll = yaw_pitch_roll_deg(pose.orientation_xyzw)
        parts.append(f"{pose.child_frame} {_vector(pose.position_m)} m")
        parts.append(f"yaw {yaw:.2f} pitch {pitch:.2f} roll {roll:.2f} deg")
    if pose.residual_m is not None:
        parts.append(f"residual {1e3 * pose.residual_m:.1f} mm")
    ages = ", ".join(f"{share.id}: {_age(share.age_s)}" for share in pose.stations)
    parts.append(f"ages {ages}")
    return "  ".join(parts)


def _clock(clock: ClockRecord) -> str:
    side = "ahead of" if clock.offset_ns >= 0 else "behind"
    return (
        f"{clock_time(clock.stamp_ns)}  clock of station {clock.station} is {abs(clock.offset_ns) / 1e9:.6f} s {side} the "
        f"master's, bound {clock.bound_ns / 1e6:.3f} ms, {clock.frequency_ppm:+.2f} ppm; "
        f"{len(clock.samples) - clock.rejected} of {len(clock.samples)} exchanges used ({clock.filter})"
        f"{', reset' if clock.restarted else ''}"
    )


def _status(status: StatusRecord) -> str:
    parts = [*map(_station, status.stations), *([] if status.imu is None else [_imu(status.imu)])]
    parts += [] if status.odometry is None else [_odometry(status.odometry)]
    return f"{clock_time(status.stamp_ns)}  status  {status.valid_poses} of {status.poses} poses valid; {'; '.join(parts)}"


def _odometry(odometry: OdometryStatus) -> str:
    parts = [f"{odometry.samples} samples", *odometry.figures()]
    if odometry.age_s is not None:
        parts.append(f"last {_age(odometry.age_s)} ago")
    return f"wheel odometry: {', '.join(parts)}"


def _imu(imu: ImuStatus) -> str:
    parts = [f"{imu.samples} samples", *imu.figures()]
    if imu.age_s is not None:
        parts.append(f"last {_age(imu.age_s)} ago")
    return f"IMU: {', '.join(parts)}"


def _station(station: StationStatus) -> str:
    if station.status is None:
        parts = ["no measurement yet"]
    else:
        parts = [
            f"{station.usable} of {station.measurements} usable",
            f"last {station.status} {_age(station.age_s)} ago",
        ]
    if station.last_heard_s is not None:
        parts.append(f"received {_age(station.last_heard_s)} ago")
    if station.rate_hz is not None:
        parts.append(f"{station.rate_hz:.1f} Hz")
    if station.loss is not None:
        parts.append(f"{100 * station.loss:.0f} % lost")
    if station.rssi_dbm is not None and station.snr_db is not None:
        parts.append(f"{station.rssi_dbm:.0f} dBm, SNR {station.snr_db:.0f} dB")
    if station.clock_bound_ns is not None:
        parts.append(f"clock bound {station.clock_bound_ns / 1e6:.1f} ms")
    return f"station {station.id}: {', '.join(parts)}"


def clock_time(stamp_ns: int) -> str:
    """Return the time of day in UTC to the millisecond; seconds for a time outside the calendar."""
    seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
    try:
        text = datetime.fromtimestamp(seconds, tz=UTC).strftime("%H:%M:%S")
    except (ValueError, OverflowError, OSError):  # a clock that was never set
        return f"{seconds} s"
    return f"{text}.{rest_ns // 1_000_000:03d}"


def _vector(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.3f}" for value in values)


def _age(age_s: float | None) -> str:
    return "-" if age_s is None else f"{age_s:.2f} s"


def yaw_pitch_roll_deg(quaternion_xyzw: Row4) -> tuple[float, float, float]:
    """Return the ZYX Euler angles of a unit quaternion in degrees: R = Rz(yaw) Ry(pitch) Rx(roll).

    Uses the standard library alone, so that ``tsgt listen`` starts without numpy and scipy.
    """
    x, y, z, w = quaternion_xyzw
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return math.degrees(yaw), math.degrees(pitch), math.degrees(roll)
