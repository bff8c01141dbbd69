"""What stations, clocks and the robot's sensors give: measurements and samples."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from tsgt.model.values import FiniteNumbers, Vector3, check_finite, check_instants


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

    @property
    def has_target(self) -> bool:
        """Whether the instrument had a target, so that the angles are valid."""
        return self.usable or self is Status.ANGLE_ONLY


@dataclass(frozen=True, slots=True, kw_only=True)
class PolarMeasurement(FiniteNumbers):
    """One raw measurement of a prism by a total station."""

    type: Literal["measurement"] = "measurement"
    station: int
    """Number of the station that measured, from 1."""
    prism: int
    """Number of the prism that it tracked, from 1."""
    sequence: int
    """Sequence number of the station's measurements, from 0: with the protocol superframe that of its journal, which skips numbers
    when the client is restarted; with classic the master's own count."""
    stamp_ns: int
    """Host stamp on the master's Unix clock in ns. The station's latency (``latency_s`` of ``setup``) is not subtracted: the
    measurement was made that much earlier."""
    stamp_sigma_ns: int = 0
    """One sigma of ``stamp_ns`` in ns, without the instrument's latency. In a journal: of the conversion from the
    instrument's clock to the station's. In a recording: of that from the station's clock to the master's. In a merged
    measurement also the excess of the former over its usual value."""
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
class ImuSamples(FiniteNumbers):
    """Consecutive samples of the robot's IMU, raw: each is the mean over an interval of time.

    The lists have one entry per sample; they hold one line of the program that reads the IMU, some 25 ms.
    """

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
class OdometrySamples(FiniteNumbers):
    """Consecutive samples of the robot's wheel odometry, raw: each is the mean over an interval of time.

    The lists have one entry per sample; they hold one line of the program that reads the odometry.
    """

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
