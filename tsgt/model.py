"""The records that all parts share: measurements, and the parameters that turn them into poses.

Plain frozen data classes, SI units and radians, times as integers in nanoseconds. What stands on disk and on the
stream is exactly these fields under exactly these names; units, frames and signs are those of
docs/explanation/conventions.md.
"""

from __future__ import annotations

import math
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


LAST_INSTANT_NS = 2**63 - 1
"""Times are kept in 64 bits; 2262 is the year that they end in."""


LARGEST_NUMBER = 2**31 - 1
"""For numbers of stations and prisms."""


LARGEST_COORDINATE_M = 1e8
"""Of any place: coordinates of maps (UTM: 1e7) and from the Earth's centre are smaller. What is beyond is garbage, whose
squares no number holds."""


_ROTATION_TOLERANCE = 1e-3
"""More than what is lost where a matrix is written with four digits."""


def check_instants(*times_ns: int) -> None:
    """Refuse times that do not fit into 64 bits or lie before 1970.

    Raises
    ------
    ValueError
        With the first such time.
    """
    for time_ns in times_ns:
        if not 0 <= time_ns <= LAST_INSTANT_NS:
            raise ValueError(f"a time of {time_ns} ns is outside what a clock can show")


def check_finite(*numbers: float) -> None:
    """Refuse NaN and infinity, which an instrument or a radio may send and no JSON can hold.

    Raises
    ------
    ValueError
        With the first such number.
    """
    for number in numbers:
        if not math.isfinite(number):
            raise ValueError(f"{number} is not a finite number")


def _check_coordinates(what: str, coordinates: Iterable[float]) -> None:
    """Refuse places that are not near the Earth."""
    for coordinate in coordinates:
        if not abs(coordinate) <= LARGEST_COORDINATE_M:
            raise ValueError(f"{what} holds {coordinate:g}, expected at most {LARGEST_COORDINATE_M:g} m")


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _check_rotation(what: str, matrix: Matrix4) -> None:
    """Refuse a matrix whose first three rows and columns are no rotation, nor nearly one."""
    x, y, z = (row[:3] for row in matrix[:3])
    lengths = (math.hypot(*x) - 1, math.hypot(*y) - 1, math.hypot(*z) - 1)
    cosines = (_dot(x, y), _dot(y, z), _dot(z, x))
    if not all(abs(off) < _ROTATION_TOLERANCE for off in (*lengths, *cosines)):
        raise ValueError(f"{what} holds {x}, {y}, {z}, which is no rotation")


def _check_limits(record: object, **limits: tuple[float, float]) -> None:
    """Refuse parameters outside their limits, both of which are allowed."""
    for name, (least, most) in limits.items():
        if not least <= getattr(record, name) <= most:
            raise ValueError(f"{name} is {getattr(record, name)}, expected {least:g} to {most:g}")


class Status(StrEnum):
    """What the instrument said of a measurement, in one vocabulary for all makes."""

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
class PolarMeasurement:
    """One measurement of a prism, raw as the total station gave it.

    Attributes
    ----------
    type
        Always ``measurement``.
    station
        Number of the station that measured, from 1.
    prism
        Number of the prism that it tracked, from 1.
    sequence
        Running number of this station's measurements, from 0.
    stamp_ns
        Time of the measurement on the master's Unix clock in ns: the host stamp put on that clock. The
        station's latency is not taken off; whoever computes with it does that.
    stamp_sigma_ns
        One sigma of ``stamp_ns`` in ns, without the instrument's latency: in a journal of the instrument's time on the
        station's clock, in a recording of that clock on the master's; in what was merged from a journal also of what the
        instrument's time is less certain than usual.
    stamp_bound_ns
        ``stamp_ns`` is within this of the truth, in ns; null where nobody can say.
    received_ns
        When the master had it, on the master's Unix clock, in ns.
    horizontal_angle_rad
        Horizontal circle, clockwise from the circle's zero, in rad.
    zenith_angle_rad
        Angle from straight up in rad; above pi in the second face.
    slope_distance_m
        Slope distance in m as the instrument gave it, without prism constant and atmospheric correction
        beyond what the instrument applies itself; null where it gave none.
    status
        The instrument's verdict: ``ok``, ``low_accuracy``, ``angle_only``, ``no_target``, ``tilt``,
        ``wrong_distance`` or ``error``. The first two are usable.
    raw_status
        The number that the instrument itself gave for it; 0 where the radio does not carry it.
    host_time_ns
        The station computer's stamp in ns, on its own clock; null where the radio does not carry it.
    instrument_time_ns
        The instrument's own stamp in ns, on the instrument's clock; null where it has none.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["measurement"] = "measurement"
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
    status: Status = Status.OK
    raw_status: int = 0
    host_time_ns: int | None
    instrument_time_ns: int | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be a measurement: instants that no clock shows, angles that are no numbers."""
        check_instants(self.stamp_ns, self.received_ns, self.stamp_sigma_ns)
        check_instants(self.stamp_bound_ns or 0, self.host_time_ns or 0)
        check_finite(self.horizontal_angle_rad, self.zenith_angle_rad, self.slope_distance_m or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointMeasurement:
    """One prism position that came as Cartesian coordinates; the polar raw values are not known.

    Attributes
    ----------
    type
        Always ``point``.
    station
        Number of the station that measured, from 1.
    prism
        Number of the prism, from 1.
    sequence
        Running number of this station's points, from 0.
    stamp_ns
        Time of the measurement on the master's Unix clock in ns.
    received_ns
        When it came, on the same clock, in ns.
    position_m
        Position of the prism in the frame ``station1``, [x, y, z] in m, all corrections applied.
    status
        As in ``measurement``.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["point"] = "point"
    station: int
    prism: int
    sequence: int
    stamp_ns: int
    received_ns: int
    position_m: Vector3
    status: Status = Status.OK

    def __post_init__(self) -> None:
        """Refuse what cannot be a measurement: instants that no clock shows, coordinates that are no numbers."""
        check_instants(self.stamp_ns, self.received_ns)
        check_finite(*self.position_m)


Measurement = PolarMeasurement | PointMeasurement


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockSample:
    """One two-way exchange with a station, from which its clock is judged.

    Attributes
    ----------
    sent_ns
        When the request began on the air, on the master's Unix clock in ns.
    station_ns
        The station's stamp of the request's reception, on the station's clock in ns.
    received_ns
        When the reply was received (RxDone), on the master's Unix clock in ns.
    forward_ns
        What the way out takes at least, known beforehand: from ``sent_ns`` to the station's stamp, in ns.
    back_ns
        What the way back takes at least, known beforehand: from the station's stamp to ``received_ns``, in ns.
    """

    sent_ns: int
    station_ns: int
    received_ns: int
    forward_ns: int
    back_ns: int

    @property
    def excess_ns(self) -> int:
        """What the round trip took beyond what is known; the station's stamp may be late by at most this."""
        return self.received_ns - self.sent_ns - self.forward_ns - self.back_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class InstrumentNoise:
    """One-sigma noise of a total station's single measurement, in the form of its data sheet.

    Attributes
    ----------
    range_sigma_m
        Constant part of the slope distance's noise in m.
    range_sigma_ppm
        Part that grows with the distance, in 1e-6 of it; both parts add as variances.
    angle_sigma_rad
        Noise of the horizontal and of the zenith angle in rad, on the sphere: the horizontal angle's own
        noise is this over sin(zenith angle).
    pointing_sigma_m
        What pointing adds across and along the line of sight, per axis, in m: tracking jitter and the
        prism's centring, or aiming by hand at a foil target.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    range_sigma_m: float
    range_sigma_ppm: float
    angle_sigma_rad: float
    pointing_sigma_m: float

    def __post_init__(self) -> None:
        """Refuse noise that no instrument has."""
        _check_limits(
            self,
            range_sigma_m=(0, 1e3),
            range_sigma_ppm=(0, 1e6),
            angle_sigma_rad=(0, math.pi),
            pointing_sigma_m=(0, 1e3),
        )


TRACKING_NOISE = InstrumentNoise(
    # Trimble S7 data sheet, tracking mode: 4 mm + 2 ppm and 1 arcsecond. The 4 mm are read as two sigma, the rest is
    # kept whole, which errs on the safe side by 0.1 mm at 100 m. 1 mm of tracking jitter per axis.
    range_sigma_m=0.002,
    range_sigma_ppm=2.0,
    angle_sigma_rad=1.0 * ARCSECOND_RAD,
    pointing_sigma_m=0.001,
)

TARGET_NOISE = InstrumentNoise(
    # Single measurements on reflective foil. The data sheet's 2 mm + 2 ppm, read as two sigma, are met along the line
    # of sight; but the residuals of the 18 targets that the paper's authors published are as large across it, where
    # the angles leave only aiming by hand: most likely with 0.9 mm of pointing and next to nothing of range.
    range_sigma_m=0.0005,
    range_sigma_ppm=1.0,
    angle_sigma_rad=1.0 * ARCSECOND_RAD,
    pointing_sigma_m=0.0009,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetResidual:
    """How well one target fits the frame that was solved from all of them.

    Attributes
    ----------
    target
        Number of the target.
    residual_m
        Distance between where the station, in its solved frame, and where station 1 sees it, in m; null for a rejected
        one.
    left_out_m
        The same with the frame solved from the other targets alone, in m; null where these were too few.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    target: int
    residual_m: float | None
    left_out_m: float | None

    def __post_init__(self) -> None:
        """Refuse what no calibration finds."""
        _check_limits(self, target=(1, LARGEST_NUMBER))
        for residual_m in (self.residual_m or 0.0, self.left_out_m or 0.0):
            if not 0 <= residual_m <= 1e6:
                raise ValueError(f"a residual is {residual_m:g}, expected 0 to 1e+06 m")


@dataclass(frozen=True, slots=True, kw_only=True)
class StationParameters:
    """What is needed to turn one station's raw measurements into positions in the frame ``station1``.

    Attributes
    ----------
    station
        Number of the station, from 1.
    prism
        Number of the prism that the station tracks by default.
    T_station1_station
        Rigid transform, 4x4, that takes coordinates in the station's frame to frame ``station1``, in m.
    prism_constant_m
        Added to every raw slope distance, in m.
    atmospheric_ppm
        Scale correction of the slope distance in 1e-6, only what the instrument did not apply itself.
    latency_ns
        From the measurement to its host stamp, in ns; taken off the stamp. Positive: the stamp is late.
    noise
        Noise of one measurement.
    targets
        From which targets the frame was solved, and how well they fit; empty where that is not known, and for station 1.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    station: int
    prism: int
    T_station1_station: Matrix4 = IDENTITY4
    prism_constant_m: float = 0.0
    atmospheric_ppm: float = 0.0
    latency_ns: int = 0
    noise: InstrumentNoise = TRACKING_NOISE
    targets: tuple[TargetResidual, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what no station can have."""
        _check_limits(
            self,
            station=(1, LARGEST_NUMBER),
            prism=(1, LARGEST_NUMBER),
            prism_constant_m=(-10, 10),
            atmospheric_ppm=(-1e4, 1e4),
            latency_ns=(-(10**12), 10**12),
        )
        _check_rotation("T_station1_station", self.T_station1_station)
        _check_coordinates("T_station1_station", (row[3] for row in self.T_station1_station))


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionPrior:
    """How a robot moves, as the estimator ``continuous`` expects it before anything is measured.

    Attributes
    ----------
    acceleration_sigma_mps2
        One sigma of the acceleration of the prisms' middle (centroid) along x, y, z of frame ``station1``.
    acceleration_correlation_time_s
        How long an acceleration lasts in s: after this its correlation has fallen to 1/e.
    angular_acceleration_sigma_radps2
        One sigma of the angular acceleration about x, y, z of the robot.
    angular_acceleration_time_s
        How long that lasts in s.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    acceleration_sigma_mps2: Vector3 = (0.4, 0.4, 0.2)
    acceleration_correlation_time_s: float = 0.8
    angular_acceleration_sigma_radps2: Vector3 = (0.15, 0.15, 0.2)
    angular_acceleration_time_s: float = 0.4

    def __post_init__(self) -> None:
        """Refuse motion that no robot has."""
        _check_limits(
            self, acceleration_correlation_time_s=(1e-3, 1e4), angular_acceleration_time_s=(1e-3, 1e4)
        )
        for sigma in (*self.acceleration_sigma_mps2, *self.angular_acceleration_sigma_radps2):
            if not 1e-6 <= sigma <= 1e6:
                raise ValueError(f"a sigma of an acceleration is {sigma}, expected 1e-06 to 1e+06")


@dataclass(frozen=True, slots=True, kw_only=True)
class PipelineParameters:
    """How measurements become poses.

    Attributes
    ----------
    estimator
        Name of the estimator: ``linear`` (straight lines between measurements) or ``continuous`` (one smooth
        trajectory through all of them).
    period_ns
        Step of the pose epochs in ns; epochs are the whole multiples of it in Unix time.
    outage_limit_ns
        Two measurements of one prism further apart than this leave the time between them invalid, in ns.
    transport_limit_ns
        A measurement that has not arrived this long after it was made is not waited for, in ns.
    residual_limit_m
        A pose whose prisms miss the layout by more than this (root mean square over the prisms) is invalid.
    tilt_limit_rad
        A pose whose robot z axis leans further than this from straight up is invalid: the prism layout is
        mirrored, or two stations have swapped prisms.
    acceleration_sigma_mps2
        One sigma, per axis, of the robot's acceleration between two measurements: what straight-line
        interpolation does not see, and the covariance therefore has to carry. For ``linear``.
    angular_acceleration_sigma_radps2
        The same for its angular acceleration. For ``linear``.
    motion
        How the robot moves. For ``continuous``.
    noise_scale
        What the noise of all instruments is multiplied by. For ``continuous``.
    lag_ns
        How long a live pose waits for measurements on its other side until it is smoothed for good, in ns; what
        arrives later than this after it was made does not count. For ``continuous``.
    position_sigma_limit_m
        A pose whose position (of the prisms' centroid, in the direction in which it is known worst) has a sigma
        above this is invalid. For ``continuous``.
    rotation_sigma_limit_rad
        The same for the sigma of its rotation. For ``continuous``.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    estimator: Literal["linear", "continuous"] = "continuous"
    period_ns: int = 50_000_000
    outage_limit_ns: int = 1_000_000_000
    transport_limit_ns: int = 2_000_000_000
    residual_limit_m: float = 0.05
    tilt_limit_rad: float = math.pi / 2
    acceleration_sigma_mps2: float = 0.3
    angular_acceleration_sigma_radps2: float = 0.15
    motion: MotionPrior = MotionPrior()
    noise_scale: float = 1.0
    lag_ns: int = 3_000_000_000
    position_sigma_limit_m: float = 0.1
    rotation_sigma_limit_rad: float = math.radians(5.0)

    def __post_init__(self) -> None:
        """Refuse limits that nothing can be computed with."""
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
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class PrismPosition:
    """Where a prism sits on the robot.

    Attributes
    ----------
    prism
        Number of the prism, from 1.
    position_m
        Its centre in the frame ``robot``, [x, y, z] in m.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    prism: int
    position_m: Vector3

    def __post_init__(self) -> None:
        """Refuse what is no place."""
        _check_coordinates("position_m", self.position_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """Every parameter in force: what a recording must hold to be processed again.

    Attributes
    ----------
    type
        Always ``parameters``.
    stations
        One entry per station.
    prisms
        One entry per prism.
    pipeline
        How measurements become poses.
    """

    type: Literal["parameters"] = "parameters"
    stations: tuple[StationParameters, ...]
    prisms: tuple[PrismPosition, ...]
    pipeline: PipelineParameters = PipelineParameters()
