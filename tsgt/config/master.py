"""What the configuration of the master on the robot holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from tsgt.config.base import Model, NoiseConfig, Number, Positive, RelativePath, no_two_share
from tsgt.config.pipeline import PipelineConfig
from tsgt.config.radio import MasterProtocolConfig, RadioConfig, check_numbers
from tsgt.polygon import check_simple

Corner = tuple[Annotated[float, Field(ge=-1e6, le=1e6)], Annotated[float, Field(ge=-1e6, le=1e6)]]


def _simple(corners: tuple[Corner, ...]) -> tuple[Corner, ...]:
    check_simple(corners)
    return corners


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
    timestamp_delay_ms: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    """How late the station's computer stamps a ping, on average: 0.7 for the authors' nodes, which poll."""
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


class SetupConfig(Model):
    """The set-up files of the day, written by ``tsgt calibrate``."""

    station_frames: RelativePath
    """File of kind ``station_frames``: where each station stands."""
    prism_layout: RelativePath
    """File of kind ``prism_layout``: where the prisms sit on the robot."""


class FrameWatchConfig(Model):
    """When the live alarm says that a frame no longer holds: a tripod has moved, a prism has slipped."""

    residual_mm: Positive = 6.0
    """The prisms of a robot that stands still miss their layout by at most this (root mean square) ..."""
    residual_speed_gain_ms: Annotated[float, Field(ge=0, le=1e3)] = 6.0
    """... and by this times the robot's speed more while it moves."""
    window_s: Positive = 10.0
    """Three of four poses over this time have to miss it by more."""


class GeofenceConfig(Model):
    """An area that the robot is to stay in, or out of; seen from above, in the frame of station 1."""

    name: Annotated[str, Field(min_length=1, max_length=40)]
    """Its name in events."""
    keep: Literal["inside", "outside"] = "inside"
    """Where the robot belongs."""
    polygon_m: Annotated[tuple[Corner, ...], Field(min_length=3), AfterValidator(_simple)]
    """Corners [x, y] in order around one area; the last is joined to the first."""
    margin_m: Annotated[float, Field(ge=0, le=1e4)] = 0.0
    """The robot's origin has to stay at least this far on the right side: half its length, say."""
    sigmas: Annotated[float, Field(ge=0, le=10)] = 3.0
    """How many standard deviations of the position count as if the robot were there."""
    hysteresis_m: Annotated[float, Field(ge=0, le=1e4)] = 0.5
    """It is back only when it is this much further on the right side."""
    lost_after_s: Positive = 2.0
    """No valid pose for this long counts as leaving."""
    command: tuple[str, ...] = ()
    """Program and arguments that are run at each crossing; it finds TSGT_EVENT and TSGT_FENCE in its environment."""


class MasterConfig(Model):
    """The master on the robot: stations in, poses out."""

    kind: Literal["master"]
    """What this file is."""
    setup: SetupConfig
    """Set-up files."""
    stations: Annotated[tuple[StationConfig, ...], Field(min_length=1), no_two_share("station")]
    """One entry per station."""
    radio: RadioConfig
    """The radio; the same modem settings as the clients'."""
    protocol: MasterProtocolConfig
    """What is spoken over it; the same as the clients'."""
    pipeline: PipelineConfig = PipelineConfig()
    """How measurements become poses."""
    frame_watch: FrameWatchConfig = FrameWatchConfig()
    """The live alarm for frames that no longer hold."""
    geofences: Annotated[tuple[GeofenceConfig, ...], no_two_share("name")] = ()
    """Areas to stay in or out of."""
    stream: StreamConfig = StreamConfig()
    """Where poses go."""
    recording: RecordingConfig = RecordingConfig()
    """What stays."""

    @model_validator(mode="after")
    def _numbers_fit_the_protocol(self) -> MasterConfig:
        for station in self.stations:
            check_numbers(self.protocol, station.station, station.prism)
        return self
