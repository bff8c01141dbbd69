"""Configuration of the master on the robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from tsgt.config.alarms import AlarmsConfig
from tsgt.config.base import (
    Argument,
    Model,
    NoiseConfig,
    Number,
    Positive,
    RelativePath,
    SocketPath,
    unique_by,
)
from tsgt.config.pipeline import PipelineConfig, ReferencePointConfig
from tsgt.config.radio import MasterProtocolConfig, RadioConfig, check_numbers
from tsgt.config.sensors import ImuConfig, OdometryConfig
from tsgt.polygon import check_simple

NoiseFactor = Annotated[float, Field(ge=0.001, le=1000)]
Corner = tuple[Annotated[float, Field(ge=-1e6, le=1e6)], Annotated[float, Field(ge=-1e6, le=1e6)]]


def _simple(corners: tuple[Corner, ...]) -> tuple[Corner, ...]:
    check_simple(corners)
    return corners


class StationConfig(Model):
    """One total station."""

    station: Number
    """Number of the station."""
    prism: Number
    """Number of the prism that it tracks."""
    prism_constant_mm: Annotated[float, Field(ge=-10_000, le=10_000)]
    """Constant added to every slope distance. No default: a forgotten constant only shows in wrong poses."""
    atmospheric_ppm: Annotated[float, Field(ge=-10_000, le=10_000)] = 0.0
    """Scale correction of the slope distance, if the instrument does not apply it itself."""
    timestamp_delay_ms: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    """Mean delay of the timestamp of a ping on the station's computer: 0.7 for the authors' nodes, which poll."""
    latency_ms: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """Latency from the measurement to its timestamp, subtracted from it. Positive: the timestamp is late."""
    time_sigma_ms: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    """One sigma of its timestamps beyond that of an instrument on a cable: over a network `stamp_sigma_ns` of its journal."""
    noise: NoiseConfig = NoiseConfig()
    """Noise of one measurement."""
    noise_scale: tuple[NoiseFactor, NoiseFactor, NoiseFactor] = (1.0, 1.0, 1.0)
    """Factors on that noise along the line of sight, horizontally and vertically across it; for `continuous`."""


class StreamConfig(Model):
    """Socket of the pose stream."""

    socket: SocketPath = Path("/run/tsgt/poses.sock")
    """UNIX socket of the pose stream."""
    mode: Annotated[str, Field(pattern=r"^0[0-7]{3}$")] = "0660"
    """Permissions of the socket, octal as for chmod."""
    queue_lines: Annotated[int, Field(ge=1)] = 2000
    """Maximum number of lines that wait for a reader; a slower one loses lines, and is told how many."""


class RecordingConfig(Model):
    """Recording of the master: everything received and computed."""

    directory: RelativePath = Path("/var/lib/tsgt")
    """Folder of the recordings, one per start."""
    fsync_interval_s: Positive = 1.0
    """Maximum loss after a power cut."""


class SetupConfig(Model):
    """Set-up files, written by ``tsgt calibrate``."""

    station_frames: RelativePath
    """File of kind ``station_frames``."""
    prism_layout: RelativePath
    """File of kind ``prism_layout``."""


class FrameWatchConfig(Model):
    """Layout monitor: event if the prisms no longer fit their layout, as after a moved tripod or a slipped prism."""

    residual_mm: Positive = 6.0
    """Maximum layout residual of a stationary robot (root mean square)."""
    residual_speed_gain_ms: Annotated[float, Field(ge=0, le=1e3)] = 6.0
    """Increase of that limit with the robot's speed, in mm per m/s."""
    window_s: Positive = 10.0
    """Window of the monitor: the event needs residuals above the limit in three quarters of its poses. If poses have gaps, the
    window is extended up to twelvefold, until it has as many poses as a third of it would have without gaps."""


class GeofenceConfig(Model):
    """An area that the robot must not leave, or not enter: a polygon in the horizontal plane of station 1."""

    name: Annotated[str, Field(min_length=1, max_length=40)]
    """Name in events."""
    allowed_side: Literal["inside", "outside"] = "inside"
    """Side of the polygon on which the robot may be."""
    polygon_m: Annotated[tuple[Corner, ...], Field(min_length=3), AfterValidator(_simple)]
    """Corners [x, y] in order; the last is joined to the first."""
    margin_m: Annotated[float, Field(ge=0, le=1e4)] = 0.0
    """Minimum distance of the reference point from the boundary on the allowed side, for example half the robot's length."""
    sigmas: Annotated[float, Field(ge=0, le=10)] = 3.0
    """Position uncertainty added to the margin, in standard deviations."""
    hysteresis_m: Annotated[float, Field(ge=0, le=1e4)] = 0.5
    """Additional distance on the allowed side that ends a violation."""
    lost_after_s: Positive = 2.0
    """Without a valid pose for this long the geofence counts as violated."""
    command: tuple[Argument, ...] = ()
    """Program and arguments run at each crossing, with TSGT_EVENT and TSGT_FENCE in its environment."""


class MasterConfig(Model):
    """Master on the robot: stations in, poses out."""

    kind: Literal["master"]
    """Kind of this file."""
    setup: SetupConfig
    """Set-up files."""
    stations: Annotated[tuple[StationConfig, ...], Field(min_length=1), unique_by("station")]
    """One entry per station."""
    radio: RadioConfig
    """Radio; modem settings as the clients'."""
    protocol: MasterProtocolConfig
    """Radio protocol; as the clients'."""
    pipeline: PipelineConfig = PipelineConfig()
    """Estimator and limits."""
    reference_point: ReferencePointConfig = ReferencePointConfig()
    """Reference point of the poses: the robot frame by default."""
    imu: ImuConfig | None = None
    """The robot's IMU, if it has one."""
    odometry: OdometryConfig | None = None
    """The robot's wheel odometry, if it has one: beside an IMU."""
    frame_watch: FrameWatchConfig = FrameWatchConfig()
    """Layout monitor."""
    geofences: Annotated[tuple[GeofenceConfig, ...], unique_by("name")] = ()
    """Geofences."""
    alarms: AlarmsConfig | None = None
    """Events that leave the machine; none without this table."""
    stream: StreamConfig = StreamConfig()
    """Pose stream."""
    recording: RecordingConfig = RecordingConfig()
    """Recording on disk."""

    @property
    def setup_files(self) -> tuple[Path, ...]:
        """Files that the poses depend on: of kind ``station_frames``, ``prism_layout`` and, if given, ``imu_mounting``."""
        mounting = None if self.imu is None else self.imu.mounting
        return (
            self.setup.station_frames,
            self.setup.prism_layout,
            *(() if mounting is None else (mounting,)),
        )

    @model_validator(mode="after")
    def _odometry_has_an_imu(self) -> MasterConfig:
        if self.odometry is not None and self.imu is None:
            raise ValueError("odometry needs the table [imu]: without an IMU wheels do not tell a pose")
        return self

    @model_validator(mode="after")
    def _numbers_fit_the_protocol(self) -> MasterConfig:
        for station in self.stations:
            check_numbers(self.protocol, station.station, station.prism)
        return self
