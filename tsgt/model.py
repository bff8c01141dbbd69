"""Records that all layers share: measurements, and the parameters that turn them into poses.

Frozen dataclasses, SI units and radians, times as integers in nanoseconds. Recordings and the stream have exactly these
fields under exactly these names; docs/explanation/conventions.md defines units, frames and signs.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar, Literal

if TYPE_CHECKING:
    from collections.abc import Iterable

Vector3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Matrix4 = tuple[Row4, Row4, Row4, Row4]

IDENTITY4: Matrix4 = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)

WORLD_FRAME = "station1"
ROBOT_FRAME = "robot"

ARCSECOND_RAD = math.pi / 648_000

MAX_INSTANT_NS = 2**63 - 1  # times are signed 64-bit integers, which end in 2262

MIN_PRISMS = 3  # that determine a pose without an IMU

MAX_NUMBER = 2**31 - 1  # of stations and prisms

MAX_COORDINATE_M = 1e8  # map coordinates (UTM: 1e7) and geocentric coordinates are smaller

_FRAME_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_./-]*")
_OTHER_FRAME = re.compile(r"(station|prism)\d+")

_ROTATION_TOLERANCE = 1e-3  # exceeds the rounding of a matrix that is written with four digits


def check_instants(*times_ns: int) -> None:
    """Raise ValueError for a time before 1970 or beyond 64 bits."""
    for time_ns in times_ns:
        if not 0 <= time_ns <= MAX_INSTANT_NS:
            raise ValueError(f"a time of {time_ns} ns is outside what a clock can show")


def check_finite(*numbers: float) -> None:
    """Raise ValueError for NaN and infinity, which an instrument or a radio may send and JSON cannot represent."""
    for number in numbers:
        if not math.isfinite(number):
            raise ValueError(f"{number} is not a finite number")


def _check_coordinates(what: str, coordinates: Iterable[float]) -> None:
    """Reject positions that are not near the Earth."""
    for coordinate in coordinates:
        if not abs(coordinate) <= MAX_COORDINATE_M:
            raise ValueError(f"{what} holds {coordinate:g}, expected at most {MAX_COORDINATE_M:g} m")


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _check_rotation(what: str, matrix: Matrix4) -> None:
    """Reject a matrix whose upper left 3x3 block is not a rotation."""
    x, y, z = (row[:3] for row in matrix[:3])
    lengths = (math.hypot(*x) - 1, math.hypot(*y) - 1, math.hypot(*z) - 1)
    cosines = (_dot(x, y), _dot(y, z), _dot(z, x))
    if not all(abs(error) < _ROTATION_TOLERANCE for error in (*lengths, *cosines)):
        raise ValueError(f"{what} holds {x}, {y}, {z}, which is not a rotation")


def _check_limits(record: object, **limits: tuple[float, float]) -> None:
    """Reject attributes outside their limits (inclusive)."""
    for name, (lower, upper) in limits.items():
        if not lower <= getattr(record, name) <= upper:
            raise ValueError(f"{name} is {getattr(record, name)}, expected {lower:g} to {upper:g}")


class FiniteNumbers:
    """Base of records that pydantic validates to have finite numbers."""

    __slots__ = ()
    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}


class Status(StrEnum):
    """The instrument's status of a measurement, in one vocabulary for all makes."""

    OK = "ok"
    LOW_ACCURACY = "low_accuracy"
    ANGLE_ONLY = "angle_only"
    NO_TARGET = "no_target"
    TILT = "tilt"
    WRONG_DISTANCE = "wrong_distance"
    ERROR = "error"

    @property
    def usable(self) -> bool:
        """Whether angles and distance may enter a pose; ``LOW_ACCURACY`` is normal in motion."""
        return self in (Status.OK, Status.LOW_ACCURACY)


@dataclass(frozen=True, slots=True, kw_only=True)
class PolarMeasurement(FiniteNumbers):
    """One raw measurement of a prism by a total station."""

    type: Literal["measurement"] = "measurement"
    station: int
    """Number of the station that measured, from 1."""
    prism: int
    """Number of the prism that it tracked, from 1."""
    sequence: int
    """Sequence number of this station's measurements, from 0."""
    stamp_ns: int
    """Time of the measurement on the master's Unix clock in ns, converted from the host stamp, with the station's
    latency included."""
    stamp_sigma_ns: int = 0
    """One sigma of ``stamp_ns`` in ns, without the instrument's latency: in a journal of the conversion from the
    instrument's clock to the station's, in a recording of that to the master's clock; in what was merged from a journal
    also the excess of the former over its usual value."""
    stamp_bound_ns: int | None = None
    """``stamp_ns`` is within this of the truth, in ns; null where unknown."""
    received_ns: int
    """Arrival at the master, on the master's Unix clock, in ns."""
    horizontal_angle_rad: float
    """Horizontal circle, clockwise from the circle's zero, in rad."""
    zenith_angle_rad: float
    """Angle from the zenith in rad; above pi in the second face."""
    slope_distance_m: float | None
    """Slope distance in m as the instrument gave it, without prism constant and atmospheric correction beyond what the
    instrument applies itself; null where it gave none."""
    status: Status = Status.OK
    """The instrument's status: ``ok``, ``low_accuracy``, ``angle_only``, ``no_target``, ``tilt``, ``wrong_distance`` or
    ``error``. The first two are usable."""
    raw_status: int = 0
    """The instrument's own status number; 0 where the radio does not carry it."""
    host_time_ns: int | None
    """The station computer's stamp in ns, on its own clock; null where the radio does not carry it."""
    instrument_time_ns: int | None = None
    """The instrument's own stamp in ns, on the instrument's clock; null where it has none."""

    def __post_init__(self) -> None:
        """Reject impossible times and numbers."""
        check_instants(self.stamp_ns, self.received_ns, self.stamp_sigma_ns)
        check_instants(self.stamp_bound_ns or 0, self.host_time_ns or 0)
        check_finite(self.horizontal_angle_rad, self.zenith_angle_rad, self.slope_distance_m or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointMeasurement(FiniteNumbers):
    """A prism position that was imported as Cartesian coordinates, without polar raw values."""

    type: Literal["point"] = "point"
    station: int
    """Number of the station that measured, from 1."""
    prism: int
    """Number of the prism, from 1."""
    sequence: int
    """Sequence number of this station's points, from 0."""
    stamp_ns: int
    """Time of the measurement on the master's Unix clock in ns."""
    received_ns: int
    """Arrival, on the same clock, in ns."""
    position_m: Vector3
    """Position of the prism in the frame ``station1``, [x, y, z] in m, all corrections applied."""
    status: Status = Status.OK
    """As in ``measurement``."""

    def __post_init__(self) -> None:
        """Reject impossible times and numbers."""
        check_instants(self.stamp_ns, self.received_ns)
        check_finite(*self.position_m)


Measurement = PolarMeasurement | PointMeasurement


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockSample:
    """One two-way exchange with a station."""

    sent_ns: int
    """Start of the request's transmission, on the master's Unix clock in ns."""
    station_ns: int
    """The station's stamp of the request's reception, on the station's clock in ns."""
    received_ns: int
    """End of the reply's reception (RxDone), on the master's Unix clock in ns."""
    forward_ns: int
    """Known minimum delay from ``sent_ns`` to the station's stamp, in ns."""
    back_ns: int
    """Known minimum delay from the station's stamp to ``received_ns``, in ns."""

    @property
    def excess_ns(self) -> int:
        """Round-trip time beyond the known delays; the station's stamp is late by at most this."""
        return self.received_ns - self.sent_ns - self.forward_ns - self.back_ns

    @property
    def max_offset_ns(self) -> int:
        """Offset of the station's clock (positive: ahead of the master's) if it took its timestamp without delay."""
        return self.station_ns - self.sent_ns - self.forward_ns

    @property
    def min_offset_ns(self) -> int:
        """Offset of the station's clock if its timestamp is late by the whole excess."""
        return self.max_offset_ns - max(self.excess_ns, 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class InstrumentNoise(FiniteNumbers):
    """One-sigma noise of a single measurement of a total station, in the form of its data sheet."""

    range_sigma_m: float
    """Constant part of the slope distance's noise in m."""
    range_sigma_ppm: float
    """Part proportional to the distance, in 1e-6 of it; both parts add as variances."""
    angle_sigma_rad: float
    """Noise of the horizontal and of the zenith angle in rad, on the sphere: the horizontal angle's own noise is this
    over sin(zenith angle)."""
    pointing_sigma_m: float
    """Pointing noise across and along the line of sight, per axis, in m: tracking jitter and the prism's centring, or
    manual aiming at a foil target."""

    def __post_init__(self) -> None:
        """Reject noise that no instrument has."""
        _check_limits(
            self,
            range_sigma_m=(0, 1e3),
            range_sigma_ppm=(0, 1e6),
            angle_sigma_rad=(0, math.pi),
            pointing_sigma_m=(0, 1e3),
        )


TRACKING_NOISE = InstrumentNoise(
    # Trimble S7 data sheet, tracking mode: 4 mm + 2 ppm and 1 arcsecond. The 4 mm are taken as two sigma, the rest as
    # one, which is conservative by 0.1 mm at 100 m. 1 mm of tracking jitter per axis.
    range_sigma_m=0.002,
    range_sigma_ppm=2.0,
    angle_sigma_rad=1.0 * ARCSECOND_RAD,
    pointing_sigma_m=0.001,
)

TARGET_NOISE = InstrumentNoise(
    # Single measurements on reflective foil. Along the line of sight the residuals meet the data sheet's 2 mm + 2 ppm as
    # two sigma; but those of the 18 targets that the paper's authors published are as large across it, where only manual
    # aiming contributes. The most likely values are 0.9 mm of pointing and little range noise.
    range_sigma_m=0.0005,
    range_sigma_ppm=1.0,
    angle_sigma_rad=1.0 * ARCSECOND_RAD,
    pointing_sigma_m=0.0009,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetResidual(FiniteNumbers):
    """The residual of one target in the frame that was solved from all of them."""

    target: int
    """Number of the target."""
    residual_m: float | None
    """Distance between its position as measured by the station, in its solved frame, and by station 1, in m; null for a
    rejected one."""
    leave_one_out_m: float | None
    """The same with the frame solved from the other targets only, in m; null where these were too few."""

    def __post_init__(self) -> None:
        """Reject impossible residuals."""
        _check_limits(self, target=(1, MAX_NUMBER))
        for residual_m in (self.residual_m or 0.0, self.leave_one_out_m or 0.0):
            if not 0 <= residual_m <= 1e6:
                raise ValueError(f"a residual is {residual_m:g}, expected 0 to 1e+06 m")


@dataclass(frozen=True, slots=True, kw_only=True)
class StationParameters(FiniteNumbers):
    """Parameters that turn a station's raw measurements into positions in the frame ``station1``."""

    station: int
    """Number of the station, from 1."""
    prism: int
    """Number of the prism that the station tracks by default."""
    T_station1_station: Matrix4 = IDENTITY4
    """Rigid transform, 4x4, that takes coordinates in the station's frame to frame ``station1``, in m."""
    prism_constant_m: float = 0.0
    """Added to every raw slope distance, in m."""
    atmospheric_ppm: float = 0.0
    """Scale correction of the slope distance in 1e-6, only what the instrument did not apply itself."""
    latency_ns: int = 0
    """From the measurement to its host stamp, in ns; subtracted from the stamp. Positive: the stamp is late."""
    time_sigma_s: float = 0.0
    """One sigma of its host stamps in s, beyond that of an instrument on a cable, which is known."""
    vertical_index_rad: float = 0.0
    """Vertical index error in rad: the zenith angle (first face) that the instrument reads, less the true one."""
    collimation_rad: float = 0.0
    """Horizontal collimation error in rad: the line of sight deviates by it clockwise; the horizontal angle reads that
    over sin(zenith angle) too small."""
    noise: InstrumentNoise = TRACKING_NOISE
    """Noise of one measurement."""
    noise_scale: Vector3 = (1.0, 1.0, 1.0)
    """Factors on that noise along the line of sight, horizontally and vertically across it, where estimated; multiplied
    with ``noise_scale`` of the pipeline. For ``continuous``."""
    targets: tuple[TargetResidual, ...] = ()
    """Targets from which the frame was solved, with their residuals; empty where unknown, and for station 1."""

    def __post_init__(self) -> None:
        """Reject impossible parameters."""
        _check_limits(
            self,
            station=(1, MAX_NUMBER),
            prism=(1, MAX_NUMBER),
            prism_constant_m=(-10, 10),
            atmospheric_ppm=(-1e4, 1e4),
            latency_ns=(-(10**12), 10**12),
            time_sigma_s=(0, 1),
            vertical_index_rad=(-0.1, 0.1),
            collimation_rad=(-0.1, 0.1),
        )
        for factor in self.noise_scale:
            if not 1e-3 <= factor <= 1e3:
                raise ValueError(f"a factor of noise_scale is {factor}, expected 0.001 to 1000")
        _check_rotation("T_station1_station", self.T_station1_station)
        _check_coordinates("T_station1_station", (row[3] for row in self.T_station1_station))


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionPrior(FiniteNumbers):
    """Motion prior of the estimator ``continuous``: acceleration as an Ornstein-Uhlenbeck process."""

    acceleration_sigma_mps2: Vector3 = (0.4, 0.4, 0.2)
    """One sigma of the acceleration of the prisms' centroid along x, y, z of frame ``station1``."""
    acceleration_correlation_time_s: float = 0.8
    """Time in s after which the acceleration's correlation has fallen to 1/e."""
    angular_acceleration_sigma_radps2: Vector3 = (0.15, 0.15, 0.2)
    """One sigma of the angular acceleration about x, y, z of the robot."""
    angular_acceleration_correlation_time_s: float = 0.4
    """The same time for the angular acceleration."""

    def __post_init__(self) -> None:
        """Reject motion that no robot has."""
        _check_limits(
            self,
            acceleration_correlation_time_s=(1e-3, 1e4),
            angular_acceleration_correlation_time_s=(1e-3, 1e4),
        )
        for sigma in (*self.acceleration_sigma_mps2, *self.angular_acceleration_sigma_radps2):
            if not 1e-6 <= sigma <= 1e6:
                raise ValueError(f"a sigma of an acceleration is {sigma}, expected 1e-06 to 1e+06")


@dataclass(frozen=True, slots=True, kw_only=True)
class PipelineParameters(FiniteNumbers):
    """Parameters of the estimators."""

    estimator: Literal["linear", "continuous"] = "continuous"
    """Name of the estimator: ``linear`` (straight lines between measurements) or ``continuous`` (one smooth trajectory
    through all of them)."""
    period_ns: int = 50_000_000
    """Interval of the pose epochs in ns; epochs are the whole multiples of it in Unix time."""
    outage_limit_ns: int = 1_000_000_000
    """A longer interval between two measurements of a prism, in ns, is an outage without valid poses."""
    transport_limit_ns: int = 2_000_000_000
    """A measurement that has not arrived this long after it was made, in ns, is not waited for."""
    residual_limit_m: float = 0.05
    """A pose whose prisms miss the layout by more than this (root mean square over the prisms) is invalid."""
    tilt_limit_rad: float = math.pi / 2
    """A pose whose robot z axis leans further than this from vertical is invalid: the prism layout is mirrored, or two
    stations have swapped prisms."""
    acceleration_sigma_mps2: float = 0.3
    """One sigma, per axis, of the robot's acceleration between two measurements: the error of linear interpolation,
    which the covariance includes. For ``linear``."""
    angular_acceleration_sigma_radps2: float = 0.15
    """The same for its angular acceleration. For ``linear``."""
    motion: MotionPrior = MotionPrior()
    """Motion prior. For ``continuous``."""
    noise_scale: float = 1.0
    """Factor on the noise of all instruments. For ``continuous``."""
    lag_ns: int = 3_000_000_000
    """Lag of the smoothed poses in ns; measurements that arrive later after they were made are not used. For
    ``continuous``."""
    smoothed_delays_ns: tuple[int, ...] = ()
    """Delays in ns at which smoothed poses are computed before the lag, each at the first epoch at which it has passed.
    For ``continuous``; none in recordings of older versions."""
    position_sigma_limit_m: float = 0.05
    """A smoothed pose whose position (of the reference point, in its least certain direction) has a sigma above this is
    invalid. For ``continuous``."""
    rotation_sigma_limit_rad: float = math.radians(2.0)
    """The same for the sigma of its rotation. For ``continuous``."""
    predicted_position_sigma_limit_m: float = 0.15
    """As ``position_sigma_limit_m``, at the reference point, for predicted poses."""
    predicted_rotation_sigma_limit_rad: float = math.radians(5.0)
    """The same for the sigma of their rotation."""

    def __post_init__(self) -> None:
        """Reject limits that nothing can be computed with."""
        _check_limits(
            self,
            period_ns=(1_000_000, 1e12),
            outage_limit_ns=(0, 1e15),
            transport_limit_ns=(0, 1e15),
            residual_limit_m=(0, 1e6),
            tilt_limit_rad=(0, math.pi),
            acceleration_sigma_mps2=(0, 1e6),
            angular_acceleration_sigma_radps2=(0, 1e6),
            noise_scale=(1e-3, 1e3),
            lag_ns=(0, 60_000_000_000),
            position_sigma_limit_m=(0, 1e6),
            rotation_sigma_limit_rad=(0, math.pi),
            predicted_position_sigma_limit_m=(0, 1e6),
            predicted_rotation_sigma_limit_rad=(0, math.pi),
        )
        for delay_ns in self.smoothed_delays_ns:
            if not 0 < delay_ns < self.lag_ns:
                raise ValueError(
                    f"smoothed_delays_ns: {delay_ns} is not between 0 and lag_ns ({self.lag_ns})"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class PrismPosition(FiniteNumbers):
    """The position of a prism on the robot."""

    prism: int
    """Number of the prism, from 1."""
    position_m: Vector3
    """Its centre in the frame ``robot``, [x, y, z] in m."""

    def __post_init__(self) -> None:
        """Reject impossible positions."""
        _check_coordinates("position_m", self.position_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferencePoint(FiniteNumbers):
    """The frame on the robot whose pose is exported: the robot frame, or one fixed to it."""

    name: str = ROBOT_FRAME
    """Name of the frame: ``child_frame`` of the poses."""
    position_m: Vector3 = (0.0, 0.0, 0.0)
    """Its origin in the frame ``robot``, [x, y, z] in m."""
    orientation_xyzw: Row4 = (0.0, 0.0, 0.0, 1.0)
    """Rotation that takes its coordinates to the frame ``robot``, as a Hamilton unit quaternion [x, y, z, w]."""

    def __post_init__(self) -> None:
        """Reject impossible frames."""
        _check_coordinates("position_m", self.position_m)
        if not abs(math.hypot(*self.orientation_xyzw) - 1.0) < _ROTATION_TOLERANCE:
            raise ValueError(f"orientation_xyzw holds {self.orientation_xyzw}, expected a unit quaternion")
        if not _FRAME_NAME.fullmatch(self.name):
            raise ValueError(
                f"name holds {self.name!r}, expected a letter and then letters, digits, _ . / or -"
            )
        if _OTHER_FRAME.fullmatch(self.name):
            raise ValueError(f"name holds {self.name!r}, which is another frame; choose another name")
        identity = not any(self.position_m) and not any(self.orientation_xyzw[:3])
        if self.name == ROBOT_FRAME and not identity:
            raise ValueError(f"{ROBOT_FRAME} is the robot frame itself; give another point another name")


ROBOT_ORIGIN = ReferencePoint()
"""The robot frame itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuNoise(FiniteNumbers):
    """One-sigma noise of an inertial measurement unit, per axis, in the form of its data sheet."""

    gyro_noise_density: float
    """White noise of the angular rate in rad/s/sqrt(Hz)."""
    accelerometer_noise_density: float
    """White noise of the specific force in m/s^2/sqrt(Hz)."""
    gyro_bias_walk: float
    """Random walk of the gyro's bias in rad/s/sqrt(s)."""
    accelerometer_bias_walk: float
    """Random walk of the accelerometer's bias in m/s^2/sqrt(s)."""
    gyro_bias_radps: float
    """Bias of the gyro after switching on, in rad/s."""
    accelerometer_bias_mps2: float
    """Bias of the accelerometer after switching on, in m/s^2."""
    gyro_scale_misalignment: float = 1e-4
    """Error of each entry of ``ImuParameters.gyro_matrix``: of its calibration, and by temperature since."""
    accelerometer_scale_misalignment: float = 7e-4
    """Error of each entry of the accelerometer's matrix of scale factors and misalignment, which is not calibrated."""

    def __post_init__(self) -> None:
        """Reject noise that no instrument has."""
        for name in self.__slots__:
            if not 0 < getattr(self, name) <= 1e3:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0 and at most 1000")


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuParameters(FiniteNumbers):
    """Parameters that put the samples of the robot's IMU beside the measurements of the stations."""

    name: str = "imu"
    """Name of its frame, whose pose may be exported."""
    position_m: Vector3
    """Origin of its axes (of its accelerometers) in the frame ``robot``, [x, y, z] in m."""
    orientation_xyzw: Row4
    """Rotation that takes coordinates in its axes to the frame ``robot``, as a Hamilton unit quaternion [x, y, z, w]."""
    latency_ns: int = 0
    """From a sample to its stamp, in ns; subtracted from the stamp. Positive: the stamp is late."""
    gyro_matrix: tuple[Vector3, Vector3, Vector3] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Scale factors and misalignment: the angular rate is this matrix times the sample, less the bias."""
    noise: ImuNoise
    """Noise of the samples."""
    gravity_mps2: float = 9.81
    """Magnitude of gravity where the robot drives, in m/s^2."""
    tilt_sigma_rad: float = 1e-4
    """One sigma, per horizontal axis, of the angle between the z axis of frame ``station1`` and the vertical."""

    def __post_init__(self) -> None:
        """Reject impossible parameters."""
        _check_limits(
            self,
            latency_ns=(-(10**10), 10**10),
            gravity_mps2=(9.7, 9.9),
            tilt_sigma_rad=(0, 0.1),
        )
        _check_coordinates("position_m", self.position_m)
        if not abs(math.hypot(*self.orientation_xyzw) - 1.0) < _ROTATION_TOLERANCE:
            raise ValueError(f"orientation_xyzw holds {self.orientation_xyzw}, expected a unit quaternion")

    @property
    def point(self) -> ReferencePoint:
        """Its frame as a point of the robot whose pose may be exported."""
        return ReferencePoint(
            name=self.name, position_m=self.position_m, orientation_xyzw=self.orientation_xyzw
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuSamples:
    """Consecutive samples of the robot's IMU, raw: each is the mean over an interval of time.

    The lists have one entry per sample; they hold one line of the program that reads the IMU, some 25 ms.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["imu"] = "imu"
    sequence: int
    """Number of the first sample; lost samples are counted."""
    received_ns: int
    """Arrival of the line on the master's Unix clock in ns."""
    stamp_ns: tuple[int, ...]
    """End of each sample's interval on the master's Unix clock in ns, by the fitted clock of the device."""
    duration_ns: tuple[int, ...]
    """Length of each interval in ns, by the clock or the counter of the device."""
    instrument_time_ns: tuple[int, ...] | None
    """End of each interval on the clock of the device in ns; null where it has none."""
    angular_rate_radps: tuple[Vector3, ...]
    """Mean angular rate in its own axes, [x, y, z] in rad/s."""
    specific_force_mps2: tuple[Vector3, ...]
    """Mean specific force in its own axes, [x, y, z] in m/s^2: about +9.81 along the axis that points up, at rest."""

    def __post_init__(self) -> None:
        """Reject lists of different length and impossible times."""
        n = len(self.stamp_ns)
        lists = (self.duration_ns, self.angular_rate_radps, self.specific_force_mps2)
        if (
            n == 0
            or any(len(each) != n for each in lists)
            or len(self.instrument_time_ns or self.stamp_ns) != n
        ):
            raise ValueError("the lists of a line have different lengths, or none has an entry")
        check_instants(self.received_ns, *self.stamp_ns, *self.duration_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryParameters(FiniteNumbers):
    """Parameters that put the wheel odometry of the robot beside the samples of its IMU; sigmas are one sigma."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    """Point of the robot whose speed the wheels tell, in the frame ``robot``, [x, y, z] in m: the centre of the axle that does not
    steer; of tracks, the middle between them."""
    orientation_xyzw: Row4 = (0.0, 0.0, 0.0, 1.0)
    """Rotation that takes coordinates in the axes of the wheels (x forwards, y to the left, z up) to the frame ``robot``, as
    a Hamilton unit quaternion [x, y, z, w]."""
    latency_ns: int = 0
    """From a sample to its stamp, in ns; subtracted from the stamp. Positive: the stamp is late."""
    speed_noise_mps: float = 0.01
    """White noise of the speed of a sample, in m/s."""
    scale_sigma: float = 0.02
    """Relative error of the speed that stays: load, tyres, a wrong radius."""
    slip_sigma: float = 0.03
    """Relative error of the speed that comes and goes."""
    slip_correlation_time_s: float = 5.0
    """How long slip lasts, in s."""
    direction_sigma_rad: float = 0.02
    """Of the direction in which the robot goes straight ahead, about the z axis of the wheels, in rad."""
    lateral_sigma_mps: float = 0.02
    """Of the mean velocity across the wheels over a second, in m/s."""
    vertical_sigma_mps: float = 0.03
    """Of the mean velocity of the point along the z axis of the wheels over a second, in m/s."""
    turning_sigma_m: float = 0.05
    """By how far the point may be off the one that does not slide across in a turn, in m; times the yaw rate it is a velocity."""

    def __post_init__(self) -> None:
        """Reject impossible parameters."""
        _check_limits(
            self,
            latency_ns=(-(10**10), 10**10),
            speed_noise_mps=(1e-6, 10),
            scale_sigma=(1e-6, 0.5),
            slip_sigma=(1e-6, 0.5),
            slip_correlation_time_s=(0.1, 3600),
            direction_sigma_rad=(1e-6, 0.5),
            lateral_sigma_mps=(1e-6, 10),
            vertical_sigma_mps=(1e-6, 10),
            turning_sigma_m=(0, 10),
        )
        _check_coordinates("position_m", self.position_m)
        if not abs(math.hypot(*self.orientation_xyzw) - 1.0) < _ROTATION_TOLERANCE:
            raise ValueError(f"orientation_xyzw holds {self.orientation_xyzw}, expected a unit quaternion")


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometrySamples:
    """Consecutive samples of the robot's wheel odometry, raw: each is the mean over an interval of time.

    The lists have one entry per sample; they hold one line of the program that reads the odometry.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["odometry"] = "odometry"
    sequence: int
    """Number of the first sample; lost samples are counted."""
    received_ns: int
    """Arrival of the line on the master's Unix clock in ns."""
    stamp_ns: tuple[int, ...]
    """End of each sample's interval on the master's Unix clock in ns, by the fitted clock of the device."""
    duration_ns: tuple[int, ...]
    """Length of each interval in ns, by the clock or the counter of the device."""
    instrument_time_ns: tuple[int, ...] | None
    """End of each interval on the clock of the device in ns; null where it has none."""
    speed_mps: tuple[float, ...]
    """Mean speed along the direction of travel in m/s, positive forwards."""
    yaw_rate_radps: tuple[float, ...] | None
    """Mean yaw rate in rad/s, positive to the left; null where the device gives none. It is recorded, and not used: the gyro
    is better by far."""
    valid: tuple[bool, ...]
    """Whether the device trusts the sample."""

    def __post_init__(self) -> None:
        """Reject lists of different length and impossible times."""
        n = len(self.stamp_ns)
        lists = (
            self.duration_ns,
            self.speed_mps,
            self.valid,
            self.instrument_time_ns or self.stamp_ns,
            self.stamp_ns if self.yaw_rate_radps is None else self.yaw_rate_radps,
        )
        if n == 0 or any(len(each) != n for each in lists):
            raise ValueError("the lists of a line have different lengths, or none has an entry")
        check_instants(self.received_ns, *self.stamp_ns, *self.duration_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupCovariance(FiniteNumbers):
    """Joint covariance of the calibrated set-up, which all poses share: it does not average out over time."""

    components: tuple[str, ...]
    """What the n rows and columns stand for, each at most once. ``stationK.x``, ``.y``, ``.z``: displacement of the
    origin of station K in frame ``station1``, in m; ``stationK.rotation_x``, ``.rotation_y``, ``.rotation_z``: rotation of
    its axes about the fixed axes of frame ``station1`` through that origin, in rad; ``stationK.latency`` in s;
    ``stationK.vertical_index`` and ``.collimation`` in rad; ``stationK.prism_constant`` in m; ``stationK.range_scale``,
    dimensionless; ``prismP.x``, ``.y``, ``.z``: in the frame ``robot``, in m; ``imu.x``, ``.y``, ``.z``: its origin in the frame ``robot``, in m;
    ``imu.rotation_x``, ``.rotation_y``, ``.rotation_z``: rotation of its axes about those of ``robot``, in rad;
    ``imu.latency`` in s; ``imu.gyro_11`` to ``imu.gyro_33``: entries of its gyro matrix."""
    matrix: tuple[tuple[float, ...], ...]
    """n rows of n: covariances in products of those units."""

    def __post_init__(self) -> None:
        """Reject a matrix that is no covariance of the components."""
        n = len(self.components)
        if len(set(self.components)) != n:
            raise ValueError("components holds a name twice")
        if len(self.matrix) != n or any(len(row) != n for row in self.matrix):
            raise ValueError(f"matrix is not {n} x {n}, as the components are")
        for i, row in enumerate(self.matrix):
            for j, value in enumerate(row):
                limit = math.sqrt(max(self.matrix[i][i] * self.matrix[j][j], 0.0))
                if self.matrix[i][i] < 0 or abs(value) > limit * (1 + 1e-6) or value != self.matrix[j][i]:
                    raise ValueError(f"matrix is no covariance, see row {i + 1}, column {j + 1}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """Every parameter in force: what post-processing a recording needs."""

    omitted_if_none: ClassVar[frozenset[str]] = frozenset({"imu", "odometry", "no_poses"})

    type: Literal["parameters"] = "parameters"
    stations: tuple[StationParameters, ...]
    """One entry per station."""
    prisms: tuple[PrismPosition, ...]
    """One entry per prism."""
    pipeline: PipelineParameters = PipelineParameters()
    """Parameters of the estimators."""
    reference_point: ReferencePoint = ROBOT_ORIGIN
    """The frame on the robot whose pose is exported."""
    setup_covariance: SetupCovariance | None = None
    """Uncertainty of station frames, latencies, instrument errors and prisms; null where unknown: taken as exact."""
    imu: ImuParameters | None = None
    """The robot's IMU; absent where none is configured."""
    odometry: OdometryParameters | None = None
    """The robot's wheel odometry, which is used with the IMU; absent where none is configured."""
    no_poses: str | None = None
    """Why no poses are computed: a set-up file is missing, so that frames or prisms are unknown here; else absent."""
