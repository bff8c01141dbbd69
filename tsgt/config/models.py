"""What may stand in a configuration or set-up file: one model per kind, each key described, with its unit.

Keys carry the units that people use in the field (``_mm``, ``_deg``, ``_arcsec``, ``_s``). An unknown key is an
error, so that a typing mistake cannot silently leave a default in force.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, model_validator

from tsgt.model import LARGEST_NUMBER, Matrix4, Vector3

# A calibration writes 17 digits; a matrix typed off a report has seven or so.
RIGID_TOLERANCE = 1e-6

Number = Annotated[int, Field(ge=1, le=LARGEST_NUMBER)]
NumberKey = Annotated[str, Field(pattern=r"^[1-9][0-9]{0,8}$")]
Positive = Annotated[float, Field(gt=0, le=1e6)]
NotNegative = Annotated[float, Field(ge=0, le=1e6)]


def _beside_the_file(path: Path, info: ValidationInfo) -> Path:
    return Path((info.context or {}).get("folder", "")) / path


RelativePath = Annotated[Path, AfterValidator(_beside_the_file)]


def _rigid(T: Matrix4) -> Matrix4:
    """Refuse what is not a rotation and a translation; in plain Python, as geometry lies in a layer above."""
    if T[3] != (0.0, 0.0, 0.0, 1.0):
        raise ValueError("the last row of a rigid transform is [0, 0, 0, 1]")
    x, y, z = (row[:3] for row in T[:3])
    products = [(_dot(a, b), i == j) for i, a in enumerate((x, y, z)) for j, b in enumerate((x, y, z))]
    off = max(abs(product - same) for product, same in products)
    if off > RIGID_TOLERANCE:
        raise ValueError(
            f"its 3x3 part is not a rotation: off by {off:.1e}, allowed are {RIGID_TOLERANCE:.0e}"
        )
    x_cross_y = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    if _dot(x_cross_y, z) < 0:
        raise ValueError("its 3x3 part mirrors: the determinant is -1, that of a rotation is +1")
    return T


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return sum(p * q for p, q in zip(a, b, strict=True))


def _no_two_share(name: str) -> AfterValidator:
    """Refuse an array in which two entries have the same number under the given key."""

    def check(entries: tuple[Any, ...]) -> tuple[Any, ...]:
        numbers = [getattr(entry, name) for entry in entries]
        for number in numbers:
            if numbers.count(number) > 1:
                raise ValueError(f"{name} {number} stands there more than once")
        return entries

    return AfterValidator(check)


class Model(BaseModel):
    """Base of all: unknown keys refused, no conversions between types, nothing infinite."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class NoiseConfig(Model):
    """One-sigma noise of a single measurement; the defaults are a Trimble S7 that tracks."""

    range_sigma_mm: NotNegative = 2.0
    """Constant part of the noise of the slope distance."""
    range_sigma_ppm: NotNegative = 2.0
    """Part that grows with the distance."""
    angle_sigma_arcsec: Annotated[float, Field(ge=0, le=648_000)] = 1.0
    """Noise of each angle."""
    pointing_sigma_mm: NotNegative = 1.0
    """What pointing at the prism adds, per axis."""


class StationConfig(Model):
    """One total station, as the master sees it."""

    station: Number
    """Number of the station."""
    prism: Number
    """Number of the prism that it tracks."""
    prism_constant_mm: Annotated[float, Field(ge=-10_000, le=10_000)]
    """Added to every slope distance. No default: a forgotten constant shows in nothing but wrong poses."""
    atmospheric_ppm: Annotated[float, Field(ge=-10_000, le=10_000)] = 0.0
    """Scale correction of the slope distance, only what the instrument does not apply itself."""
    latency_ms: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """From the measurement to its time stamp; taken off the stamp. Positive: the stamp is late."""
    noise: NoiseConfig = NoiseConfig()
    """Noise of one measurement."""


class StreamConfig(Model):
    """The socket on which poses leave the master."""

    socket: RelativePath = Path("/run/tsgt/poses.sock")
    """UNIX socket of the pose stream."""
    mode: Annotated[str, Field(pattern=r"^0[0-7]{3}$")] = "0660"
    """Access rights of the socket, octal as for chmod."""
    queue_lines: Annotated[int, Field(ge=1)] = 2000
    """A reader that is further behind than this loses lines, and is told how many."""


class RecordingConfig(Model):
    """Where the master writes what it received and made."""

    directory: RelativePath = Path("/var/lib/tsgt")
    """Folder that gets one recording per run."""
    fsync_interval_s: Positive = 1.0
    """What a power cut can cost at most."""


class PipelineConfig(Model):
    """How measurements become poses."""

    estimator: Literal["linear"] = "linear"
    """Name of the estimator."""
    rate_hz: Annotated[float, Field(ge=0.01, le=1000)] = 20.0
    """Poses per second."""
    outage_limit_s: Positive = 1.0
    """Two measurements of one prism further apart than this leave the time between them without pose."""
    transport_limit_s: Positive = 2.0
    """A measurement that has not arrived this long after it was made is not waited for."""
    residual_limit_mm: Positive = 50.0
    """A pose whose prisms miss their layout by more than this (root mean square) is not valid."""
    tilt_limit_deg: Annotated[float, Field(gt=0, le=180)] = 90.0
    """A pose whose robot leans further than this is not valid: mirrored layout or swapped prisms."""
    acceleration_sigma_mps2: NotNegative = 0.3
    """One sigma of the robot's acceleration between two measurements, per axis; goes into the covariance."""
    angular_acceleration_sigma_radps2: NotNegative = 0.15
    """One sigma of its angular acceleration, per axis; goes into the covariance."""


class SetupConfig(Model):
    """The set-up files of the day, written by ``tsgt calibrate``."""

    station_frames: RelativePath
    """File of kind ``station_frames``: where each station stands."""
    prism_layout: RelativePath
    """File of kind ``prism_layout``: where the prisms sit on the robot."""


class MasterConfig(Model):
    """The master on the robot: stations in, poses out."""

    kind: Literal["master"]
    """What this file is."""
    setup: SetupConfig
    """Set-up files."""
    stations: Annotated[tuple[StationConfig, ...], Field(min_length=1), _no_two_share("station")]
    """One entry per station."""
    pipeline: PipelineConfig = PipelineConfig()
    """How measurements become poses."""
    stream: StreamConfig = StreamConfig()
    """Where poses go."""
    recording: RecordingConfig = RecordingConfig()
    """What stays."""


class StationFrame(Model):
    """Where one station stands."""

    T_station1_station: Annotated[Matrix4, AfterValidator(_rigid)]
    """Rigid transform, 4x4 row by row, from the station's frame to that of station 1, in m."""


class StationFramesFile(Model):
    """Where the stations stand: written by ``tsgt calibrate targets``."""

    kind: Literal["station_frames"]
    """What this file is."""
    stations: dict[NumberKey, StationFrame]
    """One table per station, named by its number."""


class PrismEntry(Model):
    """Where one prism sits on the robot."""

    position_m: Vector3
    """Its centre in the frame of the robot, [x, y, z]."""
    sigma_m: Vector3 | None = None
    """One sigma of each coordinate, as the calibration found it."""


class PrismLayoutFile(Model):
    """Where the prisms sit on the robot: written by ``tsgt calibrate prisms``."""

    kind: Literal["prism_layout"]
    """What this file is."""
    prisms: dict[NumberKey, PrismEntry]
    """One table per prism, named by its number."""


class MotionConfig(Model):
    """How the simulated robot drives; the defaults are the reference scenario ``dynamic``."""

    interval_min_s: Positive = 3.0
    """A new speed is commanded after at least this time ..."""
    interval_max_s: Positive = 8.0
    """... and at most this."""
    speeds_mps: Annotated[tuple[NotNegative, ...], Field(min_length=1)] = (0.0, 0.5, 1.0, 1.5)
    """Speeds to draw from."""
    speed_weights: tuple[NotNegative, ...] = (3.0, 2.0, 3.0, 2.0)
    """How often each of them is drawn, relative to the others."""
    yaw_rates_radps: Annotated[tuple[float, ...], Field(min_length=1)] = (0.0, 0.0, 0.3, -0.3, 0.5, -0.5)
    """Yaw rates to draw from with each speed above zero, equally often; positive turns left."""
    command_smoothing_s: Positive = 0.35
    """Sigma of the Gaussian that smooths commanded speed and yaw rate."""
    tilt_rms_deg: NotNegative = 1.5
    """Roll and pitch on rough ground while moving, root mean square of each."""
    heave_rms_mm: NotNegative = 20.0
    """Up and down on rough ground while moving, root mean square."""
    shaking_smoothing_s: Positive = 0.5
    """Sigma of the Gaussian that smooths white noise into roll, pitch and heave."""
    area_centre_m: Vector3 = (60.0, 45.0, -1.0)
    """Where the robot starts and stays around, in the frame of station 1."""
    area_radius_m: Positive = 40.0
    """Further from the centre than this the robot is steered back."""

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
        return self


class SimulatedStation(Model):
    """A simulated total station: set up level, turned by some angle about the plumb line."""

    station: Number
    """Number of the station."""
    prism: Number
    """Number of the prism that it tracks."""
    position_m: Vector3
    """Where it stands, in the frame of station 1."""
    yaw_deg: float = 0.0
    """Direction of its circle's zero in the frame of station 1, positive to the left of its x axis."""
    rate_hz: Annotated[float, Field(gt=0, le=100)] = 2.5
    """Measurements per second; the first one comes at a random moment of the first period."""
    prism_constant_mm: Annotated[float, Field(ge=-10_000, le=10_000)] = 10.0
    """What the instrument's slope distance lacks to the prism's centre."""
    noise: NoiseConfig = NoiseConfig(range_sigma_ppm=0.0)
    """Noise of one measurement."""


class SimulatedPrism(Model):
    """A prism on the simulated robot."""

    prism: Number
    """Number of the prism."""
    position_m: Vector3
    """Its centre in the frame of the robot."""


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
    stations: Annotated[tuple[SimulatedStation, ...], _no_two_share("station")] = (
        SimulatedStation(station=1, prism=1, position_m=(0.0, 0.0, 0.0)),
        SimulatedStation(station=2, prism=2, position_m=(2.0, -1.5, 0.1), yaw_deg=25.0),
        SimulatedStation(station=3, prism=3, position_m=(-1.5, 2.5, -0.2), yaw_deg=-70.0),
    )
    """One entry per station; station 1 stands at the origin and looks along x, for it is the frame."""
    prisms: Annotated[tuple[SimulatedPrism, ...], _no_two_share("prism")] = (
        SimulatedPrism(prism=1, position_m=(-0.4559, -0.1759, 1.1167)),
        SimulatedPrism(prism=2, position_m=(0.4844, -0.1759, 1.4167)),
        SimulatedPrism(prism=3, position_m=(-0.0285, 0.3519, 1.0667)),
    )
    """One entry per prism on the robot."""
    transport_min_ms: NotNegative = 50.0
    """From the measurement to its arrival at the master: at least this ..."""
    transport_max_ms: NotNegative = 250.0
    """... and at most this, evenly distributed."""
    pipeline: PipelineConfig = PipelineConfig()
    """How measurements become poses."""

    @model_validator(mode="after")
    def _consistent(self) -> ScenarioConfig:
        if self.transport_min_ms > self.transport_max_ms:
            raise ValueError("transport_min_ms is above transport_max_ms")
        known = {prism.prism for prism in self.prisms}
        for station in self.stations:
            if station.prism not in known:
                raise ValueError(
                    f"station {station.station} tracks prism {station.prism}, which has no position"
                )
        return self


Config = Annotated[
    MasterConfig | StationFramesFile | PrismLayoutFile | ScenarioConfig, Field(discriminator="kind")
]

KINDS: dict[str, type[Model]] = {
    "master": MasterConfig,
    "station_frames": StationFramesFile,
    "prism_layout": PrismLayoutFile,
    "scenario": ScenarioConfig,
}
