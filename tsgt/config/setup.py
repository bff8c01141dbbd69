"""Set-up files, as written by ``tsgt calibrate``."""

from __future__ import annotations

import math
import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from tsgt.config.base import Model, NotNegative, Number, NumberKey, Place, rigid
from tsgt.config.sensors import ImuNoiseConfig
from tsgt.model import Matrix4, Row4, SetupCovariance, Vector3

InstrumentErrorMrad = Annotated[float, Field(ge=-100, le=100)]

_UNIT_TOLERANCE = 1e-6

_STATION_COMPONENT = re.compile(
    r"station([1-9][0-9]{0,8})\."
    r"(x|y|z|rotation_[xyz]|latency|vertical_index|collimation|prism_constant|range_scale)"
)
_IMU_COMPONENT = re.compile(r"(imu)\.(x|y|z|rotation_[xyz]|latency|gyro_[1-3][1-3])")
_PRISM_COMPONENT = re.compile(r"prism([1-9][0-9]{0,8})\.[xyz]")


class CovarianceTable(Model):
    """Joint covariance of the calibrated quantities."""

    components: tuple[str, ...]
    """Quantity of each row and column: `station2.x`, `.y`, `.z` (origin in the frame of station 1, m), `.rotation_x`,
    `.rotation_y`, `.rotation_z` (about the axes of station 1, rad), `.latency` (s), `.vertical_index`, `.collimation`
    (rad), `.range_scale` (1), `.prism_constant` (m); `prism1.x`, `.y`, `.z` (in the robot frame, m); `imu.x`,
    `.y`, `.z` (m), `.rotation_x`, `.rotation_y`, `.rotation_z` (about the axes of the robot, rad), `.latency` (s), `.gyro_11` to
    `.gyro_33` (1)."""
    matrix: tuple[tuple[float, ...], ...]
    """Covariances, row by row, in products of those units."""

    @model_validator(mode="after")
    def _is_covariance(self) -> CovarianceTable:
        SetupCovariance(components=self.components, matrix=self.matrix)
        return self


def _check_components(table: CovarianceTable | None, pattern: re.Pattern[str], numbers: set[str]) -> None:
    for name in () if table is None else table.components:
        found = pattern.fullmatch(name)
        if found is None or found[1] not in numbers:
            raise ValueError(f"covariance.components: {name} is no quantity of this file")


class TargetFit(Model):
    """Residuals of one target."""

    target: Number
    """Number of the target."""
    residual_mm: NotNegative | None = None
    """Distance between its positions measured by the station and by station 1, in the solved frame; none if rejected."""
    leave_one_out_mm: NotNegative | None = None
    """The same with the frame solved from the other targets only; none if these are too few."""


class StationFrame(Model):
    """Frame of one station."""

    T_station1_station: Annotated[Matrix4, AfterValidator(rigid)]
    """Rigid transform, 4x4 row by row, from the station's frame to that of station 1, in m."""
    rms_mm: NotNegative | None = None
    """Root mean square of the target residuals."""
    targets: tuple[TargetFit, ...] = ()
    """Targets of the solution, for reports."""
    latency_ms: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    """Latency from the measurement to its timestamp by ``tsgt calibrate motion``; replaces that of the configuration."""
    vertical_index_mrad: InstrumentErrorMrad | None = None
    """Vertical index error: the zenith angle that the instrument reads (first face) less the true one. Subtracted from
    each measurement."""
    collimation_mrad: InstrumentErrorMrad | None = None
    """Horizontal collimation error: the line of sight deviates by it clockwise. Corrected by adding it, divided
    by the sine of the zenith angle, to each horizontal angle."""
    range_scale_ppm: Annotated[float, Field(ge=-1e4, le=1e4)] | None = None
    """Scale correction of the slope distance; replaces `atmospheric_ppm` of the configuration."""


class StationFramesFile(Model):
    """Station frames, written by ``tsgt calibrate targets`` or ``motion``."""

    kind: Literal["station_frames"]
    """Kind of this file."""
    stations: dict[NumberKey, StationFrame]
    """One table per station, named by its number."""
    covariance: CovarianceTable | None = None
    """Uncertainty of frames, latencies and instrument errors; none: unknown."""

    @model_validator(mode="after")
    def _covariance_is_of_stations(self) -> StationFramesFile:
        _check_components(self.covariance, _STATION_COMPONENT, set(self.stations))
        return self


class PrismEntry(Model):
    """Position of one prism on the robot."""

    position_m: Place
    """Centre in the robot frame, [x, y, z]."""
    sigma_m: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """One sigma of each coordinate."""


class PrismLayoutFile(Model):
    """Prism layout, written by ``tsgt calibrate prisms``."""

    kind: Literal["prism_layout"]
    """Kind of this file."""
    prisms: dict[NumberKey, PrismEntry]
    """One table per prism, named by its number."""
    covariance: CovarianceTable | None = None
    """Joint uncertainty of the positions; none: that of `sigma_m`, uncorrelated."""

    @model_validator(mode="after")
    def _covariance_is_of_prisms(self) -> PrismLayoutFile:
        _check_components(self.covariance, _PRISM_COMPONENT, set(self.prisms))
        return self


class SensorMountingFile(Model):
    """Mounting and clock offset of a sensor whose estimate is compared with the reference, written by ``tsgt compare`` or from CAD."""

    kind: Literal["sensor_mounting"]
    """Kind of this file."""
    position_m: Place
    """Origin of its axes in the axes of the reference point, [x, y, z]."""
    orientation_xyzw: Row4 = (0.0, 0.0, 0.0, 1.0)
    """Unit quaternion [x, y, z, w] that rotates coordinates in its axes into those of the reference point."""
    position_sigma_mm: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """One sigma of the position along each axis of the reference point; 0: exact. Without this key the position is unknown where it is fitted."""
    rotation_sigma_deg: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """One sigma of the rotation about each axis of the point; 0: exact. Without this key the rotation is unknown where it is fitted."""
    offset_ms: Annotated[float, Field(ge=-1e12, le=1e12)] = 0.0
    """Time on the reference's clock less the estimate's stamp."""
    offset_sigma_ms: NotNegative | None = None
    """One sigma of it."""

    @model_validator(mode="after")
    def _is_unit(self) -> SensorMountingFile:
        _check_unit(self.orientation_xyzw)
        return self


def _check_unit(quaternion: Row4) -> None:
    if not abs(math.hypot(*quaternion) - 1.0) < _UNIT_TOLERANCE:
        raise ValueError(f"orientation_xyzw holds {quaternion}, expected a unit quaternion")


class ImuMountingFile(Model):
    """Mounting, latency and gyro matrix of the robot's IMU, written by ``tsgt calibrate imu``."""

    kind: Literal["imu_mounting"]
    """Kind of this file."""
    position_m: Place
    """Origin of its axes in the robot frame, [x, y, z]."""
    orientation_xyzw: Row4
    """Unit quaternion [x, y, z, w] that rotates coordinates in its axes into the robot frame."""
    latency_ms: Annotated[float, Field(ge=-10_000, le=10_000)]
    """Latency from a sample to its timestamp, subtracted from it. Positive: the timestamp is late."""
    gyro_matrix: tuple[Vector3, Vector3, Vector3]
    """Scale factors and misalignment of the gyro: the angular rate is this matrix times the sample, less the bias."""
    gravity_mps2: Annotated[float, Field(ge=9.7, le=9.9)] | None = None
    """Gravity where the robot drove; like the next two keys for recordings of a master without the table `[imu]`."""
    tilt_sigma_mrad: Annotated[float, Field(ge=0, le=100)] | None = None
    """One sigma, per axis, of the angle between the z axis of station 1 and the vertical."""
    noise: ImuNoiseConfig | None = None
    """Noise of the samples."""
    covariance: CovarianceTable | None = None
    """Joint uncertainty of all these; none: unknown."""

    @model_validator(mode="after")
    def _possible(self) -> ImuMountingFile:
        _check_components(self.covariance, _IMU_COMPONENT, {"imu"})
        _check_unit(self.orientation_xyzw)
        return self
