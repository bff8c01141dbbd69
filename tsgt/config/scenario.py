"""Scenario files: a simulated world."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from tsgt.config.base import Model, NoiseConfig, NotNegative, Number, Place, Positive, unique_by
from tsgt.config.pipeline import PipelineConfig, ReferencePointConfig

# Sigma of a Gaussian: below a time step it has no effect, far above a mission it takes for ever.
Smoothing = Annotated[float, Field(ge=0.01, le=1000)]

YawRate = Annotated[float, Field(ge=-100, le=100)]

MAX_ROUTE_M = 200_000.0
"""Distance that a robot covers in the longest mission; the route is stored in steps of 5 cm."""

ImuModelName = Literal["none", "industrial", "consumer"]

_UNIT_TOLERANCE = 1e-4  # of a quaternion with four digits; its user normalises it


class MotionConfig(Model):
    """Motion of the simulated robot; the defaults are the reference scenario ``dynamic``."""

    start_after_s: NotNegative = 0.0
    """Stationary time before the first speed command, to synchronise clocks if the protocol has to."""
    interval_min_s: Annotated[float, Field(ge=0.01, le=1e6)] = 3.0
    """Minimum interval between speed commands."""
    interval_max_s: Positive = 8.0
    """Maximum interval between speed commands."""
    speeds_mps: Annotated[tuple[NotNegative, ...], Field(min_length=1)] = (0.0, 0.5, 1.0, 1.5)
    """Speeds to draw from."""
    speed_weights: tuple[NotNegative, ...] = (3.0, 2.0, 3.0, 2.0)
    """Relative frequency of each speed."""
    yaw_rates_radps: Annotated[tuple[YawRate, ...], Field(min_length=1)] = (0.0, 0.0, 0.3, -0.3, 0.5, -0.5)
    """Yaw rates to draw from with each speed above zero, equally often; positive is to the left."""
    command_smoothing_s: Smoothing = 0.35
    """Sigma of the Gaussian that smooths speed and yaw rate commands."""
    tilt_rms_deg: NotNegative = 1.5
    """Roll and pitch on rough ground while moving, root mean square of each."""
    heave_rms_mm: NotNegative = 20.0
    """Heave on rough ground while moving, root mean square."""
    attitude_smoothing_s: Smoothing = 0.5
    """Sigma of the Gaussian that smooths white noise into roll, pitch and heave."""
    area_centre_m: Place = (60.0, 45.0, -1.0)
    """Start of the robot and centre of its area, in the frame of station 1."""
    area_radius_m: Positive = 40.0
    """Distance from the centre beyond which the robot is steered back."""
    route_m: tuple[Place, ...] = ()
    """Way points to follow at the drawn speeds, in the frame of station 1; the robot stops at the last one. Yaw rates and
    area apply to a robot without a route."""
    corner_smoothing_m: Smoothing = 2.0
    """Sigma of the Gaussian that rounds the corners of the route."""

    @model_validator(mode="after")
    def _consistent(self) -> MotionConfig:
        if self.interval_min_s > self.interval_max_s:
            raise ValueError("interval_min_s is above interval_max_s")
        if len(self.speed_weights) != len(self.speeds_mps):
            raise ValueError(
                f"{len(self.speeds_mps)} speeds_mps, but {len(self.speed_weights)} speed_weights"
            )
        if not sum(self.speed_weights):
            raise ValueError("all speed_weights are 0")
        if len(self.route_m) == 1:
            raise ValueError("route_m has one way point; a route has at least two")
        length_m = sum(math.dist(*legs) for legs in pairwise(self.route_m))
        if length_m > MAX_ROUTE_M:
            raise ValueError(f"route_m is {length_m:g} m long; at most {MAX_ROUTE_M:g} m are simulated")
        return self


class OcclusionConfig(Model):
    """Random occlusions of the line of sight: trees, people, a bend of the trail."""

    rate_per_min: Annotated[float, Field(gt=0, le=60)]
    """Mean rate of occlusions; the times are random."""
    duration_min_s: Positive
    """Minimum duration of an occlusion."""
    duration_max_s: Positive
    """Maximum duration of an occlusion."""
    common: bool = False
    """Whether all stations are occluded at once, or each one independently."""

    @model_validator(mode="after")
    def _consistent(self) -> OcclusionConfig:
        if self.duration_min_s > self.duration_max_s:
            raise ValueError("duration_min_s is above duration_max_s")
        return self


class ScenarioRadioConfig(Model):
    """Radios and channel; the defaults are the paper's modem settings, in free space."""

    frequency_mhz: Annotated[float, Field(ge=137, le=1020)] = 905.0
    """Carrier frequency."""
    spreading_factor: Annotated[int, Field(ge=7, le=12)] = 9
    """Spreading factor, 7 to 12; the authors' deployed nodes use 8."""
    bandwidth_khz: Annotated[float, Field(gt=0, le=500)] = 250.0
    """Bandwidth."""
    coding_rate: Annotated[int, Field(ge=5, le=8)] = 6
    """Denominator of the coding rate: 6 for 4/6."""
    power_dbm: Annotated[int, Field(ge=2, le=17)] = 14
    """Transmit power of every radio."""
    antenna_gain_db: Annotated[float, Field(ge=-30, le=30)] = 0.0
    """Gain of each antenna less its cable loss."""
    path_loss_exponent: Annotated[float, Field(ge=1.5, le=6)] = 2.0
    """Path loss exponent: 2 in free space, 2.7 to 3.5 over ground and through trees."""
    shadowing_sigma_db: NotNegative = 0.0
    """Shadowing between stations, one sigma."""
    rayleigh_fading: bool = False
    """Whether each packet is subject to Rayleigh fading."""
    loss_probability: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Probability that a packet is lost, independent of its power."""


class InstrumentModelConfig(Model):
    """Behaviour of a simulated total station; the defaults come from public recordings and manuals."""

    generation: Literal["TPS1100", "TPS1200", "TPS1200+", "TS15", "MS50", "TS16", "MS60"] = "TPS1200+"
    """What it knows of GeoCOM; an MS50 or MS60 also stands for TS50 and TS60."""
    tick_jitter_ms: NotNegative = 4.0
    """Jitter of the measurement instants, one sigma."""
    processing_min_ms: NotNegative = 20.0
    """Minimum processing time from a measurement or a request, whichever is later, to the response."""
    processing_max_ms: NotNegative = 60.0
    """Maximum processing time; uniformly distributed."""
    stalls_per_min: NotNegative = 0.0
    """Mean rate of stalls, in which processing takes 300 to 700 ms."""
    clock_drift_ppm: Annotated[float, Field(ge=-1000, le=1000)] = 20.0
    """Skew of its own clock; positive: the clock runs fast."""
    angle_delay_ms: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """Delay of its angles after its distance."""
    distinguishes_prisms: bool = True
    """Whether it distinguishes prisms: active prisms with numbers, as the paper's. With passive prisms it locks onto any
    prism when it has lost its own."""
    prediction_s: NotNegative = 2.0
    """Duration of the prediction of an occluded prism, before the lock is lost."""
    lock_drift_mmps: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Speed at which the line of sight drifts off the prism in the last second before it is lost."""
    relock_error_mm: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Error across the line of sight right after a reacquisition; it settles with a time constant of 0.3 s."""
    baud: Annotated[int, Field(ge=2400, le=921_600)] = 115_200
    """Baud rate of its serial line."""

    @model_validator(mode="after")
    def _consistent(self) -> InstrumentModelConfig:
        if self.processing_min_ms > self.processing_max_ms:
            raise ValueError("processing_min_ms is above processing_max_ms")
        return self


class SimulatedStation(Model):
    """A simulated, levelled total station."""

    station: Number
    """Number of the station."""
    prism: Number
    """Number of the prism that it tracks."""
    position_m: Place
    """Position in the frame of station 1."""
    yaw_deg: Annotated[float, Field(ge=-1e4, le=1e4)] = 0.0
    """Direction of its circle's zero in the frame of station 1, positive to the left of the x axis."""
    rate_hz: Annotated[float, Field(ge=0.001, le=100)] = 2.5
    """Measurement rate; the first measurement is at a random time in the first period."""
    prism_constant_mm: Annotated[float, Field(ge=-10_000, le=10_000)] = 10.0
    """Constant to add to the slope distance to reach the centre of the prism."""
    noise: NoiseConfig = NoiseConfig(range_sigma_ppm=0.0)
    """Noise of one measurement; without this table `range_sigma_ppm` is 0."""
    instrument: InstrumentModelConfig = InstrumentModelConfig()
    """Behaviour of the instrument."""


class SimulatedPrism(Model):
    """A prism on the simulated robot."""

    prism: Number
    """Number of the prism."""
    position_m: Place
    """Centre in the robot frame."""


class StatusFaultConfig(Model):
    """An interval in which an instrument reports an error status."""

    station: Number
    """Number of the station."""
    status: Literal["tilt", "wrong_distance", "no_target", "angle_only"]
    """Reported status: not levelled, wrong distance, no prism, or too close for a distance."""
    start_s: NotNegative
    """Start of the interval, from the start of the mission."""
    end_s: NotNegative
    """End of the interval."""


class ShakingConfig(Model):
    """Fast shaking while the robot drives, part of the ground truth: band-limited noise, isotropic, flat in the band."""

    when: Literal["with_imu", "always", "never"] = "with_imu"
    """Whether the robot is shaken only if it has an IMU, always, or never."""
    acceleration_rms_mps2: Annotated[float, Field(ge=0, le=100)] = 1.5
    """Acceleration at the IMU along each axis, root mean square at speeds from 0.5 m/s on."""
    angular_rate_rms_radps: Annotated[float, Field(ge=0, le=10)] = 0.06
    """Angular rate about each axis, root mean square at speeds from 0.5 m/s on."""
    low_hz: Annotated[float, Field(ge=1, le=200)] = 8.0
    """Lower limit of the band."""
    high_hz: Annotated[float, Field(ge=1, le=200)] = 60.0
    """Upper limit of the band."""

    @model_validator(mode="after")
    def _consistent(self) -> ShakingConfig:
        if self.low_hz + 1.0 > self.high_hz:
            raise ValueError("low_hz is less than 1 Hz below high_hz")
        return self


class ImuSetupErrorConfig(Model):
    """Errors of the set-up of the IMU: in the configuration of the master, or in the program that reads the IMU."""

    rotation_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Rotation of the mounting in the configuration of the master, about the IMU's [1, 1, 1] axis."""
    position_mm: Annotated[float, Field(ge=-10_000, le=10_000)] = 0.0
    """Displacement of the IMU in the configuration of the master, along the robot's x axis."""
    latency_ms: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """Error of the latency in the configuration of the master."""
    axes_swapped: bool = False
    """Whether the program swaps the x and y axes and inverts z."""
    degrees: bool = False
    """Whether the program gives angular rates in degrees per second."""
    gravity_inverted: bool = False
    """Whether the program gives accelerations with gravity pointing down: the specific force with the wrong sign."""


class SimulatedImu(Model):
    """The robot's IMU and where it is."""

    model: ImuModelName = "none"
    """Class of the IMU; none: the robot has none."""
    serial_number: Annotated[int, Field(ge=0, le=10**9)] = 5
    """Selects scale factors, misalignment, sensitivities and clock of the device; the same in all missions, whatever the seed."""
    position_m: Place = (0.21, -0.12, 0.43)
    """Origin of its axes in the robot frame."""
    orientation_xyzw: tuple[float, float, float, float] = (0.00897, -0.01569, 0.71731, 0.69652)
    """Rotation from its axes to the robot frame, a unit quaternion to four digits."""
    latency_ms: Annotated[float, Field(ge=0, le=1000)] = 4.3
    """From the end of a sample's interval to its earliest arrival: filter, transmission and host together."""
    latitude_deg: Annotated[float, Field(ge=-90, le=90)] = 46.8
    """Latitude of station 1, for gravity and the Earth's rotation."""
    height_m: Annotated[float, Field(ge=-500, le=9000)] = 100.0
    """Height of station 1 above the ellipsoid."""
    vertical_sigma_arcsec: Annotated[float, Field(ge=0, le=3600)] = 3.0
    """Angle between the z axis of station 1 and the vertical, one sigma per axis: its compensator."""
    setup_error: ImuSetupErrorConfig = ImuSetupErrorConfig()
    """Errors of the set-up; none by default."""

    @field_validator("orientation_xyzw")
    @classmethod
    def _unit(cls, value: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        norm = math.hypot(*value)
        if abs(norm - 1.0) > _UNIT_TOLERANCE:
            raise ValueError(f"orientation_xyzw is no unit quaternion: its norm is {norm:.6g}")
        return value


class ScenarioConfig(Model):
    """A simulated world; the defaults are the reference scenario ``dynamic``."""

    kind: Literal["scenario"] = "scenario"
    """Kind of this file."""
    name: str = "dynamic"
    """Name of the scenario."""
    duration_s: Annotated[float, Field(gt=0, le=86_400)] = 600.0
    """Duration; commands may override it."""
    motion: MotionConfig = MotionConfig()
    """Motion of the robot."""
    shaking: ShakingConfig = ShakingConfig()
    """Fast shaking of the driving robot."""
    imu: SimulatedImu = SimulatedImu()
    """The robot's IMU; none by default."""
    odometry: bool = False
    """Whether the robot has wheel odometry, which is used with the IMU."""
    stations: Annotated[tuple[SimulatedStation, ...], unique_by("station")] = (
        SimulatedStation(station=1, prism=1, position_m=(0.0, 0.0, 0.0)),
        SimulatedStation(station=2, prism=2, position_m=(2.0, -1.5, 0.1), yaw_deg=25.0),
        SimulatedStation(station=3, prism=3, position_m=(-1.5, 2.5, -0.2), yaw_deg=-70.0),
    )
    """One entry per station; station 1 is at the origin with yaw 0, as it defines the frame."""
    prisms: Annotated[tuple[SimulatedPrism, ...], unique_by("prism")] = (
        SimulatedPrism(prism=1, position_m=(-0.4559, -0.1759, 1.1167)),
        SimulatedPrism(prism=2, position_m=(0.4844, -0.1759, 1.4167)),
        SimulatedPrism(prism=3, position_m=(-0.0285, 0.3519, 1.0667)),
    )
    """One entry per prism on the robot."""
    occlusions: tuple[OcclusionConfig, ...] = ()
    """Occlusions; none by default."""
    targets_m: tuple[Place, ...] = ()
    """Positions of foil targets for single measurements, numbered from 1, in the frame of station 1."""
    faults: tuple[StatusFaultConfig, ...] = ()
    """Error statuses of instruments; none by default."""
    radio: ScenarioRadioConfig = ScenarioRadioConfig()
    """Radios and channel."""
    pipeline: PipelineConfig = PipelineConfig()
    """Estimator and limits."""
    reference_point: ReferencePointConfig = ReferencePointConfig()
    """Reference point of the poses: the robot frame by default."""

    @model_validator(mode="after")
    def _consistent(self) -> ScenarioConfig:
        known = {prism.prism for prism in self.prisms}
        for station in self.stations:
            if station.prism not in known:
                raise ValueError(
                    f"station {station.station} tracks prism {station.prism}, which has no position"
                )
        return self
