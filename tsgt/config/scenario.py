"""What a scenario file may hold: a simulated world."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from tsgt.config.base import Model, NoiseConfig, NotNegative, Number, Place, Positive, no_two_share
from tsgt.config.pipeline import PipelineConfig

# Of the Gaussians: below a step of the simulation they smooth nothing, and far above a run they take for ever.
Smoothing = Annotated[float, Field(ge=0.01, le=1000)]

YawRate = Annotated[float, Field(ge=-100, le=100)]

LONGEST_ROUTE_M = 200_000.0
"""As far as a robot gets in the longest run; every 5 cm of it are kept."""


class MotionConfig(Model):
    """How the simulated robot drives; the defaults are the reference scenario ``dynamic``."""

    start_after_s: NotNegative = 0.0
    """It stands for so long before the first speed is commanded: time to synchronise, where a protocol has to."""
    interval_min_s: Annotated[float, Field(ge=0.01, le=1e6)] = 3.0
    """A new speed is commanded after at least this time ..."""
    interval_max_s: Positive = 8.0
    """... and at most this."""
    speeds_mps: Annotated[tuple[NotNegative, ...], Field(min_length=1)] = (0.0, 0.5, 1.0, 1.5)
    """Speeds to draw from."""
    speed_weights: tuple[NotNegative, ...] = (3.0, 2.0, 3.0, 2.0)
    """How often each of them is drawn, relative to the others."""
    yaw_rates_radps: Annotated[tuple[YawRate, ...], Field(min_length=1)] = (0.0, 0.0, 0.3, -0.3, 0.5, -0.5)
    """Yaw rates to draw from with each speed above zero, equally often; positive turns left."""
    command_smoothing_s: Smoothing = 0.35
    """Sigma of the Gaussian that smooths commanded speed and yaw rate."""
    tilt_rms_deg: NotNegative = 1.5
    """Roll and pitch on rough ground while moving, root mean square of each."""
    heave_rms_mm: NotNegative = 20.0
    """Up and down on rough ground while moving, root mean square."""
    attitude_smoothing_s: Smoothing = 0.5
    """Sigma of the Gaussian that smooths white noise into roll, pitch and heave."""
    area_centre_m: Place = (60.0, 45.0, -1.0)
    """Where the robot starts and stays around, in the frame of station 1."""
    area_radius_m: Positive = 40.0
    """Further from the centre than this the robot is steered back."""
    route_m: tuple[Place, ...] = ()
    """Way points to drive along at the speeds drawn, in the frame of station 1; at the last one the robot stops. The
    yaw rates and the area are for a robot without a route."""
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
        if length_m > LONGEST_ROUTE_M:
            raise ValueError(f"route_m is {length_m:g} m long; at most {LONGEST_ROUTE_M:g} m are simulated")
        return self


class OcclusionConfig(Model):
    """Something that comes between station and prism now and then: a tree, a person, a bend of the trail."""

    rate_per_min: Annotated[float, Field(gt=0, le=60)]
    """How often it comes, on average; the times are random."""
    duration_min_s: Positive
    """For at least this time the station has no target ..."""
    duration_max_s: Positive
    """... and for at most this."""
    common: bool = False
    """Whether it comes between the robot and all stations at once, or to each station in its own time."""

    @model_validator(mode="after")
    def _consistent(self) -> OcclusionConfig:
        if self.duration_min_s > self.duration_max_s:
            raise ValueError("duration_min_s is above duration_max_s")
        return self


class ScenarioRadioConfig(Model):
    """The four radios and what lies between them; the defaults are the paper's modem settings, in free space."""

    frequency_mhz: Annotated[float, Field(ge=137, le=1020)] = 905.0
    """Carrier."""
    spreading_factor: Annotated[int, Field(ge=7, le=12)] = 9
    """7 to 12; the authors' deployed nodes use 8."""
    bandwidth_khz: Annotated[float, Field(gt=0, le=500)] = 250.0
    """Bandwidth."""
    coding_rate: Annotated[int, Field(ge=5, le=8)] = 6
    """Denominator of the coding rate: 6 for 4/6."""
    power_dbm: Annotated[int, Field(ge=2, le=17)] = 14
    """Power of every radio."""
    antenna_gain_db: Annotated[float, Field(ge=-30, le=30)] = 0.0
    """Of each antenna, its cable deducted."""
    path_loss_exponent: Annotated[float, Field(ge=1.5, le=6)] = 2.0
    """How the power falls with distance: 2 in free space, 2.7 to 3.5 over ground and through trees."""
    shadowing_sigma_db: NotNegative = 0.0
    """Spread from station to station, one sigma."""
    rayleigh_fading: bool = False
    """Whether each packet fades as among many reflections."""
    loss_probability: Annotated[float, Field(ge=0, le=1)] = 0.0
    """That a packet is not heard, whatever its power."""


class InstrumentModelConfig(Model):
    """How a simulated total station behaves; the defaults are what public recordings and manuals show."""

    tick_jitter_ms: NotNegative = 4.0
    """Spread of the instants at which it measures about even ones, one sigma."""
    processing_min_ms: NotNegative = 20.0
    """From a measurement or a question, whichever is later, to its answer it takes at least this ..."""
    processing_max_ms: NotNegative = 60.0
    """... and at most this; all between are equally likely."""
    stalls_per_min: NotNegative = 0.0
    """How often it takes 300 to 700 ms instead, on average."""
    clock_drift_ppm: Annotated[float, Field(ge=-1000, le=1000)] = 20.0
    """By how much its own clock gains on the true time; positive: it runs fast."""
    angle_delay_ms: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """By how much its angles are newer than its distance."""
    tells_prisms_apart: bool = True
    """Whether it takes no other prism for its own: active prisms with numbers, as the paper's. With plain ones it takes
    whichever it finds when it has lost its own."""
    prediction_s: NotNegative = 2.0
    """How long the telescope keeps moving when the prism is hidden, before the lock is lost."""
    baud: Annotated[int, Field(ge=2400, le=921_600)] = 115_200
    """Bits per second of its line."""

    @model_validator(mode="after")
    def _consistent(self) -> InstrumentModelConfig:
        if self.processing_min_ms > self.processing_max_ms:
            raise ValueError("processing_min_ms is above processing_max_ms")
        return self


class SimulatedStation(Model):
    """A simulated total station: set up level, turned by some angle about the plumb line."""

    station: Number
    """Number of the station."""
    prism: Number
    """Number of the prism that it tracks."""
    position_m: Place
    """Where it stands, in the frame of station 1."""
    yaw_deg: Annotated[float, Field(ge=-1e4, le=1e4)] = 0.0
    """Direction of its circle's zero in the frame of station 1, positive to the left of its x axis."""
    rate_hz: Annotated[float, Field(ge=0.001, le=100)] = 2.5
    """Measurements per second; the first one comes at a random moment of the first period."""
    prism_constant_mm: Annotated[float, Field(ge=-10_000, le=10_000)] = 10.0
    """What the instrument's slope distance lacks to the prism's centre."""
    noise: NoiseConfig = NoiseConfig(range_sigma_ppm=0.0)
    """Noise of one measurement."""
    instrument: InstrumentModelConfig = InstrumentModelConfig()
    """What else there is to say of the instrument."""


class SimulatedPrism(Model):
    """A prism on the simulated robot."""

    prism: Number
    """Number of the prism."""
    position_m: Place
    """Its centre in the frame of the robot."""


class StatusFaultConfig(Model):
    """A time in which an instrument gives no good measurements, whatever it sees."""

    station: Number
    """Number of the station."""
    status: Literal["tilt", "wrong_distance", "no_target", "angle_only"]
    """What it says: not levelled, wrong target, no prism, or too close for a distance."""
    start_s: NotNegative
    """From this time after the start ..."""
    end_s: NotNegative
    """... to this."""


class ScenarioConfig(Model):
    """A simulated world; the defaults are the reference scenario ``dynamic``."""

    kind: Literal["scenario"] = "scenario"
    """What this file is."""
    name: str = "dynamic"
    """Name of the scenario."""
    duration_s: Annotated[float, Field(gt=0, le=86_400)] = 600.0
    """How long it takes; a command may ask for less."""
    motion: MotionConfig = MotionConfig()
    """How the robot drives."""
    stations: Annotated[tuple[SimulatedStation, ...], no_two_share("station")] = (
        SimulatedStation(station=1, prism=1, position_m=(0.0, 0.0, 0.0)),
        SimulatedStation(station=2, prism=2, position_m=(2.0, -1.5, 0.1), yaw_deg=25.0),
        SimulatedStation(station=3, prism=3, position_m=(-1.5, 2.5, -0.2), yaw_deg=-70.0),
    )
    """One entry per station; station 1 stands at the origin and looks along x, for it is the frame."""
    prisms: Annotated[tuple[SimulatedPrism, ...], no_two_share("prism")] = (
        SimulatedPrism(prism=1, position_m=(-0.4559, -0.1759, 1.1167)),
        SimulatedPrism(prism=2, position_m=(0.4844, -0.1759, 1.4167)),
        SimulatedPrism(prism=3, position_m=(-0.0285, 0.3519, 1.0667)),
    )
    """One entry per prism on the robot."""
    occlusions: tuple[OcclusionConfig, ...] = ()
    """What hides the prisms from the stations now and then; nothing by default."""
    targets_m: tuple[Place, ...] = ()
    """Targets on foil, numbered from 1, for single measurements; in the frame of station 1."""
    faults: tuple[StatusFaultConfig, ...] = ()
    """When instruments say that something is wrong; never by default."""
    radio: ScenarioRadioConfig = ScenarioRadioConfig()
    """How the master on the robot and the stations hear each other."""
    pipeline: PipelineConfig = PipelineConfig()
    """How measurements become poses."""

    @model_validator(mode="after")
    def _consistent(self) -> ScenarioConfig:
        known = {prism.prism for prism in self.prisms}
        for station in self.stations:
            if station.prism not in known:
                raise ValueError(
                    f"station {station.station} tracks prism {station.prism}, which has no position"
                )
        return self
