"""Records of the stream as frozen data classes, built from JSON with the standard library alone.

docs/reference/stream.md defines the fields. The master's own definitions need pydantic, which costs a small computer a
quarter of a second and 14 MB; a test compares these classes with the schema that is generated from them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar, Literal

PROTOCOL_VERSION = 1

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Kind = Literal["predicted", "interpolated", "smoothed"]


def monotonic_ns() -> int:
    """Return a clock of this computer that is never set, and also counts while it is suspended, in ns."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidityLimits:
    """What ``valid`` promises of a pose, with the limits in force."""

    promise: str
    reference_point: str
    position_sigma_m: float | None
    rotation_sigma_rad: float | None
    predicted_position_sigma_m: float | None
    predicted_rotation_sigma_rad: float | None
    residual_m: float
    tilt_rad: float
    outage_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """The greeting: another master, or the same one restarted, serves the stream from here on."""

    nested: ClassVar[dict[str, type]] = {"limits": ValidityLimits}

    protocol: int
    version: str
    capabilities: tuple[str, ...]
    limits: ValidityLimits | None = None
    no_poses: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferencePoint:
    """A point of the robot, with axes."""

    sizes: ClassVar[dict[str, int]] = {"position_m": 3, "orientation_xyzw": 4}

    name: str
    position_m: Vector3
    orientation_xyzw: Quaternion


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupStation:
    """The frame of one station, and what it tracks."""

    sizes: ClassVar[dict[str, int]] = {"position_m": 3, "orientation_xyzw": 4, "covariance": 36}

    id: int
    position_m: Vector3
    orientation_xyzw: Quaternion
    covariance: tuple[float, ...] | None
    instrument: str | None = None
    latency_s: float
    prism: int
    prism_constant_m: float
    atmospheric_ppm: float
    vertical_index_rad: float
    collimation_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupPrism:
    """One prism on the robot."""

    sizes: ClassVar[dict[str, int]] = {"position_m": 3}

    id: int
    station: int | None
    position_m: Vector3


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupGeofence:
    """One geofence."""

    name: str
    allowed_side: str
    polygon_m: tuple[tuple[float, float], ...]
    margin_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """The set-up in force: after each greeting, and again whenever it changes."""

    nested: ClassVar[dict[str, type]] = {
        "reference_point": ReferencePoint,
        "limits": ValidityLimits,
        "stations": SetupStation,
        "prisms": SetupPrism,
        "geofences": SetupGeofence,
    }

    stamp_ns: int
    frame: str
    child_frame: str
    reference_point: ReferencePoint
    estimator: str
    protocol: str | None = None
    authenticated: bool | None = None
    rate_hz: float
    lag_s: float | None
    smoothed_delays_s: tuple[float, ...]
    limits: ValidityLimits
    stations: tuple[SetupStation, ...]
    prisms: tuple[SetupPrism, ...]
    geofences: tuple[SetupGeofence, ...] = ()
    imu: bool
    recording: str | None = None
    no_poses: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StationShare:
    """The contribution of one station to a pose, or why there is none."""

    id: int
    prism: int
    age_s: float | None
    residual_m: float | None
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """The pose of the robot at one epoch, or why there is none."""

    nested: ClassVar[dict[str, type]] = {"stations": StationShare}
    sizes: ClassVar[dict[str, int]] = {
        "position_m": 3,
        "orientation_xyzw": 4,
        "covariance": 36,
        "covariance_common": 36,
        "velocity_mps": 3,
        "angular_velocity_radps": 3,
    }

    stamp_ns: int
    frame: str
    child_frame: str
    position_m: Vector3 | None
    orientation_xyzw: Quaternion | None
    covariance: tuple[float, ...] | None
    covariance_common: tuple[float, ...] | None = None
    velocity_mps: Vector3 | None
    angular_velocity_radps: Vector3 | None
    estimator: str
    kind: Kind
    delay_s: float | None = None
    imu: str | None = None
    jump_m: float | None = None
    jump_rad: float | None = None
    valid: bool
    reason: str
    quality: str | None = None
    degraded_by: tuple[str, ...] = ()
    residual_m: float | None
    stations: tuple[StationShare, ...]
    epoch_ns: int = 0
    """Time of the pose on :func:`monotonic_ns` of this computer; see :meth:`age_s`."""

    @property
    def series(self) -> str:
        """Name of the poses that belong together, one per epoch: their kind, with their delay as in ``smoothed_1s``."""
        return self.kind if self.delay_s is None else f"{self.kind}_{self.delay_s:g}s"

    def age_s(self, now_ns: int | None = None) -> float:
        """Return the time since the pose's epoch in s, by this computer's clock alone.

        The least delay that any line has had counts as none, so the age is too small by that delay: below a millisecond
        on the robot, the network's one-way delay elsewhere. ``now_ns``: :func:`monotonic_ns`; None: now.
        """
        return ((monotonic_ns() if now_ns is None else now_ns) - self.epoch_ns) / 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """One raw measurement of a prism; :func:`~tsgt.client.measured_point` makes a point of it."""

    station: int
    prism: int
    sequence: int
    stamp_ns: int
    stamp_sigma_ns: int = 0
    stamp_bound_ns: int | None = None
    received_ns: int
    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float | None
    status: str = "ok"
    raw_status: int = 0
    host_time_ns: int | None
    instrument_time_ns: int | None = None
    epoch_ns: int = 0
    """Time of the measurement on :func:`monotonic_ns` of this computer; see :meth:`age_s`."""

    def age_s(self, now_ns: int | None = None) -> float:
        """Return the time since it was measured in s, by this computer's clock alone, as :meth:`Pose.age_s` does."""
        return ((monotonic_ns() if now_ns is None else now_ns) - self.epoch_ns) / 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class StationStatus:
    """The status of one station."""

    id: int
    measurements: int
    usable: int
    age_s: float | None
    status: str | None
    prism: int | None = None
    locked: bool | None = None
    answering: bool | None = None
    last_heard_s: float | None = None
    rate_hz: float | None = None
    loss: float | None = None
    rssi_dbm: float | None = None
    snr_db: float | None = None
    clock_offset_ns: int | None = None
    clock_bound_ns: int | None = None
    stamp_bound_ns: int | None = None
    joined: bool | None = None
    outstanding: int | None = None
    drain_rate_hz: float | None = None
    drain_s: float | None = None
    missed_slots: int | None = None
    rejected_beacons: int | None = None
    outside_lag_window: int | None = None
    battery_percent: int | None = None
    atmospheric_ppm: float | None = None
    activity: str | None = None
    problem: str | None = None
    last_target_check_age_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuStatus:
    """The status of the robot's IMU."""

    sizes: ClassVar[dict[str, int]] = {"gyro_bias_radps": 3, "accelerometer_bias_mps2": 3}

    device: str
    samples: int
    rate_hz: float | None
    age_s: float | None
    gaps: int
    lost: int
    saturated: int
    clock_skew_ppm: float | None
    problem: str
    use: str | None = None
    disagreement: str = ""
    gyro_bias_radps: Vector3 | None = None
    accelerometer_bias_mps2: Vector3 | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryStatus:
    """The status of the robot's wheel odometry."""

    device: str
    samples: int
    rate_hz: float | None
    age_s: float | None
    gaps: int
    lost: int
    untrusted: int
    clock_skew_ppm: float | None
    problem: str
    use: str | None = None
    scale: float | None = None
    scale_sigma: float | None = None
    slip: float | None = None
    slip_sigma: float | None = None
    rejected: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingStatus:
    """The status of the recording."""

    file: str
    bytes: int
    last_write_ns: int | None
    waiting_lines: int
    lost_lines: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DiskStatus:
    """The space on the disk of the recording."""

    free_bytes: int
    total_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """The status of the master and its stations, about once per second."""

    nested: ClassVar[dict[str, type]] = {
        "stations": StationStatus,
        "imu": ImuStatus,
        "odometry": OdometryStatus,
        "recording": RecordingStatus,
        "disk": DiskStatus,
    }

    stamp_ns: int
    poses: int
    valid_poses: int
    stations: tuple[StationStatus, ...]
    protocol: str | None = None
    authenticated: bool | None = None
    frame_ms: float | None = None
    imu: ImuStatus | None = None
    odometry: OdometryStatus | None = None
    recording: RecordingStatus | None = None
    disk: DiskStatus | None = None
    no_poses: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """An event that a reader may want to act on."""

    stamp_ns: int
    event: str
    message: str
    station: int | None = None
    count: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """Lines are missing here."""

    lines: int | None
    """How many; None where that is not known."""
    reason: str
    """Why, in one line."""


Record = Hello | Setup | Pose | Measurement | Status | Event | Gap
